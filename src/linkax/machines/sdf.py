"""Read SDF, the format of Gazebo: a graph of links and joints, in which links may have several parents.

Poses, frames and axes as http://sdformat.org/spec defines them, for versions up to 1.12.
"""

import re
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft, Pose, body_name
from linkax.machines.poses import from_angles, from_quaternion, inverse, pose, relative, turned
from linkax.machines.visuals import read_visual
from linkax.machines.xml import Node, Where, read_numbers
from linkax.model.bodies import GROUND_NAME
from linkax.model.constraints.constraint import Coupling
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.screw import Screw
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal

KINDS = {
    "revolute": Revolute, "continuous": Revolute, "prismatic": Prismatic, "ball": Spherical, "fixed": Fixed,
    "universal": Universal, "revolute2": Universal, "screw": Screw,
}  # fmt: skip
DEFAULT_GRAVITY = (0.0, 0.0, -9.8)
NO_LIMIT = 1e16
AXES = ("axis", "axis2")
COUNTS = {"euler_rpy": 6, "quat_xyzw": 7}  # of the numbers of a pose, by how they give its rotation
WORLD, MODEL = "world", "__model__"
SETTINGS = {  # that change how a link or a model moves where they are true: the kind of thing, and what it is
    "self_collide": ("contact", "links of the model collide with each other"),
    "kinematic": ("kinematic", "the link is moved, and not by forces"),
    "enable_wind": ("fluid", "wind moves it"),
}


def read_sdf(root: Node, draft: Draft) -> None:
    """Fill a draft from the root of an SDF file.

    **Raises:** `MachineFileError` for what the format does not allow, with line and remedy.
    """
    worlds = root.all(WORLD)
    if len(worlds) > 1:
        raise worlds[1].where.error("a second world; keep one in the file")
    holder = worlds[0] if worlds else root
    models = holder.all("model")
    if not models:
        raise holder.where.error("no <model> in it; give a file of a machine")
    if not worlds and len(models) > 1:
        raise models[1].where.error("a second model outside of a world; put both in a <world>")
    version = _version(root)
    gravity = holder.find("gravity")
    if gravity is None and version < (1, 6):
        gravity = holder.find("physics/gravity")
    acceleration = DEFAULT_GRAVITY if gravity is None else read_numbers(gravity.text, 3, gravity.where)
    for node in holder.all("include"):
        draft.leave_out(node.where, "include", "another file is included; put its model in its place")
    for node in holder.all("joint", "frame"):
        draft.leave_out(node.where, node.tag, "it is outside of the models; put it in one")
    draft.name = models[0].get("name")
    for model in models:
        prefix = f"{model.name}::" if len(models) > 1 else ""
        _Model(model, draft, prefix, np.asarray(acceleration), version).read()
    draft.gravity(acceleration, (gravity or holder).where)
    draft.leave_out_unread(root)


def _version(root: Node) -> tuple[int, ...]:
    """The version of the format as numbers that can be compared: 1.10 is newer than 1.9."""
    text = root.get("version", "1.6")
    if not re.fullmatch(r"[0-9]+(\.[0-9]+)+", text):
        raise root.where.error(f'version is {text!r}; give one such as version="1.9"')
    return tuple(map(int, text.split(".")))


