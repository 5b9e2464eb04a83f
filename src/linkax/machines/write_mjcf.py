"""Write a mechanism as MJCF, the format of MuJoCo, and its motion in the coordinates of MuJoCo.

What the elements mean: https://mujoco.readthedocs.io/en/stable/XMLreference.html. The text is written here, since
MuJoCo's own writer keeps six digits.
"""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from linkax.files import written_whole
from linkax.machines.poses import inverse, pose, to_quaternion
from linkax.model.bodies import Frame, RigidBody
from linkax.model.constraints.constraint import Coupling
from linkax.model.constraints.polynomial_coupling import PolynomialCoupling
from linkax.model.forces.affine_actuator import AffineActuator
from linkax.model.forces.force import Gravity
from linkax.model.forces.joint_forces import JointDamper, JointFriction, JointInertia, JointSpring, JointTorque
from linkax.model.forces.joint_limits import JointLimit
from linkax.model.forces.point_forces import Damper, Spring
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.distance import Distance
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.joint import AbstractJoint
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.rectangular import Rectangular
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.screw import Screw
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import listed, require_type, value
from linkax.model.terms import Combination, Term
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.start.state import State
from linkax.spatial.quaternions import conjugate, multiply, rotation_matrix
from linkax.xla.tracing import all_concrete

LEAST = 2e-15  # mass [kg] and moments of inertia [kg m²]; MuJoCo refuses moving bodies with less than 1e-15
SLACK = 1e-12  # of the largest moment of inertia, by which the others exceed it at least, as MuJoCo does not round
NO_END = 1e10  # of a range with one end [rad or m], MuJoCo's largest number
MOST_COEFFICIENTS = 5  # of MuJoCo's polynomials


class Piece(NamedTuple):
    """A joint of MuJoCo, of which those of linkax consist.

    - `index`: of the speed of linkax's joint, the first of three for a ball. `axis`: h¹, h² or h³, from 0.
    - `advances`: a slide that a thread moves with the turn.
    """

    kind: Literal["hinge", "slide", "ball", "free"]
    index: int
    axis: int
    advances: bool = False


# From the parent on, as each moves all that follow.
PIECES: dict[type, tuple[Piece, ...]] = {
    Fixed: (),
    Revolute: (Piece("hinge", 0, 0),),
    Prismatic: (Piece("slide", 0, 0),),
    Spherical: (Piece("ball", 0, 0),),
    Universal: (Piece("hinge", 0, 0), Piece("hinge", 1, 1)),
    Cylindrical: (Piece("slide", 1, 0), Piece("hinge", 0, 0)),
    Planar: (Piece("slide", 1, 1), Piece("slide", 2, 2), Piece("hinge", 0, 0)),
    Rectangular: (Piece("slide", 0, 1), Piece("slide", 1, 2)),
    Screw: (Piece("slide", 0, 0, advances=True), Piece("hinge", 0, 0)),
    Free: (Piece("slide", 3, 0), Piece("slide", 4, 1), Piece("slide", 5, 2), Piece("ball", 0, 0)),
}
FREE = (Piece("free", 0, 0),)
CLOSES = (Revolute, Spherical, Fixed, Distance)  # joints that MuJoCo has an equality for
ATTRIBUTES: dict[type, tuple[str, str]] = {
    JointDamper: ("damping", "damping"),
    JointFriction: ("frictionloss", "torque"),
    JointInertia: ("armature", "inertia"),
}


