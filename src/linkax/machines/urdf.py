"""Read URDF, with what closes loops in it: joints with the same child, <loop>, <constraint>, <coupling>, YAML.

The format: http://wiki.ros.org/urdf/XML. <loop> and <coupling> are of URDF+ (Chignoli, Slotine, Wensing, Kim, URDF+: An
Enhanced URDF for Robots with Kinematic Loops, 2024); <constraint> is that proposed for urdfdom (pull request 264).
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from linkax.machines.draft import Draft, Pose, body_name
from linkax.machines.parts import Place
from linkax.machines.poses import from_angles, from_quaternion, pose, turned
from linkax.machines.visuals import read_visual
from linkax.machines.xml import MachineFileError, Node, Where, library, read_file
from linkax.model.constraints.constraint import Coupling
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal
from linkax.model.names import meant

KINDS = {
    "revolute": Revolute, "continuous": Revolute, "prismatic": Prismatic, "fixed": Fixed, "floating": Free,
    "planar": Planar, "spherical": Spherical, "ball": Spherical, "universal": Universal, "cylindrical": Cylindrical,
}  # fmt: skip
WITH_AXIS = (Revolute, Prismatic, Planar, Cylindrical)
GRAVITY = (0.0, 0.0, -9.81)  # of which the format says nothing
READ = ("link", "joint", "material", "loop", "constraint", "coupling")
SEEN_ONLY = ("gazebo", "transmission", "sensor", "mujoco", "ros2_control")
MOVING = {  # in a <gazebo>, what moves a machine, with texts that say that it does not
    "joint": (), "link": (), "gravity": ("true", "1"), "turnGravityOff": ("false", "0"),
    "springStiffness": ("0", "0.0"), "dampingFactor": ("0", "0.0"),
}  # fmt: skip
ZERO = (0.0, 0.0, 0.0)
LOOPS_OF_YAML = {"3d": Spherical, "6d": Fixed}
OF_YAML = {  # what is known in a YAML file, and how to give it
    "closed_loop": "closed_loop: [[link, link], ...] and type: [3d, ...]",
    "type": "type: [3d, ...]",
    "joint_name": "joint_name: [joint, ...] and joint_type: [SPHERICAL, ...]",
    "joint_type": "joint_type: [SPHERICAL, ...]",
    "name_mot": "name_mot: [joint, ...]",
}


def read_urdf(root: Node, draft: Draft) -> None:
    """Fill a draft from the root of a URDF file, whose links stand as its tree of joints says.

    **Raises:** `MachineFileError` for what the format does not allow, with line and remedy.
    """
    _Robot(root, draft).read()
    draft.leave_out_unread(root)


class _Robot:
    """A robot that is read."""

    def __init__(self, root: Node, draft: Draft) -> None:
        self.root, self.draft = root, draft
        self.links = {body_name(link.name): link for link in root.all("link")}
        self.materials = {node.get("name"): node for node in root.all("material")}
        for material in self.materials.values():
            material.moves_nothing()
        self.joints: dict[str, Node] = {}
        self.carrier: dict[str, tuple[str, str]] = {}  # of a link: its parent in the tree of joints, and the joint

    def read(self) -> None:
        """Read links where the joints carry them, then joints, then what closes loops."""
        root, draft = self.root, self.draft
        draft.name = root.get("name")
        draft.gravity(GRAVITY, root.where)
        joints = root.all("joint")
        for joint in joints:
            child = self._link(joint, "child")
            self.carrier.setdefault(child, (self._link(joint, "parent"), joint.name))
        carried = {name for _, name in self.carrier.values()}
        self.joints = {joint.name: joint for joint in joints}
        for link in root.all("link"):
            self._body(link)
        for joint in joints:
            self._joint(joint, joint.name in carried)
        for node in root.all("loop", "constraint", "coupling"):
            if node.tag == "loop":
                ends = (self._end(node, "predecessor"), self._end(node, "successor", "sucessor"))
                self._loop(node, *ends, {"axis": node.find("axis")})
            elif node.tag == "constraint":
                self._constraint(node)
            else:
                self._coupling(node)
        for node in root:
            if node.tag not in READ:
                given = [(child.tag, child.text.strip().lower()) for child in node if node.tag == "gazebo"]
                moving = [tag for tag, text in given if tag in MOVING and text not in MOVING[tag]]
                known = node.tag in SEEN_ONLY and not moving
                reason = "does not move anything" if known else f"has <{moving[0]}>" if moving else "is not known"
                draft.leave_out(node.where, node.tag, f"<{node.tag}> {reason}", not known)

    def _link(self, node: Node, tag: str) -> str:
        """The name of the link at one end."""
        given = node.child(tag)
        name = body_name(given.get("link") or given.attribute("name"))
        if name not in self.links:
            raise given.where.error(f"{tag} is {name!r}, which is no link of the file")
        return name

    def _pose_of(self, link: str) -> Pose:
        """The pose of a link as drawn, from the joints that carry it."""
        way: list[str] = []
        while link not in self.draft.poses and link in self.carrier:
            if link in way:
                raise self.links[link].where.error(f"its joints go in a circle: {' → '.join([*way, link])}")
            way.append(link)
            link = self.carrier[link][0]
        found = self.draft.poses.get(link, np.eye(4))
        for each in reversed(way):
            found = found @ self._origin(self.joints[self.carrier[each][1]].find("origin"))
        return found

    def _origin(self, node: Node | None) -> Pose:
        """The pose in an <origin>, whose rotation URDF 1.1 may give as a quaternion, too."""
        if node is None:
            return np.eye(4)
        if node.get("quat_xyzw"):
            turn = node.numbers("quat_xyzw", 4)
            if node.get("rpy") or not np.any(turn):
                raise node.where.error("quat_xyzw is zero, or beside rpy; give one rotation")
            return pose(node.numbers("xyz", 3, ZERO), from_quaternion(turn[[3, 0, 1, 2]]))
        return pose(node.numbers("xyz", 3, ZERO), from_angles(self.draft.angles(node.numbers("rpy", 3, ZERO))))

    def _body(self, node: Node) -> None:
        inertial = node.find("inertial")
        mass, at, inertia = 0.0, np.eye(4), np.zeros((3, 3))
        if inertial is not None:
            at, mass = self._origin(inertial.find("origin")), float(inertial.child("mass").numbers("value", 1)[0])
            entry = lambda name, *default: float(inertial.child("inertia").numbers(name, 1, *default)[0])
            xx, yy, zz = map(entry, ("ixx", "iyy", "izz"))
            xy, xz, yz = (entry(name, [0.0]) for name in ("ixy", "ixz", "iyz"))
            inertia = turned(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), at[:3, :3])
        name = body_name(node.name)
        self.draft.body(name, self._pose_of(name), mass, at[:3, 3], inertia, node.where)
        for child in node.all("collision"):
            self.draft.leave_out(child.where, "contact", "contact of this shape with others")
        for child in node.all("visual"):
            self._visual(name, child)

    def _visual(self, link: str, node: Node) -> None:
        """A shape that is only seen; what is not kept of it is noted."""
        try:
            material = node.find("material")
            if material is not None and material.find("color") is None:
                material = self.materials.get(material.get("name"))
            colour = None if material is None else material.find("color")
            rgba = None if colour is None else colour.numbers("rgba", 4)
            read_visual(self.draft, link, node, self._origin(node.find("origin")), rgba)
        except ValueError as error:
            self.draft.leave_out(node.where, "visual", str(error), False)

    def _joint(self, node: Node, carries: bool) -> None:
        draft, where, kind = self.draft, node.where, node.attribute("type")
        if kind not in KINDS:
            draft.leave_out(where, "joint", f"a joint of type {kind!r}; linkax reads {', '.join(KINDS)}")
            return
        arguments = _axes(node, KINDS[kind], {"axis": node.find("axis")}) | ({} if carries else {"cut": True})
        ends = (
            Place.at(self._link(node, "parent"), self._origin(node.find("origin"))),
            Place.at(self._link(node, "child"), np.eye(4)),
        )
        draft.joint_at(KINDS[kind], node.name, *ends, where, **arguments)
        if KINDS[kind] not in (Revolute, Prismatic):
            self._leave_out_along(node, f"a joint of type {kind!r}, without one coordinate")
            return
        if (dynamics := node.find("dynamics")) is not None:
            damping, friction = (float(dynamics.numbers(name, 1, [0.0])[0]) for name in ("damping", "friction"))
            draft.along(node.name, node.name, dynamics.where, damping=damping, friction=friction)
        if (limit := node.find("limit")) is not None and kind != "continuous":
            lower, upper = (float(limit.numbers(end, 1, [0.0])[0]) for end in ("lower", "upper"))
            draft.limit(node.name, node.name, limit.where, lower, upper)
        if (mimic := node.find("mimic")) is not None:
            self._mimic(node, mimic)

    def _leave_out_along(self, node: Node, what: str) -> None:
        """Note what acts along a joint that it cannot act along here; nothing but <mimic> would move a fixed one."""
        kind, dynamics, limit, mimic = node.attribute("type"), *map(node.find, ("dynamics", "limit", "mimic"))
        if dynamics is not None and KINDS[kind] is not Fixed:
            for name in ("damping", "friction"):
                if np.any(dynamics.numbers(name, 1, [0.0])):
                    self.draft.leave_out(dynamics.where, name, f"{name} of {what}")
        if limit is not None and KINDS[kind] is not Fixed and kind != "continuous":
            lower, upper = (float(limit.numbers(end, 1, [0.0])[0]) for end in ("lower", "upper"))
            if lower < upper:
                self.draft.leave_out(limit.where, "limit", f"the range of {what}")
        if mimic is not None:
            self.draft.leave_out(mimic.where, "mimic", f"{mimic.attribute('joint')!r} is to lead {what}")

    def _mimic(self, node: Node, mimic: Node) -> None:
        """Its coordinate = multiplier × that of the leader + offset."""
        leader = mimic.attribute("joint")
        factor, offset = (float(mimic.numbers(*given)[0]) for given in (("multiplier", 1, [1.0]), ("offset", 1, [0.0])))
        kind = self.joints[leader].attribute("type") if leader in self.joints else None
        if KINDS.get(kind or "") not in (Revolute, Prismatic):
            what = "which is no joint of the file" if kind is None else f"of type {kind!r}, without one coordinate"
            self.draft.leave_out(mimic.where, "mimic", f"it follows {leader!r}, {what}")
            return
        self.draft.follow(f"{node.name}.mimic", mimic.where, node.name, leader, factor, offset)

    def _end(self, node: Node, *tags: str) -> Place:
        """The place of one end of a <loop>."""
        tag = next((tag for tag in tags if node.find(tag) is not None), tags[0])
        return Place.at(self._link(node, tag), self._origin(node.child(tag).find("origin")))

    def _constraint(self, node: Node) -> None:
        place = lambda end: Place.at(self._link(node, end), self._origin(node.find(f"{end}_origin")))
        self._loop(
            node,
            place("parent"),
            place("child"),
            {"axis": node.find("parent_axis"), "second_axis": node.find("child_axis")},
        )

    def _loop(self, node: Node, first: Place, second: Place, axes: Mapping[str, Node | None]) -> None:
        """A joint that closes a loop, with its frame on both links."""
        kind = node.attribute("type")
        if kind not in KINDS:
            self.draft.leave_out(node.where, node.tag, f"a loop of type {kind!r}; linkax reads {', '.join(KINDS)}")
            return
        arguments = _axes(node, KINDS[kind], axes)
        self.draft.joint_at(KINDS[kind], node.name, first, second, node.where, cut=True, **arguments)
        self._leave_out_along(node, f"a <{node.tag}>; give it to a joint of the tree")

    def _coupling(self, node: Node) -> None:
        """θ of the successor = ratio × θ of the predecessor, both from the nearest link that carries the two."""
        ratio = float(node.child("ratio").numbers("value", 1)[0])
        ways = [self._way(self._link(node, end)) for end in ("predecessor", "successor")]
        terms: dict[str, float] = {}
        for way, other, factor in ((ways[0], ways[1], -ratio), (ways[1], ways[0], 1.0)):
            for joint in way:
                kind = KINDS.get(self.joints[joint].attribute("type"))
                if joint in other or kind is Fixed:
                    continue
                if kind not in (Revolute, Prismatic):
                    raise node.where.error(f"joint {joint!r} on the way has not one coordinate; couple other links")
                terms[joint] = factor
        self.draft.constraint(Coupling, node.name, node.where, coefficients=terms, offset=0.0)

    def _way(self, link: str) -> list[str]:
        """The joints that carry a link, from the base."""
        way = []
        while link in self.carrier:
            link, joint = self.carrier[link]
            way.append(joint)
        return way


def close_by_yaml(draft: Draft, path: Path) -> None:
    """Close loops as a YAML file says, whose keys are those of Gepetto's example-parallel-robots.

    `closed_loop` has pairs of links that coincide, and `type` "3d" or "6d" for each. `joint_name` has joints of another
    type than in URDF, and `joint_type` for each SPHERICAL, FIXED, or UJOINT_XY: about x of its frame, then y.

    **Raises:** `MachineFileError` without PyYAML, and for a file that says it otherwise.
    """
    yaml = library("yaml", path, "YAML, which PyYAML")
    try:
        given = yaml.safe_load(read_file(path))
    except (yaml.YAMLError, RecursionError) as error:
        raise MachineFileError(f"{path.name}: no YAML, {' '.join(str(error).split())}; mend the file there") from error
    at = lambda key: Where(path, 1, key, "")
    if not isinstance(given, Mapping):
        raise at("closed_loop").error(f"the file has no closed_loop; give {OF_YAML['closed_loop']}")
    for key in map(str, given):
        if key not in OF_YAML:
            draft.leave_out(at(key), key, f"it is not known{meant(key, OF_YAML)}; known: {', '.join(OF_YAML)}")
    if "name_mot" in given:
        draft.leave_out(at("name_mot"), "name_mot", "which joints have motors; give them torques or drives", False)
    joints = [part.name for part in draft.joints]
    for name, word in _pairs(given, "joint_name", "joint_type", at("joint_name")):
        kind, axes = _kind_of_yaml(str(word), at("joint_type"))
        if str(name) in joints:
            draft.retype(str(name), kind, at("joint_type"), **axes)
        else:
            reason = f"{str(name)!r} is no joint of {draft.path.name}{meant(str(name), joints)}"
            draft.leave_out(at("joint_name"), "joint_name", reason)
    where = at("closed_loop")
    for index, (pair, word) in enumerate(_pairs(given, "closed_loop", "type", where, "6d")):
        ends = [body_name(str(link)) for link in pair] if isinstance(pair, list) else []
        if len(ends) != 2 or not all(map(draft.poses.__contains__, ends)):
            raise where.error(f"{pair!r} are not two links of {draft.path.name}")
        if str(word).lower() not in LOOPS_OF_YAML:
            raise where.error(f"type {word!r} of {pair!r} is not known; known: {', '.join(LOOPS_OF_YAML)}")
        first, second = (Place.at(end, np.eye(4)) for end in ends)
        kind = LOOPS_OF_YAML[str(word).lower()]
        draft.joint_at(kind, f"closed_loop[{index}]", first, second, where, cut=True)


def _pairs(given: Mapping, first: str, second: str, where: Where, usual: str | None = None) -> list[tuple[Any, Any]]:
    """What two lists of the same length say; the second may be absent where there is a usual word."""
    entries = given.get(first, [])
    words = given.get(second, [usual] * len(entries) if usual and isinstance(entries, list) else [])
    if not isinstance(entries, list) or not isinstance(words, list) or len(words) != len(entries):
        raise where.error(f"it and {second} must be lists of the same length; give {OF_YAML[first]}")
    return list(zip(entries, words, strict=True))


def _kind_of_yaml(word: str, where: Where) -> tuple[type, dict[str, Any]]:
    """The class of a joint, and its axes in its frame."""
    if found := re.fullmatch(r"UJOINT_([XYZ])([XYZ])", word):
        first, second = found.groups()
        if first != second:
            return Universal, {"axis": np.eye(3)["XYZ".index(first)], "second_axis": np.eye(3)["XYZ".index(second)]}
    elif word in ("SPHERICAL", "FIXED"):
        return (Spherical if word == "SPHERICAL" else Fixed), {}
    raise where.error(f"joint_type {word!r} is not known; known: SPHERICAL, FIXED, UJOINT_XY and its like")


def _axes(node: Node, kind: type, given: Mapping[str, Node | None]) -> dict[str, Any]:
    """The axes that a joint of a kind has, as its class takes them."""
    if kind is not Universal:
        return {"axis": _axis(given["axis"])} if kind in WITH_AXIS else {}
    if given.get("second_axis") is None:
        raise node.where.error("a universal joint needs two axes; give <constraint>, <parent_axis> and <child_axis>")
    return {name: _axis(axis) for name, axis in given.items()}


def _axis(node: Node | None):
    """The direction in an <axis>, by default x."""
    direction = np.array([1.0, 0.0, 0.0]) if node is None else node.numbers("xyz", 3, [1.0, 0.0, 0.0])
    if node is not None and not np.any(direction):
        raise node.where.error("xyz is 0 0 0; give a direction")
    return direction