class _Model:
    """A model that is read: its frames by name."""

    def __init__(
        self, node: Node, draft: Draft, prefix: str, gravity: Float[np.ndarray, "3"], version: tuple[int, ...]
    ) -> None:
        self.node, self.draft, self.prefix, self.gravity, self.version = node, draft, prefix, gravity, version
        self.nodes = {child.name: child for child in node.all("link", "joint", "frame")}
        if len(self.nodes) < len(node.all("link", "joint", "frame")):
            names = [child.name for child in node.all("link", "joint", "frame")]
            twice = next(child for child in node.all("link", "joint", "frame") if names.count(child.name) > 1)
            raise twice.where.error("the name is there twice; give each link, joint and frame a name of its own")
        self.found: dict[str, Pose] = {name: np.eye(4) for name in (WORLD, MODEL, "")}
        own = self._pose_in(node, "the world") @ inverse(self.pose_of(node.get("placement_frame"), node))
        self.found = {WORLD: np.eye(4), MODEL: own, "": own}
        self.links = [link.name for link in node.all("link")]
        self.canonical = node.get("canonical_link") or next(iter(self.links), "")

    def read(self) -> None:
        """Read links, then joints."""
        for child in self.node.all("model", "include"):
            self.draft.leave_out(child.where, child.tag, "a model inside of a model; put its links in this one")
        self._settings(self.node)
        for link in self.node.all("link"):
            self._link(link)
        if _is_true(self.node.find("static")):
            for name in self.links:
                where = self.nodes[name].where
                self.draft.joint(
                    Fixed, f"{self.prefix}{name}.static", GROUND_NAME, self._called(name), self.pose_of(name), where
                )
        gearboxes = [node for node in self.node.all("joint") if node.attribute("type") == "gearbox"]
        for node in self.node.all("joint"):
            if node not in gearboxes:
                self._joint(node)
        for node in gearboxes:
            self._gearbox(node)
        for node in self.node.all("joint"):
            for index, axis in enumerate(node.all("axis", "axis2")):
                if (mimic := axis.find("mimic")) is not None:
                    self._mimic(node, index, mimic)

    def pose_of(self, name: str, asked_by: Node | None = None) -> Pose:
        """The pose in the world of a link, a joint or a frame, or of the model.

        Iterates towards the world, however long the chain of frames is.
        """
        way: list[str] = []
        while name not in self.found:
            node = self.nodes.get(name)
            if node is None:
                raise (asked_by or self.node).where.error(f"frame {name!r} is not in the model; known: {self._known()}")
            if name in way:
                raise node.where.error(f"its pose goes in a circle: {' → '.join([*way, name])}; begin at a link")
            way.append(name)
            asked_by, name = node, self._reference(node)
        for each in reversed(way):
            self.found[each] = self.found[self._reference(self.nodes[each])] @ self._raw_pose(self.nodes[each])
        return self.found[way[0] if way else name]

    def _reference(self, node: Node) -> str:
        """The name of the frame that the pose of a link, joint or frame is in."""
        if named := _relative_to(node):
            return named
        if node.tag == "joint":
            return _end_of(node, "child")
        return node.get("attached_to") if node.tag == "frame" else ""

    def _called(self, link: str) -> str:
        """What linkax calls a link, or the world."""
        return GROUND_NAME if link == WORLD else body_name(self.prefix + link)

    def _known(self) -> str:
        names = list(self.nodes)
        return ", ".join(map(repr, names[:8])) + (", ..." if len(names) > 8 else "")

    def _link(self, node: Node) -> None:
        draft, where = self.draft, node.where
        inertial = node.find("inertial")
        if inertial is not None:
            if _truth(inertial.get("auto", "false"), inertial.where):
                draft.leave_out(inertial.where, "inertial", "mass and inertia from the shape of collisions")
            for added in inertial.all("fluid_added_mass"):
                draft.leave_out(added.where, "fluid", "mass of the medium that moves with the link")
        at = self._pose_in(inertial, "the link") if inertial is not None else np.eye(4)
        mass = 1.0 if inertial is None else inertial.number("mass", 1.0)
        entry = lambda name, default: default if inertial is None else inertial.number(f"inertia/{name}", default)
        xx, yy, zz = (entry(name, 1.0) for name in ("ixx", "iyy", "izz"))
        xy, xz, yz = (entry(name, 0.0) for name in ("ixy", "ixz", "iyz"))
        inertia = turned(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), at[:3, :3])
        draft.body(self._called(node.name), self.pose_of(node.name), mass, at[:3, 3], inertia, where)
        if not _is_true(node.find("gravity"), True):
            draft.carry(self._called(node.name), at[:3, 3], -mass * self.gravity, where)
        for child in node.all("collision"):
            draft.leave_out(child.where, "contact", "contact of this shape with others")
        for child in node.all("visual"):
            self._visual(node, child)
        if any(node.number(f"velocity_decay/{of}", 0.0) for of in ("linear", "angular")):
            draft.leave_out(node.child("velocity_decay").where, "velocity_decay", "damping of the link in the air")
        self._settings(node)

    def _settings(self, node: Node) -> None:
        """Note what is set for a link or the model, and linkax does not model."""
        for tag, (kind, reason) in SETTINGS.items():
            if (given := node.find(tag)) is not None and _is_true(given):
                self.draft.leave_out(given.where, kind, reason)

    def _visual(self, link: Node, node: Node) -> None:
        """A shape that is only seen; what is not kept of it is noted."""
        try:
            at = self._raw_pose(node)
            if named := _relative_to(node):
                at = relative(self.pose_of(named, node) @ at, self.pose_of(link.name))
            material = node.find("material")
            colours = [] if material is None else material.all("diffuse", "ambient")
            colour = _colour(max(colours, key=lambda each: each.tag)) if colours else None
            if colour is not None:
                colour[3] *= 1.0 - node.number("transparency", 0.0)
            read_visual(self.draft, self._called(link.name), node, at, colour)
        except ValueError as error:
            self.draft.leave_out(node.where, "visual", str(error), False)

    def _body(self, node: Node, end: str) -> str:
        """The link at one end of a joint, "world" for the ground.

        An end may be a frame; a frame that is attached to the model is on its canonical link.
        """
        named = _end_of(node, end)
        seen = []
        while named in self.nodes and self.nodes[named].tag == "frame":
            if named in seen:
                raise self.nodes[named].where.error("it is attached to itself; attach it to a link")
            seen.append(named)
            named = self.nodes[named].get("attached_to") or MODEL
        if named == MODEL:
            named = self.canonical
        if named != WORLD and named not in self.links:
            raise node.child(end).where.error(
                f"{end} is {named!r}, which is no link of the model; known: {self._known()}"
            )
        return named

    def _joint(self, node: Node) -> None:
        draft, where, kind = self.draft, node.where, node.attribute("type")
        if kind not in KINDS:
            draft.leave_out(where, "joint", f"a joint of type {kind!r}; linkax reads {', '.join(KINDS)} and gearbox")
            return
        parent, child = self._body(node, "parent"), self._body(node, "child")
        if parent == child:
            raise where.error(f"parent and child are the same link {parent!r}; give two")
        frame = self.pose_of(node.name)
        axes = [axis for axis in map(node.find, AXES) if axis is not None]
        directions = [self._direction(axis, frame) for axis in axes]
        arguments: dict[str, Any] = {}
        if KINDS[kind] in (Revolute, Prismatic, Screw):
            if not axes:
                raise where.error(f"a joint of type {kind!r} has no <axis>; give one")
            arguments["axis"] = directions[0]
        if KINDS[kind] is Universal:
            if len(axes) < 2:
                raise where.error(f"a joint of type {kind!r} needs <axis> and <axis2>; give both")
            arguments |= {"axis": directions[0], "second_axis": directions[1]}
        if KINDS[kind] is Screw:
            arguments["pitch"] = _pitch(node)
        name = self.prefix + node.name
        draft.joint(KINDS[kind], name, self._called(parent), self._called(child), frame, where, **arguments)
        for index, axis in enumerate(axes):
            if index >= len(KINDS[kind].speed_units) or KINDS[kind] is Spherical:
                draft.leave_out(axis.where, "axis", f"a joint of type {kind!r} has no such axis", False)
                continue
            along = name if len(KINDS[kind].speed_units) == 1 else (name, index)
            self._along(along, name + ("" if index == 0 else ".2"), axis, kind)

    def _along(self, along: Any, name: str, axis: Node, kind: str) -> None:
        """Springs, dampers, friction and stops along an axis."""
        if axis.number("initial_position", 0.0):
            reason = "where the joint is at the start; give it to linkax.assemble"
            self.draft.leave_out(axis.where, "initial_position", reason, False)
        self.draft.along(
            along, name, axis.where,
            stiffness=axis.number("dynamics/spring_stiffness", 0.0), free=axis.number("dynamics/spring_reference", 0.0),
            damping=axis.number("dynamics/damping", 0.0), friction=axis.number("dynamics/friction", 0.0),
        )  # fmt: skip
        limit = axis.find("limit")
        if limit is None or kind == "continuous":
            return
        stiffness = limit.number("stiffness") if limit.find("stiffness") is not None else None
        ends = _end(limit, "lower"), _end(limit, "upper")
        self.draft.limit(along, name, limit.where, *ends, stiffness=stiffness)

    def _direction(self, axis: Node, frame: Pose) -> Float[np.ndarray, "3"]:
        """An axis in the joint's frame."""
        given = axis.find("xyz")
        direction = np.array([0.0, 0.0, 1.0]) if given is None else read_numbers(given.text, 3, given.where)
        if not np.any(direction):
            raise axis.where.error("<xyz> is 0 0 0; give a direction")
        named = "" if given is None else given.get("expressed_in")
        if _is_true(axis.find("use_parent_model_frame")) or (self.version < (1, 5) and not named):
            named = MODEL
        if not named:
            return direction
        return relative(self.pose_of(named, axis), frame)[:3, :3] @ direction

    def _pose_in(self, node: Node, base: str) -> Pose:
        """The pose of an element that has to be given in one frame."""
        if named := _relative_to(node):
            raise node.where.error(f"its pose is relative to {named!r}; give it in {base}")
        return self._raw_pose(node)

    def _raw_pose(self, node: Node) -> Pose:
        """The numbers in the <pose> of an element."""
        given = node.find("pose")
        if given is None or not given.text.strip():
            return np.eye(4)
        kind, in_degrees = given.get("rotation_format", "euler_rpy"), _truth(given.get("degrees", "false"), given.where)
        if kind not in COUNTS:
            raise given.where.error(f"rotation_format is {kind!r}; known: {', '.join(COUNTS)}")
        numbers = read_numbers(given.text, COUNTS[kind], given.where)
        place, turn = numbers[:3], numbers[3:]
        if kind == "euler_rpy":
            return pose(place, from_angles(np.radians(turn) if in_degrees else self.draft.angles(turn)))
        if not np.any(turn):
            raise given.where.error("its quaternion is 0 0 0 0; give one of length 1")
        return pose(place, from_quaternion(turn[[3, 0, 1, 2]]))

    def _gearbox(self, node: Node) -> None:
        """θ₂ = −ratio θ₁, of child and parent seen from the reference body, about <axis2> and <axis>."""
        draft, where = self.draft, node.where
        reference = node.content("gearbox_reference_body") or ""
        ratio, frame = node.number("gearbox_ratio", 1.0), self.pose_of(node.name)
        terms: dict[str, float] = {}
        for end, tag, factor in (("parent", "axis", ratio), ("child", "axis2", 1.0)):
            link, axis = self._body(node, end), node.child(tag)
            joint = self._hinge_between(reference, link)
            if joint is None:
                draft.leave_out(where, "gearbox", f"no hinge connects {link!r} with its reference body {reference!r}")
                return
            wanted = frame[:3, :3] @ self._direction(axis, frame)
            own_frame = self.pose_of(joint.name)
            own = own_frame[:3, :3] @ self._direction(joint.child("axis"), own_frame)
            cosine = wanted @ own / np.linalg.norm(wanted) / np.linalg.norm(own)
            if abs(abs(cosine) - 1.0) > 1e-6:
                draft.leave_out(where, "gearbox", f"its {tag} is not along that of joint {joint.name!r}")
                return
            forward = self._body(joint, "child") == link
            terms[self.prefix + joint.name] = factor * float(np.sign(cosine) if forward else -np.sign(cosine))
        draft.constraint(Coupling, self.prefix + node.name, where, coefficients=terms, offset=0.0)

    def _hinge_between(self, first: str, second: str) -> Node | None:
        hinges = [node for node in self.node.all("joint") if node.get("type") in ("revolute", "continuous")]
        return next(
            (node for node in hinges if {self._body(node, "parent"), self._body(node, "child")} == {first, second}),
            None,
        )

    def _mimic(self, node: Node, index: int, mimic: Node) -> None:
        """follower = multiplier × (leader − reference) + offset."""
        leader, axis = mimic.attribute("joint"), mimic.get("axis", "axis")
        if leader not in self.nodes or self.nodes[leader].tag != "joint":
            raise mimic.where.error(f"it follows {leader!r}, which is no joint of the model")
        if axis not in AXES:
            raise mimic.where.error(f"axis is {axis!r}; known: {', '.join(AXES)}")
        factor, reference = mimic.number("multiplier", 1.0), mimic.number("reference", 0.0)
        follower, ahead = self._coordinate(node, index), self._coordinate(self.nodes[leader], AXES.index(axis))
        if follower is None or ahead is None:
            reason = f"linkax has no coordinate about {AXES[index]}, or {axis} of {leader!r}"
            self.draft.leave_out(mimic.where, "mimic", reason)
            return
        name = f"{self.prefix}{node.name}.mimic" + ("" if index == 0 else ".2")
        offset = mimic.number("offset", 0.0) - factor * reference
        self.draft.follow(name, mimic.where, follower, ahead, factor, offset)

    def _coordinate(self, joint: Node, index: int) -> str | tuple[str, int] | None:
        """What linkax calls the coordinate along an axis of a joint; None where it has none there."""
        kind, name = KINDS.get(joint.attribute("type")), self.prefix + joint.name
        count = 0 if kind in (None, Spherical) else len(kind.speed_units)
        return None if index >= count else name if count == 1 else (name, index)


