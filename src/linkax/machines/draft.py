"""What the readers of all formats share: they fill a draft, which becomes a machine."""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.machine import LeftOut, Machine, Start, acts_along
from linkax.machines.parts import STRUCTURE, Part, Place
from linkax.machines.poses import relative, turned, whole
from linkax.machines.xml import MachineFileError, Node, Where
from linkax.model.bodies import GROUND_NAME, RigidBody
from linkax.model.constraints.constraint import Coupling
from linkax.model.forces.contact_law import ContactLaw
from linkax.model.forces.force import Gravity
from linkax.model.forces.joint_forces import JointDamper, JointFriction, JointSpring
from linkax.model.forces.joint_limits import JointLimit
from linkax.model.forces.point_forces import PointForce
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.names import free_name, meant
from linkax.model.shapes import Shape
from linkax.xla.users_line import warn

Pose = Float[np.ndarray, "4 4"]
STOP_DEPTH = 1e-3  # how far the weight of a machine presses a stop whose stiffness no file gives [rad or of its size]
STOP_RESTITUTION = 0.1  # of such a stop, hit with 1 rad/s, or one size a second
FRICTION_SPEED = 1e-2  # below which dry friction along a joint is nearly viscous [rad/s, or of the size a second]
ROUNDING = 5e-10  # of the largest principal moment, by which others may be impossible
KINDS = ("contact", "limit", "spring", "damping", "friction", "actuator", "inertia", "joint", "equality", "tendon")
OF_GROUND = f"{GROUND_NAME}.body"
SHOWN = 4  # things left out that a warning names