def to_mjcf(
    mechanism: Mechanism,
    path: str | os.PathLike[str] | None = None,
    *,
    state: State | None = None,
    ignore: Iterable[str] = (),
) -> str:
    """Write a mechanism as MJCF, for MuJoCo and all that reads its format.

    ```python
    text = lx.to_mjcf(mechanism, "four_bar.xml", state=state)
    model = mujoco.MjModel.from_xml_string(text)
    qpos, qvel = lx.mujoco_trajectory(solution)  # in the order of this model
    ```

    Bodies are nested by the spanning tree, and drawn where all its coordinates are zero; `qpos` of hinges and slides
    are linkax's coordinates. A joint that MuJoCo does not have becomes several, named `joint[index]` by the index of
    the speed; a `Screw` becomes a hinge, a slide and an equality. A `Free` joint becomes a freejoint where its parent
    is the ground and nothing acts along it. Frames on bodies become sites.

    Loops are closed by `<equality>`: two connects on the axis of a `Revolute`, a connect for a `Spherical`, a weld for
    a `Fixed` joint, a tendon for a `Distance`. `Coupling` and `PolynomialCoupling` are equalities, too. MuJoCo keeps
    them softly: loops gape by what its `solref` and `solimp` allow.

    Of forces MuJoCo gets `Gravity`, `JointSpring`, `JointDamper`, `JointInertia`, `Spring`, `Damper`, and as actuators
    `JointTorque` and `AffineActuator`, whose constant control is in the bias: MuJoCo's control is added to it. It has
    laws of its own for `JointFriction`, dry friction without a scale, and for `JointLimit`, a stop without a contact
    law. There are no shapes, and contact is off.

    Numbers have all digits. Where a body has no mass, or no inertia about an axis, it gets 2e-15 kg or kg m², since
    MuJoCo refuses zero; the smallest moment of a thin or flat body grows by 1e-12 of the largest.

    **Arguments:**

    - `path`: of the file, which is written whole; None for the text alone.
    - `state`: a `linkax.State` for the keyframe "start".
    - `ignore`: elements to leave out, by their name or the name of their class, such as ["Drive"]; the motion then is
      another one.

    **Returns:** the text.

    **Raises:** `ValueError` naming the element that MuJoCo does not have: beams, other joints, forces and constraints,
    functions of time; for what acts along a cut joint; for traced numbers and batches.
    """
    ignored = [ignore] if isinstance(ignore, str) else listed(ignore, str, "ignore", 'give names such as ["Drive"]')
    _check(mechanism, state)
    root = _Writer(mechanism, ignored).root
    root.set("model", "mechanism" if path is None else Path(path).stem)
    if state is not None:
        qpos, qvel = (_words(entries) for entries in _in_mujoco(mechanism, state.q, state.v))
        _add(_section(root, "keyframe"), "key", name="start", qpos=qpos, qvel=qvel)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode") + "\n"
    if path is not None:
        try:
            with written_whole(Path(path)) as unfinished:
                unfinished.write_text(text, encoding="utf-8")
        except OSError as error:
            raise ValueError(f"cannot write {str(path)!r}: {error.strerror}; give another path") from error
    return text


def mujoco_trajectory(
    motion: Kinematics | State, mechanism: Mechanism | None = None
) -> tuple[Float[np.ndarray, "... nq"], Float[np.ndarray, "... nv"]]:
    """Read a motion in the coordinates of the model that `linkax.to_mjcf` writes, to show or check it in MuJoCo.

    Of a freejoint MuJoCo has the position in the world [m], then the quaternion (w, x, y, z); as speeds the velocity of
    the body's origin in the world's axes [m/s], then the angular velocity in the body's axes [rad/s]. Of a ball it has
    the quaternion, and the angular velocity in the body's axes.

    **Arguments:** `motion`: a `linkax.Solution` or another motion, or a `linkax.State` of the `mechanism`.

    **Returns:** `qpos`, (n_t, nq), and `qvel`, (n_t, nv); of a state (nq,) and (nv,).

    **Raises:** `ValueError` for a joint in the tree that MuJoCo does not have, and for a state without its mechanism.
    """
    found = motion.mechanism if isinstance(motion, Kinematics) else mechanism
    if found is None:
        raise ValueError("the mechanism of a state is not known; give mujoco_trajectory(state, mechanism)")
    _check(found, motion if isinstance(motion, State) else None)
    return _in_mujoco(found, motion.q, motion.v)