def _relative_to(node: Node) -> str:
    """The frame that the <pose> of an element names, which older versions call `frame`; "" for none."""
    given = node.find("pose")
    return "" if given is None else given.get("relative_to", given.get("frame"))


def _end_of(node: Node, end: str) -> str:
    """The name of the link or frame at one end of a joint."""
    given = node.child(end)
    return given.text.strip() or given.get("link")


def _is_true(node: Node | None, default: bool = False) -> bool:
    """What the text of an element says, if it is there."""
    return default if node is None else _truth(node.text, node.where)


def _truth(text: str, where: Where) -> bool:
    word = text.strip().lower()
    if word not in ("0", "1", "false", "true"):
        raise where.error(f"{text.strip()[:60]!r} is neither true nor false; give one of them")
    return word in ("1", "true")


def _colour(node: Node) -> Float[np.ndarray, "4"]:
    """Red, green, blue and opacity, which is 1 where it is not there."""
    count = min(max(len(node.text.split()), 3), 4)
    return np.append(read_numbers(node.text, count, node.where), 1.0)[:4]


def _end(limit: Node, name: str) -> float | None:
    """One end of a range, None where it is open."""
    text = (limit.content(name) or "inf").lower()
    end = NO_LIMIT if text.lstrip("+-") in ("inf", "infinity") else limit.number(name)
    return None if abs(end) >= NO_LIMIT else end


def _pitch(node: Node) -> float:
    """The advance for one radian [m/rad]; the older `thread_pitch` is radians for one metre, and left-handed."""
    if node.find("thread_pitch") is None or node.find("screw_thread_pitch") is not None:
        return node.number("screw_thread_pitch") / (2.0 * np.pi)
    turns = node.number("thread_pitch")
    if not turns:
        raise node.where.error("thread_pitch is 0; give radians for one metre, or <screw_thread_pitch>")
    return -1.0 / turns