@dataclasses.dataclass
class Draft:
    """A machine in the making.

    - `ignore`: kinds of things that are left out where the file has them.
    - `folders`: below which other files may be read.
    - `whole_angles`: whether angles that are rounded are taken as what they stand for.
    """

    path: Path
    ignore: tuple[str, ...]
    folders: tuple[Path, ...]
    whole_angles: bool
    name: str = ""
    bodies: list[Part] = dataclasses.field(default_factory=list)
    joints: list[Part] = dataclasses.field(default_factory=list)
    forces: list[Part] = dataclasses.field(default_factory=list)
    constraints: list[Part] = dataclasses.field(default_factory=list)
    poses: dict[str, Pose] = dataclasses.field(default_factory=lambda: {GROUND_NAME: np.eye(4)})
    shapes: dict[str, list[Shape]] = dataclasses.field(default_factory=dict)
    starts: dict[str, Start] = dataclasses.field(default_factory=dict)
    left_out: list[LeftOut] = dataclasses.field(default_factory=list)
    missing: list[LeftOut] = dataclasses.field(default_factory=list)
    _leaders: dict[Any, Any] = dataclasses.field(default_factory=dict)
    _taken: set[tuple[int, str, str, str]] = dataclasses.field(default_factory=set)

    def angles(self, given: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Angles of a file, [rad], (3,)."""
        return np.array([whole(float(angle)) for angle in given]) if self.whole_angles else given

    def leave_out(self, where: Where, kind: str, reason: str, changes_motion: bool = True) -> None:
        """Note what is left out; what changes the motion must be in `ignore`."""
        known = self.missing if changes_motion and kind not in self.ignore else self.left_out
        known.append(LeftOut(where, kind, reason))

    def leave_out_unread(self, root: Node) -> None:
        """Note what no reader asked for, once all that is read of a file is read."""
        told = {item.where for item in (*self.left_out, *self.missing)}
        for where, kind, reason, changes_motion in root.unread(told):
            self.leave_out(where, kind, reason, changes_motion)

    def ignores(self, kind: str, where: Where, what: str) -> bool:
        """Tell whether a kind of thing that could be modelled is to be left out, and note that."""
        if kind in self.ignore:
            self.left_out.append(LeftOut(where, kind, f"{what} is ignored as asked"))
        return kind in self.ignore

    def body(
        self,
        name: str,
        pose: Pose,
        mass: float,
        center_of_mass: Float[np.ndarray, "3"],
        inertia: Float[np.ndarray, "3 3"],
        where: Where,
        frames: dict[str, Any] | None = None,
    ) -> None:
        """Add a body, named by `body_name`, from its pose in the world as drawn, and its numbers in its own frame."""
        if name in self.poses:
            raise where.error(f"body {name!r} is there twice; give each a name of its own")
        if name == OF_GROUND:
            self.leave_out(where, "name", f"it is {name!r} here, since {GROUND_NAME!r} is what stands still", False)
        self.poses[name] = pose
        inertia = self._possible(inertia, where)
        arguments = {"name": name, "mass": float(mass), "center_of_mass": center_of_mass, "inertia": inertia}
        self._add(self.bodies, RigidBody, arguments | ({"frames": frames} if frames else {}), where)

    def _possible(self, inertia, where):
        """The inertia, with moments that are not negative, and a largest one no larger than the sum of the others."""
        moments, axes = np.linalg.eigh(inertia)
        possible = np.maximum(moments, 0.0)
        possible[2] = min(possible[2], possible[0] + possible[1])
        if np.abs(moments - possible).max() <= ROUNDING * np.abs(moments).max():
            return inertia
        reason = f"no body has its principal moments {moments} kg m², negative, or one above the sum of the others"
        self.leave_out(where, "inertia", f"{reason}; taken as {possible}")
        return turned(np.diag(possible), axes)

    def shape(self, body: str, kind: Any, size: Any, at: Pose, mesh: Path | None = None, colour: Any = None) -> None:
        """Add what a body is drawn as, from its pose on the body; what is not opaque at all is not seen.

        **Raises:** `ValueError` for what is no shape.
        """
        shape = Shape(kind, size, at[:3, 3], at[:3, :3], mesh, colour)
        if colour is None or colour[3]:
            self.shapes.setdefault(body, []).append(shape)

    def joint(
        self, kind: type, name: str, parent: str, child: str, frame: Pose, where: Where, **arguments: Any
    ) -> None:
        """Add a joint between two bodies, with its frame in the world as drawn."""
        for body in (parent, child):
            if body not in self.poses:
                raise where.error(f"it attaches to {body!r}, which is no body of the file; known: {self._names()}")
        places = {
            end: Place.at(body, relative(frame, self.poses[body]))
            for end, body in (("parent", parent), ("child", child))
        }
        self.joint_at(kind, name, places["parent"], places["child"], where, **arguments)

    def joint_at(self, kind: type, name: str, parent: Place, child: Place, where: Where, **arguments: Any) -> None:
        """Add a joint from its places on both bodies."""
        self._add(self.joints, kind, {"name": name, "parent": parent, "child": child, **arguments}, where)

    def retype(self, name: str, kind: type, where: Where, **axes: Any) -> None:
        """Make a joint one of another kind, in its place, without what acts along it."""
        place = [part.name for part in self.joints].index(name)
        part = self.joints[place]
        kept = {key: entry for key, entry in part.arguments.items() if key not in STRUCTURE}
        self.joints[place] = Part(kind, kept | axes, part.where)
        for group in (self.forces, self.constraints):
            for part in [part for part in group if name in acts_along(part)]:
                reason = f"{part.name!r} is along joint {name!r}, which is a {kind.__name__} in {where.path.name}"
                self.leave_out(part.where, "joint", reason, False)
            group[:] = [part for part in group if name not in acts_along(part)]

    def force(self, kind: type, name: str, where: Where, **arguments: Any) -> None:
        """Add a force element."""
        self._add(self.forces, kind, {"name": name, **arguments}, where)

    def constraint(self, kind: type, name: str, where: Where, **arguments: Any) -> None:
        """Add a constraint."""
        self._add(self.constraints, kind, {"name": name, **arguments}, where)

    def follow(self, name: str, where: Where, follower: Any, leader: Any, factor: float, offset: float) -> None:
        """Add follower = factor × leader + offset, of coordinates by their joints.

        **Raises:** `MachineFileError` for one that follows itself, through others, too.
        """
        self._leaders[follower] = leader
        first = leader
        while first != follower and first in self._leaders:
            first = self._leaders[first]
        if first == follower:
            raise where.error(f"{follower!r} follows {leader!r}, and that way itself; let it follow another joint")
        self.constraint(Coupling, name, where, coefficients={follower: 1.0, leader: -factor}, offset=offset)

    def gravity(self, acceleration: Any, where: Where) -> None:
        """Add gravity [m/s²], (3,)."""
        if np.any(acceleration):
            arguments = {"acceleration": np.asarray(acceleration, dtype=float)}
            self.forces.insert(0, _Gravity(Gravity, arguments, where))

    def carry(self, body: str, center_of_mass: Any, force: Any, where: Where) -> None:
        """Add a constant force [N] at the centre of mass, in ground axes, against the weight of a body."""
        point = Place(body, np.asarray(center_of_mass), np.eye(3))
        self.force(PointForce, f"{body}.carried", where, point=point, force=np.asarray(force))

    def along(
        self,
        joint: Any,
        name: str,
        where: Where,
        *,
        stiffness: float = 0.0,
        free: float = 0.0,
        damping: float = 0.0,
        friction: float = 0.0,
    ) -> None:
        """Add spring, damper and dry friction along a joint, as far as they are not zero."""
        if stiffness and not self.ignores("spring", where, "its spring"):
            self.force(JointSpring, f"{name}.spring", where, joint=joint, stiffness=stiffness, free=free)
        if damping and not self.ignores("damping", where, "its damping"):
            self.force(JointDamper, f"{name}.damper", where, joint=joint, damping=damping)
        if friction and not self.ignores("friction", where, "its dry friction"):
            self.force(JointFriction, f"{name}.friction", where, joint=joint, torque=friction, scale=None)

    def limit(
        self,
        joint: Any,
        name: str,
        where: Where,
        lower: float | None,
        upper: float | None,
        *,
        stiffness: float | None = None,
        damping: float | None = None,
    ) -> None:
        """Add stops, where a joint has ends and the first is below the second."""
        if (lower is None and upper is None) or self.ignores("limit", where, "its range"):
            return
        if lower is not None and upper is not None and lower >= upper:
            self.leave_out(where, "limit", f"its range from {lower:g} to {upper:g} is empty", False)
            return
        ends = {end: value for end, value in (("lower", lower), ("upper", upper)) if value is not None}
        law = {"stiffness": stiffness, "exponent": 1.0, "damping": damping}
        self.force(JointLimit, f"{name}.limit", where, joint=joint, law=Part(ContactLaw, law, where), **ends)

    def machine(self, base: str) -> Machine:
        """Make the machine: bodies that nothing holds get a joint to the ground, a free or a fixed one.

        **Raises:** `MachineFileError` for what the file asks for, changes the motion, and is not in `ignore`;
        `ValueError` for a word in `ignore` that is no kind of thing.
        """
        present = {item.kind for item in (*self.left_out, *self.missing)}
        for kind in self.ignore:
            if kind not in KINDS and kind not in present:
                known = ", ".join(sorted({*KINDS, *present}))
                raise ValueError(
                    f"ignore has {kind!r}{meant(kind, KINDS)}, which nothing in the file is; known: {known}"
                )
        if self.missing:
            listed = "\n  ".join(map(str, self.missing))
            kinds = ", ".join(f'"{kind}"' for kind in dict.fromkeys(item.kind for item in self.missing))
            raise MachineFileError(
                f"{self.path.name} asks for what linkax does not model, and what changes the motion:\n  {listed}\n"
                f"leave it out by ignore=[{kinds}]"
            )
        if not self.bodies:
            raise MachineFileError(f"{self.path.name} has no body; give a file of a machine")
        self._hold(base)
        joints, size = {part.name: part for part in reversed(self.joints)}, self.size
        forces = [self._completed(part, joints, size) for part in self.forces]
        bodies = [self._drawn(part) for part in self.bodies]
        joints, constraints, forces = self._with_own_names(self.joints, self.constraints, forces)
        groups = tuple(bodies), joints, forces, constraints
        for group in groups:
            for part in group:
                part.built({})
        self._warn()
        return Machine(self.name or self.path.stem, self.path, *groups, self.starts, tuple(self.left_out))

    def _drawn(self, body):
        """A body with its shapes."""
        shapes = self.shapes.get(body.name)
        return dataclasses.replace(body, arguments={**body.arguments, "shape": tuple(shapes)}) if shapes else body

    def _with_own_names(self, *groups: list[Part]) -> list[tuple[Part, ...]]:
        """The groups with a name of its own for each part: with its kind in the file, where one before has the name.

        Formats have a name for each kind of element, linkax one for a joint, a constraint or a force. Others go by the
        names of joints, of those that are added first.
        """
        given, used = {part.name for group in groups for part in group}, set[str]()

        def own(part: Part) -> Part:
            name, where = part.name, part.where
            if name in used and part.kind is not Gravity:
                name = free_name(f"{name}.{where.tag}", given | used)
                self.leave_out(where, "name", f"it is {name!r} here, since another has the name {part.name!r}", False)
                part = dataclasses.replace(part, arguments={**part.arguments, "name": name})
            used.add(name)
            return part

        return [tuple(map(own, group)) for group in groups]

    def _add(self, group, kind, arguments, where):
        taken = (id(group), arguments["name"], where.tag, where.name)
        if taken in self._taken:
            raise where.error(f"the name {arguments['name']!r} is there twice; give each element a name of its own")
        self._taken.add(taken)
        group.append(Part(kind, arguments, where))

    def _names(self) -> str:
        return ", ".join(map(repr, list(self.poses)[1:9])) + (", ..." if len(self.poses) > 9 else "")

    def _hold(self, base):
        """Join to the ground the first body of each part that nothing holds there."""
        carrying = [joint for joint in self.joints if joint.kind.can_carry]
        neighbours = _neighbours(carrying)
        reached = _connected(neighbours, GROUND_NAME)
        for body in self.bodies:
            if body.name in reached:
                continue
            kind, word = (Free, "free") if base == "free" else (Fixed, "fixed")
            parent, child = Place.at(GROUND_NAME, self.poses[body.name]), Place.at(body.name, np.eye(4))
            name = free_name(f"{body.name}.{word}", {joint.name for joint in self.joints})
            arguments = {"name": name, "parent": parent, "child": child}
            self.joints.insert(0, Part(kind, arguments, body.where))
            reached |= _connected(neighbours, body.name)

    @property
    def size(self) -> float:
        """How far apart its joints are drawn, at most [m]; 1 for a machine without extent."""
        origins = [self.poses[place.body][:3] @ [*place.offset, 1.0] for joint in self.joints for place in _ends(joint)]
        return float(np.ptp(origins, axis=0).max()) or 1.0 if origins else 1.0

    def _completed(self, part, joints, size):
        """A stop, or dry friction, with the numbers that the file does not give."""
        if part.kind not in (JointLimit, JointFriction):
            return part
        along = part.arguments["joint"]
        name, index = along if isinstance(along, tuple) else (along, 0)
        unit = size if joints[name].kind.speed_units[index] == "m" else 1.0
        arguments = dict(part.arguments)
        if part.kind is JointFriction:
            return dataclasses.replace(part, arguments=arguments | {"scale": FRICTION_SPEED * unit})
        law = dict(arguments["law"].arguments)
        if law["stiffness"] is None:
            weight = 9.81 * size * sum(body.arguments["mass"] for body in self.bodies) or 1.0
            law["stiffness"] = weight / STOP_DEPTH / unit**2
        if law.pop("damping") is None:
            law |= {"restitution": STOP_RESTITUTION, "impact_speed": unit}
        return dataclasses.replace(
            part, arguments=arguments | {"law": dataclasses.replace(arguments["law"], arguments=law)}
        )

    def _warn(self):
        ends = {part.name.removesuffix(".limit"): part.arguments for part in self.forces if part.kind is JointLimit}
        outside = [name for name, of in ends.items() if of.get("lower", 0.0) > 0.0 or of.get("upper", 0.0) < 0.0]
        if outside:
            warn(
                f"{self.path.name}: {', '.join(map(repr, outside))} are drawn outside of their ranges, and stops "
                'push them from there; begin at other positions, or leave stops out by ignore=["contact", "limit"]',
                LeftOutWarning,
            )
        ignored = [item for item in self.left_out if item.kind in self.ignore]
        if not ignored:
            return
        more = len(self.left_out) - len(ignored[:SHOWN])
        rest = f"; {more} more in machine.left_out" if more else ""
        warn(f"{self.path.name}: left out {'; '.join(map(str, ignored[:SHOWN]))}{rest}", LeftOutWarning)


def body_name(name: str) -> str:
    """What a body of a file is called, whose name may be that of what stands still."""
    return OF_GROUND if name == GROUND_NAME else name


class LeftOutWarning(UserWarning):
    """What a file asks for, and changes the motion, was left out as asked; see `linkax.Machine.left_out`."""


class _Gravity(Part):
    """Gravity, which has no name in linkax."""

    @property
    def name(self) -> str:
        return "gravity"


def _ends(joint: Part) -> Sequence[Place]:
    return joint.arguments["parent"], joint.arguments["child"]


def _neighbours(joints: Iterable[Part]) -> dict[str, set[str]]:
    """The names of the bodies that joints connect with each."""
    found: dict[str, set[str]] = {}
    for joint in joints:
        first, second = (place.body for place in _ends(joint))
        found.setdefault(first, set()).add(second)
        found.setdefault(second, set()).add(first)
    return found


def _connected(neighbours: dict[str, set[str]], body: str) -> set[str]:
    """The names of all bodies on a way from neighbour to neighbour, from one of them."""
    found, open_ones = {body}, [body]
    while open_ones:
        fresh = neighbours.get(open_ones.pop(), set()) - found
        found |= fresh
        open_ones += fresh
    return found
