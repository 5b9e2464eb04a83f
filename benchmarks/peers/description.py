"""What a mechanism of hinges and slides is at its start, in numbers that any simulator takes."""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np

import linkax as lx

GROUND = -1
# Given to bodies without inertia about an axis that they do not turn about [kg m²]; several peers refuse zero.
SMALL_INERTIA = 1e-4

Kind = Literal["revolute", "prismatic"]
KINDS: dict[type, Kind] = {lx.Revolute: "revolute", lx.Prismatic: "prismatic"}


class Body(NamedTuple):
    """A rigid body at the start, in world axes.

    - `mass` [kg]; `center` of mass [m], (3,); `inertia` about it [kg m²], (3, 3).
    """

    name: str
    mass: float
    center: np.ndarray
    inertia: np.ndarray


class Joint(NamedTuple):
    """A hinge or a slide at the start, in world axes.

    - `parent`, `child`: indices of bodies, -1 for ground. A joint in the tree carries `child`.
    - `anchor`: a point of both bodies, on a hinge's axis, at the frame of a slide's child [m], (3,).
    - `axis`: unit vector, (3,).
    """

    name: str
    kind: Kind
    parent: int
    child: int
    anchor: np.ndarray
    axis: np.ndarray


@dataclasses.dataclass(frozen=True)
class Description:
    """A mechanism at its start: all bodies' axes parallel to the world's, all coordinates zero.

    - `tree`: the joint that carries each body, each body after the one that carries it.
    - `cuts`: hinges that close loops.
    - `speeds`: of the joints in the tree at the start [rad/s or m/s], (n,).
    - `gravity`: [m/s²], (3,).
    - `normal`: unit vector at right angles to all motion, (3,); None where motion is spatial.
    - `tracked`: a body and a point on it at the start [m], whose path tells how good a run is.
    """

    bodies: tuple[Body, ...]
    tree: tuple[Joint, ...]
    cuts: tuple[Joint, ...]
    speeds: np.ndarray
    gravity: np.ndarray
    normal: np.ndarray | None
    tracked: tuple[int, np.ndarray]

    @property
    def centers(self) -> np.ndarray:
        """Centres of mass at the start [m], (n + 1, 3); the last is ground's origin."""
        return np.array([*(body.center for body in self.bodies), np.zeros(3)])

    @property
    def loop_points(self) -> list[tuple[Joint, np.ndarray]]:
        """Cut joints and points at the start [m] that stay together on both their bodies where loops are closed.

        One point holds a hinge where all motion is planar, two on its axis elsewhere.
        """
        offsets = (0.0,) if self.normal is not None else (0.0, 0.5)
        return [(joint, joint.anchor + offset * joint.axis) for joint in self.cuts for offset in offsets]


def describe(
    mechanism: lx.Mechanism,
    state: lx.State,
    tracked: tuple[str, str | None] | None = None,
    cuts: tuple[str, ...] = (),
) -> Description:
    """The mechanism in an assembled state.

    The tree is linkax's, but for slides that close loops: those go into the tree, and a hinge of the loop is cut, since
    peers close loops by holding points together. Coordinates count from the start in the sense of linkax's own.

    Bodies without inertia about an axis get `SMALL_INERTIA` about it, as long as they never turn about it: about axes
    in the plane of a planar motion, and about all axes of a body that only slides.

    **Arguments:**

    - `tracked`: a body and one of its frames, or None for its centre of mass. Default: the last body's centre of mass.
    - `cuts`: names of hinges to cut instead of linkax's, of different loops.

    **Raises:** `ValueError` for other joints, constraints and forces, a loop of slides alone, massless bodies, and
    bodies without inertia about an axis that they turn about.
    """
    _check(mechanism)
    places = _Places(lx.Solution.of_state(mechanism, state))
    ranks = [(joint.name in cuts) - isinstance(joint, lx.Prismatic) for joint in mechanism.joints]
    tree, left = _split(mechanism.topology, ranks)
    order = {body: index for index, (_, _, body) in enumerate(tree)} | {GROUND: GROUND}
    tree_joints = tuple(_joint(mechanism, places, order, *edge) for edge in tree)
    ends = mechanism.topology.parent, mechanism.topology.child
    cut_joints = tuple(_joint(mechanism, places, order, index, *(end[index] for end in ends)) for index in left)
    for joint in cut_joints:
        if joint.kind == "prismatic":
            raise ValueError(f"joint {joint.name!r} closes a loop of slides alone, which peers cannot hold")
    normal = _normal([*tree_joints, *cut_joints])
    bodies = tuple(
        _body(mechanism.bodies[body], *places.of(body), _turns(tree_joints, order[body]), normal) for *_, body in tree
    )
    return Description(
        bodies=bodies,
        tree=tree_joints,
        cuts=cut_joints,
        speeds=np.array([_speed(mechanism, places.start, state, index) for index, *_ in tree]),
        gravity=sum((np.asarray(force.acceleration) for force in _gravities(mechanism)), np.zeros(3)),
        normal=normal,
        tracked=_tracked(mechanism, places, order, tracked or (mechanism.topology.bodies[tree[-1][-1]], None)),
    )