def _check(mechanism: Mechanism, state: State | None) -> None:
    """Check that the tree is one of MuJoCo, and that all numbers are known."""
    require_type(mechanism, Mechanism, "mechanism", "give a linkax.Mechanism")
    if not all_concrete((mechanism, state)):
        raise ValueError("the mechanism is traced, and MuJoCo needs numbers; call this outside of jit, grad and vmap")
    if mechanism.beams:
        raise ValueError(f"beam {mechanism.beams[0].name!r}: MuJoCo has no such beam; put rigid bodies in its place")
    topology = mechanism.topology
    for body, joint in zip(mechanism.bodies, mechanism.joints[: topology.num_bodies], strict=True):
        if np.ndim(body.mass):
            raise ValueError(f"the mechanism is a batch of shape {np.shape(body.mass)}; give one member at a time")
        if body.name == "world":
            raise ValueError("body 'world' has the name of MuJoCo's ground; give it another one")
        if type(joint) not in PIECES:
            kinds = ", ".join(kind.__name__ for kind in PIECES)
            raise ValueError(f"joint {joint.name!r} is a {type(joint).__name__}, which MuJoCo has not; it has {kinds}")


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _section(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    """The only child with that tag."""
    found = root.find(tag)
    return _add(root, tag) if found is None else found


def _words(numbers: Any) -> str:
    """Numbers with all digits."""
    return " ".join(repr(float(number)) for number in np.ravel(np.asarray(numbers, dtype=float) + 0.0))


def _place(frame: Frame) -> Float[np.ndarray, "4 4"]:
    """The pose of a frame on its body."""
    return pose(np.asarray(frame.offset), np.asarray(value(frame.rotation)))


def _at(place: Float[np.ndarray, "4 4"]) -> dict[str, str]:
    """A pose as attributes."""
    turn = {} if np.array_equal(place[:3, :3], np.eye(3)) else {"quat": _words(to_quaternion(place[:3, :3]))}
    return {"pos": _words(place[:3, 3])} | turn


def _ends(mechanism: Mechanism, body: int) -> tuple[Frame, Frame]:
    """The frames of the joint that carries a body, on what carries it and on the body."""
    joint = mechanism.joints[body]
    return (joint.child, joint.parent) if mechanism.topology.reversed[body] else (joint.parent, joint.child)


def _outwards(topology: Topology, carrier: int = GROUND_INDEX) -> Iterator[int]:
    """All bodies that one carries, depth first, as MuJoCo numbers them."""
    for body, predecessor in enumerate(topology.predecessor):
        if predecessor == carrier:
            yield body
            yield from _outwards(topology, body)


def _pieces(mechanism: Mechanism, body: int) -> tuple[Piece, ...]:
    """The joints of MuJoCo that carry a body."""
    topology, joint = mechanism.topology, mechanism.joints[body]
    if topology.reversed[body]:
        return PIECES[type(joint)][::-1]
    if type(joint) is Free and topology.predecessor[body] == GROUND_INDEX:
        elements = (*mechanism.forces, *mechanism.constraints)
        return PIECES[Free] if any(joint.name in element.joints for element in elements) else FREE
    return PIECES[type(joint)]


def _in_mujoco(mechanism: Mechanism, q: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates, (..., n_q), and speeds, (..., n_v), as qpos and qvel."""
    topology, found = mechanism.topology, [(np.zeros((*np.shape(q)[:-1], 0)), np.zeros((*np.shape(v)[:-1], 0)))]
    for body in _outwards(topology):
        name = topology.joints[body]
        own = np.asarray(q)[..., topology.coordinates[name]], np.asarray(v)[..., topology.speeds[name]]
        found += [_of_piece(mechanism, body, piece, *own) for piece in _pieces(mechanism, body)]
    qpos, qvel = (np.concatenate(entries, axis=-1) for entries in zip(*found, strict=True))
    return qpos, qvel


def _of_piece(mechanism: Mechanism, body: int, piece: Piece, q: np.ndarray, v: np.ndarray) -> tuple[Any, Any]:
    """Coordinates and speeds of one joint of MuJoCo from those of linkax's joint."""
    joint, (carrier, end) = mechanism.joints[body], map(_place, _ends(mechanism, body))
    rotate = lambda rotation, vector: (rotation @ vector[..., None])[..., 0]
    if piece.kind == "free":
        at, turn = carrier[:3, :3], np.asarray(rotation_matrix(q[..., :4]))
        arm = -rotate(at @ turn @ end[:3, :3].T, end[:3, 3] + np.zeros_like(v[..., :3]))  # to the body's origin
        angular, linear = rotate(at, v[..., :3]), rotate(at, v[..., 3:])
        into = conjugate(to_quaternion(end[:3, :3]))
        quaternion = multiply(multiply(to_quaternion(at), q[..., :4]), into)
        qpos = carrier[:3, 3] + rotate(at, q[..., 4:]) + arm, np.asarray(quaternion)
        qvel = linear + np.cross(angular, arm), rotate(end[:3, :3] @ np.swapaxes(turn, -1, -2), v[..., :3])
        return np.concatenate(qpos, axis=-1), np.concatenate(qvel, axis=-1)
    if piece.kind == "ball":
        axes = -end[:3, :3] if mechanism.topology.reversed[body] else end[:3, :3]
        into = np.eye(3) if mechanism.topology.reversed[body] else np.swapaxes(rotation_matrix(q[..., :4]), -1, -2)
        return np.concatenate([q[..., :1], rotate(axes, q[..., 1:4])], axis=-1), rotate(axes @ into, v[..., :3])
    factor = np.asarray(joint.pitch) if piece.advances and isinstance(joint, Screw) else 1.0
    place = piece.index + joint.has_quaternion
    return factor * q[..., place : place + 1], factor * v[..., piece.index : piece.index + 1]


class _Writer:
    """Builds the elements of a mechanism.

    - `along`: the joint of MuJoCo of each speed by (joint, index).
    - `drawn`: poses of the bodies where coordinates are zero, ground last.
    """

    def __init__(self, mechanism: Mechanism, ignored: list[str]) -> None:
        self.mechanism, self.topology, self.ignored = mechanism, mechanism.topology, ignored
        self.root = ElementTree.Element("mujoco")
        _add(self.root, "compiler", angle="radian")
        self.along = dict[tuple[str, int], ElementTree.Element]()
        self.sums = defaultdict[tuple[str, str, int], float](float)
        self._options()
        self._bodies()
        for joint in mechanism.joints[self.topology.num_bodies :]:
            self._unless_ignored(joint, joint.name, self._cut)
        for constraint in mechanism.constraints:
            self._unless_ignored(constraint, constraint.name, self._constraint)
        for name, force in zip(mechanism.force_names, mechanism.forces, strict=True):
            self._unless_ignored(force, name, self._force)
        self._attributes()

    def _unless_ignored(self, element: Any, name: str, write: Any) -> None:
        if not {name, type(element).__name__} & {*self.ignored}:
            write(element, name)

    def _refused(self, element: Any, why: str) -> ValueError:
        kind = type(element).__name__
        what = getattr(element, "display_name", f"joint {element.name!r}")
        return ValueError(f"{what}: {why}; or leave it out by ignore=[{kind!r}], and the motion is another one")

    def _options(self) -> None:
        """Gravity, and contact off."""
        gravities = [force for force in self.mechanism.forces if isinstance(force, Gravity)]
        kept = [np.asarray(force.acceleration) for force in gravities if "Gravity" not in self.ignored]
        option = _add(self.root, "option", gravity=_words(sum(kept, np.zeros(3))))
        _add(option, "flag", contact="disable")

    def _bodies(self) -> None:
        """Bodies with their joints, nested."""
        mechanism, topology = self.mechanism, self.topology
        self.elements = {GROUND_INDEX: _add(self.root, "worldbody")}
        self.drawn = {GROUND_INDEX: np.eye(4)}
        labels = [label for body in mechanism.bodies for label in body.frames]
        for index in _outwards(topology):
            body, carrier = mechanism.bodies[index], topology.predecessor[index]
            before, after = map(_place, _ends(mechanism, index))
            own = before @ inverse(after)
            self.drawn[index] = self.drawn[carrier] @ own
            element = _add(self.elements[carrier], "body", name=body.name, **_at(own))
            self.elements[index] = element
            self._joints(element, index)
            _add(element, "inertial", **_inertial(body))
            for label, offset in body.frames.items():
                name = label if labels.count(label) == 1 else f"{body.name}.{label}"
                _add(element, "site", name=name, pos=_words(offset))

    def _joints(self, element: ElementTree.Element, body: int) -> None:
        """The joints of MuJoCo that carry a body."""
        joint, reverse = self.mechanism.joints[body], bool(self.topology.reversed[body])
        axes = np.asarray(joint.frames()[0 if reverse else 1]) * (-1.0 if reverse else 1.0)
        at = _words(_ends(self.mechanism, body)[1].offset)
        pieces = _pieces(self.mechanism, body)
        plain = len(pieces) - isinstance(joint, Screw) == 1
        for piece in pieces:
            name = joint.name if plain else f"{joint.name}[{piece.index}]"
            name = f"{joint.name}.advance" if piece.advances else name
            found = _add(element, "joint", name=name, type=piece.kind)
            if piece.kind != "free":
                found.set("pos", at)
            if piece.kind in ("hinge", "slide"):
                found.set("axis", _words(axes[:, piece.axis]))
            if piece.advances and isinstance(joint, Screw):
                related = {"joint1": name, "joint2": joint.name, "polycoef": _words([0.0, joint.pitch, 0.0, 0.0, 0.0])}
                _add(_section(self.root, "equality"), "joint", name=f"{joint.name}.thread", **related)
                continue
            for index in range(3) if piece.kind == "ball" else (piece.index,):
                self.along[joint.name, index] = found

    def _site(self, name: str, body: int, place: Float[np.ndarray, "4 4"]) -> str:
        _add(self.elements[body], "site", name=name, **_at(place))
        return name

    def _frame_site(self, name: str, frame: Frame, turned: bool = False) -> str:
        """A site at a frame, with its axes where they count."""
        place = _place(frame) if turned else pose(np.asarray(frame.offset))
        return self._site(name, self.topology.body_index(frame.body), place)

    def _equality(self, tag: str, name: str, **attributes: str) -> None:
        _add(_section(self.root, "equality"), tag, name=name, **attributes)

    def _cut(self, joint: AbstractJoint, name: str) -> None:
        """Close a loop."""
        if type(joint) not in CLOSES:
            if isinstance(joint, Free):
                return
            raise self._refused(joint, f"MuJoCo closes no loop by a {type(joint).__name__}; {self._instead(name)}")
        ends = (("parent", joint.parent), ("child", joint.child))
        weld = type(joint) is Fixed
        sites = [self._frame_site(f"{name}.{end}", frame, turned=weld) for end, frame in ends]
        if isinstance(joint, Distance):
            self._tendon(name, sites)
            apart = self._drawn_apart(joint.parent, joint.child)
            self._equality("tendon", name, tendon1=name, polycoef=_words([joint.length - apart, 0.0, 0.0, 0.0, 0.0]))
            return
        self._equality("weld" if weld else "connect", name, site1=sites[0], site2=sites[1])
        if type(joint) is Revolute:
            along = [np.asarray(frame.offset) + self._size() * np.asarray(axes)[:, 0]
                     for (_, frame), axes in zip(ends, joint.frames(), strict=True)]  # fmt: skip
            bodies = [self.topology.body_index(frame.body) for _, frame in ends]
            sites = [
                self._site(f"{name}.{end}.axis", body, pose(point))
                for (end, _), body, point in zip(ends, bodies, along, strict=True)
            ]
            self._equality("connect", f"{name}.axis", site1=sites[0], site2=sites[1])

    def _instead(self, cut: str) -> str:
        """What to cut in place of a joint."""
        topology = self.topology
        around = topology.loop[topology.joint_index(cut) - topology.num_bodies]
        others = [self.mechanism.joints[body] for body in np.flatnonzero(around)]
        able = [repr(joint.name) for joint in others if type(joint) in CLOSES]
        if not able:
            return "put a Revolute, Spherical or Fixed joint into its loop, and cut that by cut=True"
        return f"cut another joint of its loop by cut=True: {' or '.join(able)}"

    def _drawn_apart(self, first: Frame, second: Frame) -> float:
        """The distance of two points where coordinates are zero [m]."""
        places = [
            self.drawn[self.topology.body_index(end.body)] @ [*np.asarray(end.offset), 1.0] for end in (first, second)
        ]
        return float(np.linalg.norm(places[0] - places[1]))

    def _size(self) -> float:
        """How far apart the joints are where coordinates are zero [m]; 1 where they are at one point."""
        drawn = [self.drawn[body] @ _place(_ends(self.mechanism, body)[1]) for body in range(self.topology.num_bodies)]
        return float(np.ptp([place[:3, 3] for place in drawn], axis=0).max()) or 1.0

    def _along(self, element: Any, term: Term) -> ElementTree.Element:
        """The joint of MuJoCo of a term."""
        found = self.along.get((term.joint, term.index or 0))
        if found is None:
            cut = f"joint {term.joint!r} is cut, and MuJoCo has no coordinate of it"
            raise self._refused(element, f"{cut}; cut another joint of its loop by cut=True")
        return found

    def _linear(self, element: Any, name: str, terms: Mapping[Term, float]) -> str:
        """Make a fixed tendon, Σ factor × coordinate, and return its name."""
        tendon = _add(_section(self.root, "tendon"), "fixed", name=name)
        for term, factor in terms.items():
            joint = self._along(element, term).get("name", "")
            _add(tendon, "joint", joint=joint, coef=_words(factor))
        return name

    def _tendon(self, name: str, sites: list[str], **attributes: str) -> None:
        tendon = _add(_section(self.root, "tendon"), "spatial", name=name, **attributes)
        for site in sites:
            _add(tendon, "site", site=site)

    def _constraint(self, constraint: Any, name: str) -> None:
        if type(constraint) is Coupling:
            terms, offset = _terms(constraint.combination), float(constraint.offset)
            first, *others = terms
            if len(others) > 1:
                of = self._linear(constraint, name, terms)
                self._equality("tendon", name, tendon1=of, polycoef=_words([offset, 0.0, 0.0, 0.0, 0.0]))
                return
            names = [self._along(constraint, term).get("name", "") for term in terms]
            slope = -sum(terms[term] for term in others) / terms[first]
            coefficients = _words([offset / terms[first], slope, 0.0, 0.0, 0.0])
            related = dict(zip(("joint1", "joint2"), names, strict=False))
            self._equality("joint", name, **related, polycoef=coefficients)
        elif type(constraint) is PolynomialCoupling:
            coefficients = np.asarray(constraint.coefficients)
            if len(coefficients) > MOST_COEFFICIENTS:
                raise self._refused(constraint, f"MuJoCo's polynomials have {MOST_COEFFICIENTS} coefficients at most")
            tendons = [
                self._linear(constraint, f"{name}.{end}", _terms(of))
                for end, of in (("joint", constraint.joint), ("of", constraint.of))
            ]
            filled = _words(np.pad(coefficients, (0, MOST_COEFFICIENTS - len(coefficients))))
            self._equality("tendon", name, tendon1=tendons[0], tendon2=tendons[1], polycoef=filled)
        else:
            raise self._refused(constraint, "MuJoCo has no such equality; say it by Coupling or PolynomialCoupling")

    def _force(self, force: Any, name: str) -> None:
        if type(force) in ATTRIBUTES:
            attribute, number = ATTRIBUTES[type(force)]
            self._along(force, force.joint)
            self.sums[attribute, force.joint.joint, force.joint.index or 0] += float(getattr(force, number))
        elif type(force) is JointSpring:
            numbers = {"stiffness": force.stiffness, "springref": force.free}
            self._once(force, **{attribute: _words(number) for attribute, number in numbers.items()})
        elif type(force) is JointLimit:
            ends = zip((force.range.lower, force.range.upper), (-NO_END, NO_END), strict=True)
            self._once(force, limited="true", range=_words([far if end is None else end for end, far in ends]))
        elif type(force) is JointTorque and not callable(force.torque):
            self._actuator(force, name, {force.joint: 1.0}, np.ones(1), np.array([force.torque, 0.0, 0.0]))
        elif type(force) is AffineActuator and not callable(force.control):
            gain = np.atleast_1d(np.asarray(force.gain))
            bias = np.asarray(force.bias) + np.pad(gain, (0, 3 - len(gain))) * float(force.control)
            self._actuator(force, name, _terms(force.transmission), gain, bias, force.force_range)
        elif type(force) in (Spring, Damper):
            sites = [self._frame_site(f"{name}.{end}", getattr(force, end)) for end in ("first", "second")]
            fields = {"stiffness": "stiffness", "springlength": "free_length", "damping": "damping"}
            numbers = {name: getattr(force, field) for name, field in fields.items() if hasattr(force, field)}
            self._tendon(name, sites, **{attribute: _words(number) for attribute, number in numbers.items()})
        elif type(force) is not Gravity:
            is_law = isinstance(force, JointTorque | AffineActuator)
            why = "MuJoCo knows no functions of time; give a number" if is_law else "MuJoCo has no such force"
            raise self._refused(force, why)

    def _once(self, force: Any, **attributes: str) -> None:
        """Set attributes of a joint that it has once."""
        joint = self._along(force, force.joint)
        if next(iter(attributes)) in joint.attrib:
            raise self._refused(force, f"joint {joint.get('name')!r} has two of its kind, in MuJoCo one; join them")
        joint.attrib.update(attributes)

    def _actuator(
        self,
        force: Any,
        name: str,
        terms: Mapping[Term, float],
        gain: np.ndarray,
        bias: np.ndarray,
        force_range: Any = None,
    ) -> None:
        """An actuator on a joint, or on a fixed tendon where there are several."""
        (first, *others), factor = terms, 1.0
        joint = self._along(force, first)
        if joint.get("type") == "ball":
            raise self._refused(force, f"no actuator of MuJoCo keeps to an axis of the parent of {first.joint!r}")
        if others:
            on = {"tendon": self._linear(force, f"{name}.transmission", terms)}
        else:
            on, factor = {"joint": joint.get("name", "")}, terms[first]
        attributes = {"gear": _words([factor, 0.0, 0.0, 0.0, 0.0, 0.0]), "biastype": "affine", "biasprm": _words(bias)}
        attributes |= {"gaintype": "fixed" if len(gain) == 1 else "affine", "gainprm": _words(gain)}
        if force_range is not None:
            attributes |= {"forcelimited": "true", "forcerange": _words(force_range)}
        _add(_section(self.root, "actuator"), "general", name=name, **on, **attributes)

    def _attributes(self) -> None:
        """Damping, friction and inertia along joints; a ball has one number of each for all its axes."""
        for attribute, joint, index in self.sums:
            element = self.along[joint, index]
            alike = [key for key, other in self.along.items() if other is element]
            found = {self.sums.get((attribute, *key), 0.0) for key in alike}
            if len(found) > 1:
                raise ValueError(
                    f"joint {joint!r}: {attribute} about its three axes is {sorted(found)}, and MuJoCo has one number "
                    "for all; make them equal"
                )
            element.set(attribute, _words(found.pop()))


def _terms(combination: Combination) -> dict[Term, float]:
    """Terms with factors that are not zero."""
    pairs = zip(combination.terms, np.asarray(combination.factors), strict=True)
    return {term: float(factor) for term, factor in pairs if factor}


def _inertial(body: RigidBody) -> dict[str, str]:
    """Mass, centre and principal moments of inertia, as MuJoCo takes them."""
    inertia, axes = np.asarray(body.inertia, dtype=float), np.eye(3)
    moments = np.diag(inertia)
    if not np.array_equal(inertia, np.diag(moments)):
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.linalg.det(axes)
    moments = np.maximum(moments, max(LEAST, SLACK * moments.max()))
    least, middle, most = np.argsort(moments)
    moments[least] = max(moments[least], moments[most] * (1.0 + SLACK) - moments[middle])
    numbers = {"mass": max(float(body.mass), LEAST), "diaginertia": moments}
    return _at(pose(np.asarray(body.center_of_mass), axes)) | {name: _words(entry) for name, entry in numbers.items()}
