"""Read SDF, the format of Gazebo: a graph of links and joints, in which links may have several parents.

Poses, frames and axes as http://sdformat.org/spec defines them, for versions up to 1.12.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft, Pose
from linkax.machines.poses import from_angles, from_quaternion, pose, relative, turned
from linkax.machines.visuals import read_visual
from linkax.machines.xml import Node, read_numbers
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
WORLD, MODEL = "world", "__model__"
SEEN_ONLY = ("sensor", "light", "audio_sink", "audio_source", "projector", "battery", "particle_emitter")
SETTINGS = (
    "pose",
    "inertial",
    "gravity",
    "enable_wind",
    "self_collide",
    "kinematic",
    "must_be_base_link",
    "velocity_decay",
)


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
    gravity = holder.find("gravity")
    acceleration = DEFAULT_GRAVITY if gravity is None else read_numbers(gravity.text, 3, gravity.where)
    for node in holder.all("include"):
        draft.leave_out(node.where, "include", "another file is included; put its model in its place")
    for node in holder.all("joint", "frame"):
        draft.leave_out(node.where, node.tag, "it is outside of the models; put it in one")
    draft.name = models[0].attributes.get("name", "")
    for model in models:
        prefix = f"{model.name}::" if len(models) > 1 else ""
        _Model(
            model, draft, prefix, np.asarray(acceleration), float(root.attributes.get("version", "1.6") or 1.6)
        ).read()
    draft.gravity(acceleration, (gravity or holder).where)


class _Model:
    """A model that is read: its frames by name."""

    def __init__(self, node: Node, draft: Draft, prefix: str, gravity: Float[np.ndarray, "3"], version: float) -> None:
        self.node, self.draft, self.prefix, self.gravity, self.version = node, draft, prefix, gravity, version
        self.own = self._raw_pose(node)
        self.nodes = {child.name: child for child in node.all("link", "joint", "frame")}
        if len(self.nodes) < len(node.all("link", "joint", "frame")):
            names = [child.name for child in node.all("link", "joint", "frame")]
            twice = next(child for child in node.all("link", "joint", "frame") if names.count(child.name) > 1)
            raise twice.where.error("the name is there twice; give each link, joint and frame a name of its own")
        self.found: dict[str, Pose] = {WORLD: np.eye(4), MODEL: self.own, "": self.own}
        self.links = [link.name for link in node.all("link")]
        self.canonical = node.attributes.get("canonical_link", "") or next(iter(self.links), "")

    def read(self) -> None:
        """Read links, then joints."""
        for child in self.node:
            if child.tag in ("model", "include"):
                self.draft.leave_out(child.where, child.tag, "a model inside of a model; put its links in this one")
            elif child.tag in ("plugin", "gripper", "enable_wind", "allow_auto_disable"):
                self.draft.leave_out(child.where, child.tag, f"<{child.tag}> is for Gazebo", False)
            elif child.tag == "self_collide" and child.text.strip() not in ("0", "false"):
                self.draft.leave_out(child.where, "contact", "links of the model collide with each other")
        for link in self.node.all("link"):
            self._link(link)
        if (self.node.content("static") or "false") in ("1", "true"):
            for name in self.links:
                where = self.nodes[name].where
                self.draft.joint(
                    Fixed, f"{self.prefix}{name}.static", GROUND_NAME, self.prefix + name, self.pose_of(name), where
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
            return self._body(node, "child")
        return node.attributes.get("attached_to", "") if node.tag == "frame" else ""

    def _known(self) -> str:
        names = list(self.nodes)
        return ", ".join(map(repr, names[:8])) + (", ..." if len(names) > 8 else "")

    def _link(self, node: Node) -> None:
        draft, where = self.draft, node.where
        inertial = node.find("inertial")
        if inertial is not None and inertial.attributes.get("auto", "false") in ("true", "1"):
            draft.leave_out(inertial.where, "inertial", "mass and inertia from the shape of collisions")
        at = self._raw_pose(inertial) if inertial is not None else np.eye(4)
        mass = 1.0 if inertial is None else inertial.number("mass", 1.0)
        entry = lambda name, default: default if inertial is None else inertial.number(f"inertia/{name}", default)
        xx, yy, zz = (entry(name, 1.0) for name in ("ixx", "iyy", "izz"))
        xy, xz, yz = (entry(name, 0.0) for name in ("ixy", "ixz", "iyz"))
        inertia = turned(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), at[:3, :3])
        draft.body(self.prefix + node.name, self.pose_of(node.name), mass, at[:3, 3], inertia, where)
        if (node.content("gravity") or "true") in ("0", "false"):
            draft.carry(self.prefix + node.name, at[:3, 3], -mass * self.gravity, where)
        for child in node:
            if child.tag == "collision":
                draft.leave_out(child.where, "contact", "contact of this shape with others")
            elif child.tag == "visual":
                self._visual(node, child)
            elif child.tag in SEEN_ONLY:
                draft.leave_out(child.where, child.tag, f"<{child.tag}> does not move anything", False)
            elif child.tag == "velocity_decay" and any(float(each.text or 0) for each in child):
                draft.leave_out(child.where, "velocity_decay", "damping of the link in the air")
            elif child.tag not in SETTINGS:
                draft.leave_out(child.where, child.tag, f"<{child.tag}> is not known", False)

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
            read_visual(self.draft, self.prefix + link.name, node, at, colour)
        except ValueError as error:
            self.draft.leave_out(node.where, "visual", str(error), False)

    def _body(self, node: Node, end: str) -> str:
        """The link at one end of a joint, "world" for the ground.

        An end may be a frame; a frame that is attached to the model is on its canonical link.
        """
        given = node.child(end)
        named = (given.text or "").strip() or given.attributes.get("link", "")
        seen = []
        while named in self.nodes and self.nodes[named].tag == "frame":
            if named in seen:
                raise self.nodes[named].where.error("it is attached to itself; attach it to a link")
            seen.append(named)
            named = self.nodes[named].attributes.get("attached_to", "") or MODEL
        if named == MODEL:
            named = self.canonical
        if named != WORLD and named not in self.links:
            raise given.where.error(f"{end} is {named!r}, which is no link of the model; known: {self._known()}")
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
        axes = [axis for axis in (node.find("axis"), node.find("axis2")) if axis is not None]
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
        body = lambda link: GROUND_NAME if link == WORLD else self.prefix + link
        draft.joint(KINDS[kind], name, body(parent), body(child), frame, where, **arguments)
        for index, axis in enumerate(axes):
            if index >= len(KINDS[kind].speed_units) or KINDS[kind] is Spherical:
                draft.leave_out(axis.where, "axis", f"a joint of type {kind!r} has no such axis", False)
                continue
            along = name if len(KINDS[kind].speed_units) == 1 else (name, index)
            self._along(along, name + ("" if index == 0 else ".2"), axis, kind)
        for child_node in node:
            if child_node.tag in ("sensor", "physics"):
                draft.leave_out(child_node.where, child_node.tag, f"<{child_node.tag}> is for Gazebo", False)

    def _along(self, along: Any, name: str, axis: Node, kind: str) -> None:
        """Springs, dampers, friction and stops along an axis."""
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
        named = "" if given is None else given.attributes.get("expressed_in", "")
        if (axis.content("use_parent_model_frame") or "0") in ("1", "true") or (self.version < 1.5 and not named):
            named = MODEL
        if not named:
            return direction
        return relative(self.pose_of(named, axis), frame)[:3, :3] @ direction

    def _raw_pose(self, node: Node) -> Pose:
        """The numbers in the <pose> of an element."""
        given = node.find("pose")
        if given is None or not given.text.strip():
            return np.eye(4)
        if given.attributes.get("rotation_format", "euler_rpy") == "quat_xyzw":
            numbers = read_numbers(given.text, 7, given.where)
            return pose(numbers[:3], from_quaternion(numbers[[6, 3, 4, 5]]))
        numbers = read_numbers(given.text, 6, given.where)
        if given.attributes.get("degrees", "false") in ("1", "true"):
            return pose(numbers[:3], from_angles(np.radians(numbers[3:])))
        return pose(numbers[:3], from_angles(self.draft.angles(numbers[3:])))

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
        hinges = [node for node in self.node.all("joint") if node.attributes.get("type") in ("revolute", "continuous")]
        return next(
            (node for node in hinges if {self._body(node, "parent"), self._body(node, "child")} == {first, second}),
            None,
        )

    def _mimic(self, node: Node, index: int, mimic: Node) -> None:
        """follower = multiplier × (leader − reference) + offset."""
        leader, other = mimic.attribute("joint"), mimic.attributes.get("axis", "axis") == "axis2"
        if leader not in self.nodes or self.nodes[leader].tag != "joint":
            raise mimic.where.error(f"it follows {leader!r}, which is no joint of the model")
        factor, reference = mimic.number("multiplier", 1.0), mimic.number("reference", 0.0)
        ends = [(self.nodes[leader], int(other)), (node, index)]
        terms = [_term(self.prefix + each.name, KINDS[each.attribute("type")], which) for each, which in ends]
        name = f"{self.prefix}{node.name}.mimic" + ("" if index == 0 else ".2")
        offset = mimic.number("offset", 0.0) - factor * reference
        self.draft.constraint(
            Coupling, name, mimic.where, coefficients={terms[1]: 1.0, terms[0]: -factor}, offset=offset
        )


def _relative_to(node: Node) -> str:
    """The frame that the <pose> of an element names, which older versions call `frame`; "" for none."""
    given = node.find("pose")
    return "" if given is None else given.attributes.get("relative_to", given.attributes.get("frame", ""))


def _term(name, kind, index):
    return name if len(kind.speed_units) == 1 else (name, index)


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
    if node.find("screw_thread_pitch") is not None:
        return node.number("screw_thread_pitch") / (2.0 * np.pi)
    return -1.0 / node.number("thread_pitch", 1.0)