class _Places:
    """Where reference frames are at the start: origin [m] and axes as columns, by index of linkax's bodies."""

    def __init__(self, start: lx.Solution):
        self.start = start
        self._known = {GROUND: (np.zeros(3), np.eye(3))}

    def of(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        if body not in self._known:
            name = self.start.mechanism.topology.bodies[body]
            origin = self.start.position(name, at=[0.0, 0.0, 0.0])[0]
            self._known[body] = np.asarray(origin), np.asarray(self.start.orientation(name)[0])
        return self._known[body]


def _gravities(mechanism):
    return [force for force in mechanism.forces if isinstance(force, lx.Gravity)]


def _check(mechanism):
    for joint in mechanism.joints:
        if type(joint) not in KINDS:
            raise ValueError(f"joint {joint.name!r} is a {type(joint).__name__}; peers get Revolute and Prismatic only")
    if mechanism.constraints:
        raise ValueError(f"constraint {mechanism.constraints[0].name!r}: peers get joints only")
    for force in mechanism.forces:
        idle = isinstance(force, lx.JointTorque) and not callable(force.torque) and force.torque == 0.0
        if not idle and not isinstance(force, lx.Gravity):
            raise ValueError(f"{force.display_name}: peers get Gravity only")
    for body in mechanism.bodies:
        if body.mass <= 0.0:
            raise ValueError(f"body {body.name!r} has no mass; peers need some")


def _split(topology, ranks):
    """The tree as (joint, body that carries, body carried) from ground outwards, and the joints left over.

    Joints of lower rank come first, then those of linkax's tree; chosen, they are in linkax's order.
    """
    ranked = sorted(range(len(topology.joints)), key=lambda joint: ranks[joint])
    chosen = sorted(joint for joint, *_ in _grow(topology, ranked))
    return _grow(topology, chosen), [joint for joint in range(len(topology.joints)) if joint not in chosen]


def _grow(topology, joints):
    """A tree from ground outwards, always on by the first joint that reaches another body."""
    ends = list(zip(topology.parent, topology.child, strict=True))
    reached, tree = {GROUND}, []
    while len(tree) < topology.num_bodies:
        joint = next(joint for joint in joints if len(reached.intersection(ends[joint])) == 1)
        carrier, carried = sorted(ends[joint], key=lambda body: body not in reached)
        reached.add(carried)
        tree.append((joint, carrier, carried))
    return tree


def _joint(mechanism, places, order, index, parent, child):
    """A joint of the mechanism from one body to another, which turns its axis where it was declared the other way."""
    joint = mechanism.joints[index]
    declared = child == mechanism.topology.child[index]
    frame = joint.child if declared else joint.parent
    origin, axes = places.of(child)
    axis = axes @ np.asarray(joint.frames()[declared])[:, 0]
    anchor = origin + axes @ np.asarray(frame.offset)
    return Joint(joint.name, KINDS[type(joint)], order[parent], order[child], anchor, axis if declared else -axis)


def _normal(joints):
    """The direction that all hinges turn about and no slide moves along, if there is one."""
    hinges = [joint.axis for joint in joints if joint.kind == "revolute"]
    slides = [joint.axis for joint in joints if joint.kind == "prismatic"]
    if not hinges:
        return None
    aligned = all(np.linalg.norm(np.cross(hinges[0], axis)) < 1e-9 for axis in hinges)
    level = all(abs(hinges[0] @ axis) < 1e-9 for axis in slides)
    return hinges[0] if aligned and level else None


def _turns(tree, body):
    """Whether a hinge is on the way from ground to a body."""
    while body != GROUND:
        if tree[body].kind == "revolute":
            return True
        body = tree[body].parent
    return False


def _body(body, origin, axes, turns, normal):
    inertia = axes @ np.asarray(body.inertia) @ axes.T
    moments, directions = np.linalg.eigh(inertia)
    for axis in directions.T[moments < 1e-9 * max(moments[-1], SMALL_INERTIA)]:
        if turns and (normal is None or abs(axis @ normal) > 1e-9):
            raise ValueError(f"body {body.name!r} turns about {axis.round(6).tolist()}, where it has no inertia")
        inertia = inertia + SMALL_INERTIA * np.outer(axis, axis)
    return Body(body.name, float(body.mass), origin + axes @ np.asarray(body.center_of_mass), inertia)


def _speed(mechanism, start, state, index):
    """Of a joint in the tree: from the state, or for a slide that linkax has cut from the motion of its bodies."""
    name = mechanism.topology.joints[index]
    if index < mechanism.topology.num_bodies:
        return float(state.v[mechanism.topology.speeds[name]][0])
    return float(start.joint_speed(name)[0])


def _tracked(mechanism, places, order, tracked):
    name, frame = tracked
    body = mechanism.body(name)
    index = mechanism.topology.bodies.index(name)
    origin, axes = places.of(index)
    offset = body.center_of_mass if frame is None else body.at(frame).offset
    return order[index], origin + axes @ np.asarray(offset)
