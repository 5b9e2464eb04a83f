"""Random mechanisms as plans: calls with arguments of known sorts, so that any one of them can be broken."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

import linkax as lx


@dataclasses.dataclass(frozen=True)
class Part:
    """A call that makes an element.

    - `named`: what an error must say to name it. `arguments`: numbers, parts, or a `Body` of the plan.
    - `sorts`: of those arguments that can be broken, keys of `BAD`.
    """

    make: Callable
    named: tuple[str, ...]
    arguments: dict[str, Any]
    sorts: dict[str, str]


class Body(NamedTuple):
    """A body of the plan, by its name; None for the ground."""

    name: str | None


@dataclasses.dataclass(frozen=True)
class Plan:
    """The parts of a mechanism."""

    bodies: tuple[Part, ...]
    joints: tuple[Part, ...]
    forces: tuple[Part, ...] = ()
    constraints: tuple[Part, ...] = ()

    def elements(self) -> dict[str, list]:
        """What `lx.Mechanism` takes."""
        bodies = [made(part, {}) for part in self.bodies]
        by_name = {None: lx.GROUND} | {body.name: body for body in bodies}
        others = {
            place: [made(part, by_name) for part in getattr(self, place)]
            for place in ("joints", "forces", "constraints")
        }
        return {"bodies": bodies} | others

    def build(self) -> lx.Mechanism:
        return lx.Mechanism(**self.elements())

    def slots(self):
        """All that can be broken: (path, sort, names of the element)."""
        for place in ("bodies", "joints", "forces", "constraints"):
            for index, part in enumerate(getattr(self, place)):
                yield from _slots(part, (place, index))

    def with_bad(self, path, value) -> "Plan":
        """The plan with one argument replaced."""
        place, index, *inner = path
        parts = list(getattr(self, place))
        parts[index] = _replaced(parts[index], inner, value)
        return dataclasses.replace(self, **{place: tuple(parts)})


def _slots(part, path):
    for argument, entry in part.arguments.items():
        if argument in part.sorts:
            yield (*path, argument), part.sorts[argument], part.named
        if isinstance(entry, Part):
            yield from _slots(entry, (*path, argument))


def _replaced(part, path, value):
    argument, *inner = path
    value = _replaced(part.arguments[argument], inner, value) if inner else value
    return dataclasses.replace(part, arguments=part.arguments | {argument: value})


def made(entry, bodies):
    """The element that a part makes."""
    if isinstance(entry, Part):
        return entry.make(**{name: made(value, bodies) for name, value in entry.arguments.items()})
    if isinstance(entry, Body):
        return bodies[entry.name]
    if isinstance(entry, list):
        return [made(value, bodies) for value in entry]
    return entry


# As many examples as the profile says where one takes no time, fewer where it takes some.
SOME, FEW = (settings(max_examples=settings().max_examples // part) for part in (3, 6))

# What no number is, or no single one.
NUMBER = [
    np.nan, np.inf, -np.inf, None, "heavy", "1.0", b"1.0", True, 1.0 + 2.0j, np.complex128(1.0), jnp.asarray(1.0j),
    jnp.asarray(np.nan), jnp.asarray(True), [1.0, 2.0], np.ones(1), [jnp.ones(()), "x"], {}, {"m": 1.0}, 10**400,
    object(), np.ma.masked_array([1.0], True),
]  # fmt: skip
NEGATIVE = [-1.0, -1e-9, jnp.asarray(-2.0)]
VECTOR = [
    1.0, None, "tip of it", [1.0, 2.0], [1.0, 2.0, "3"], [0.0, 0.0, np.nan], [np.inf, 0.0, 0.0], [[1.0, 2.0, 3.0]],
    [1.0, [2.0], 3.0], [0.0, 1.0j, 0.0], np.array([0.0, 1.0j, 0.0]), np.array([None, 1.0, 2.0]), jnp.ones(2),
    jnp.full(3, jnp.nan), [jnp.ones(()), jnp.ones(2), 0.0], [True, False, True], {1.0, 2.0, 3.0}, [],
    np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False]),
]  # fmt: skip
MATRIX = [
    0.3, "z", np.eye(2), np.full((3, 3), np.nan), 1j * np.eye(3), np.ones(9), [[1.0], [0.0], [0.0, 1.0]], jnp.eye(4),
]  # fmt: skip


def _raises(t):
    raise KeyError("a table that has no such entry")


def _branches(t):
    return 1.0 if t > 1.0 else 0.0


# Functions of time that do not return one real number.
LAW = [
    lambda t: jnp.ones(2), lambda t: None, lambda t: "fast", lambda t: 1.0j * t, lambda t: t > 1.0, lambda: 1.0,
    lambda t: [t, "x"], lambda t: {"angle": t}, lambda t: 10**400, _raises, _branches,
]  # fmt: skip

BAD = {
    "number": NUMBER,
    "positive": [*NUMBER, *NEGATIVE, 0.0, -0.0],
    "given": [*(entry for entry in NUMBER if entry is not None), *NEGATIVE, 0.0],  # None is to leave it out
    "zero or more": [*NUMBER, *NEGATIVE],
    "not zero": [*NUMBER, 0.0],
    "pair": [np.nan, -1.0, 0.0, None, "stiff", [1.0, -1.0], [1.0, np.inf], [1.0, 2.0, 3.0], 1.0j, True],
    "vector": VECTOR,
    "offset": [entry for entry in VECTOR if not isinstance(entry, float)],  # one number is a place on a beam
    "sizes": [*VECTOR, [1.0, 0.0, 1.0], [1.0, 1.0, -2.0]],
    "axis": [*VECTOR, "w", "", [0.0, 0.0, 0.0], jnp.zeros(3), [1e200, 1e200, 0.0], jnp.asarray([0.0, 1e-200, 0.0])],
    "rotation": [*MATRIX, 2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), jnp.ones((3, 3)), np.zeros((3, 3))],
    "inertia": [
        *(entry for entry in MATRIX if not isinstance(entry, float)), None, -0.5, [1.0, 2.0], -np.eye(3),
        np.diag([1.0, 1.0, -0.5]), np.diag([1.0, 1.0, 3.0]),
        np.eye(3) + np.triu(np.ones((3, 3)), 1), [1.0, np.nan, 1.0], jnp.asarray([1.0, 1.0, 2.5]), [True, True, True],
        np.diag([1e308, 1e308, -1e308]),
    ],
    "name": ["", None, 3, b"part", ["part"], ("part", 0), np.nan],
    "joint name": ["", None, 3, b"part", ["part"], np.nan],
    "place": [None, "part", 3.0, [0.0, 0.0, 0.0], lx.RigidBody, np.eye(3), print],
    "joint": ["nip", "", 3, None, ("pin", "first"), ("pin", 0.5), ["pin", 0], np.nan],
    "count": [0, -3, 1.5, "8", None, True, np.nan, 10**400],
    "bends": ["x", "zy", 3, None, ["y"], "both"],
    "axes": ["body", None, 3, "", ["ground"]],
    "section": [None, 3.0, "I", lx.Section],
    "frames": [["tip"], "tip", 3, {3: [1.0, 0.0, 0.0]}, {"tip": [1.0, 0.0]}, {"tip": None}, {"": [1.0, 0.0, 0.0]}],
    "coefficients": [{}, None, 3.0, ["pin"], {3: 1.0}, {"nip": 1.0}, {None: 1.0}],
    "law": [*LAW, 2.0, None, "t", [1.0]],
    "flag": ["no", None, 2, "False", np.nan, [True]],
}  # fmt: skip

numbers = st.floats(-2.0, 2.0)
sizes = st.floats(0.1, 3.0)
vectors = st.tuples(numbers, numbers, numbers)
axes = st.one_of(st.sampled_from(["x", "-y", "z"]), vectors.filter(lambda v: np.linalg.norm(v) > 0.1).map(list))
turns = st.one_of(st.none(), st.integers(0, 10**6).map(lambda seed: _turn(seed)))


def _turn(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def _body(draw, name):
    kind = draw(st.sampled_from(["rod", "box", "point_mass", "RigidBody", "Beam"]))
    of_body = {"name": "name", "mass": "zero or more"}
    given = {"name": name, "mass": draw(sizes)}
    if kind == "rod":
        return Part(lx.rod, (name,), given | {"length": draw(sizes)}, of_body | {"length": "positive"})
    if kind == "box":
        size = [draw(sizes) for _ in range(3)]
        return Part(lx.box, (name,), given | {"size": size}, of_body | {"size": "sizes"})
    if kind == "point_mass":
        return Part(lx.point_mass, (name,), given, of_body)
    if kind == "RigidBody":
        root = np.random.default_rng(draw(st.integers(0, 1000))).normal(size=(3, 3))
        inertia = np.trace(root @ root.T) * np.eye(3) - root @ root.T
        more = {"center_of_mass": draw(vectors), "inertia": inertia, "frames": {"tip": draw(vectors)}}
        sorts = {"center_of_mass": "vector", "inertia": "inertia", "frames": "frames"}
        return Part(lx.RigidBody, (name,), given | more, of_body | sorts)
    stiffness = {"bending_stiffness": "pair", "linear_density": "positive", "axial_stiffness": "given"}
    section = Part(
        lx.Section,
        ("section",),
        {argument: draw(sizes) for argument in (*stiffness, "torsional_stiffness")},
        stiffness | {"torsional_stiffness": "given"},
    )
    length, damping = draw(sizes), draw(st.floats(0.0, 1.0))
    arguments = dict(name=name, length=length, section=section, elements=draw(st.integers(1, 2)), damping=damping)
    sorts = dict(name="name", length="positive", elements="count", damping="zero or more", bends="bends")
    sorts |= dict(section="section", torsion="flag", stretch="flag")
    flags = dict(
        bends=draw(st.sampled_from(["yz", "y", "z"])), torsion=draw(st.booleans()), stretch=draw(st.booleans())
    )
    return Part(lx.Beam, (name,), arguments | flags, sorts)


def _place(draw, name):
    """A frame on a body, or the ground."""
    offset = [draw(st.floats(0.0, 0.1)), draw(numbers), draw(numbers)]
    at = lambda body, offset, rotation: body.at(offset, rotation)
    called = (name or "ground",)
    given = {"body": Body(name), "offset": offset, "rotation": draw(turns)}
    return Part(at, called, given, {"offset": "offset", "rotation": "rotation"})


KINDS = (
    lx.Revolute, lx.Universal, lx.Spherical, lx.Prismatic, lx.Cylindrical, lx.Fixed, lx.Planar, lx.Rectangular,
    lx.Free, lx.Screw,
)  # fmt: skip
WITH_AXIS = (lx.Revolute, lx.Universal, lx.Prismatic, lx.Cylindrical, lx.Planar, lx.Rectangular, lx.Screw)


def _joint(draw, kind, name, parent, child):
    arguments = {"name": name, "parent": _place(draw, parent), "child": _place(draw, child)}
    sorts = {"name": "joint name", "parent": "place", "child": "place"}
    if kind in WITH_AXIS:
        arguments, sorts = arguments | {"axis": draw(axes)}, sorts | {"axis": "axis"}
    if kind is lx.Screw:
        arguments, sorts = arguments | {"pitch": draw(sizes)}, sorts | {"pitch": "not zero"}
    if kind is lx.Distance:
        return Part(kind, (name,), arguments | {"length": draw(sizes)}, sorts | {"length": "positive"})
    return Part(kind, (name,), arguments | {"cut": False}, sorts | {"cut": "flag"})


def _force(draw, body, joint):
    """A force element between a body and the ground, or along the first joint, which turns."""
    kind = draw(st.sampled_from(FORCES))
    between = {"first": _place(draw, None), "second": _place(draw, body)}
    ends = {"first": "place", "second": "place"}
    along, of_joint = {"joint": joint}, {"joint": "joint"}
    rope = [_place(draw, None), _place(draw, body)]
    number = lambda: draw(sizes)
    arguments, sorts = {
        lx.Gravity: ({"acceleration": draw(vectors)}, {"acceleration": "vector"}),
        lx.Spring: (
            {**between, "stiffness": number(), "free_length": number()},
            {**ends, "stiffness": "number", "free_length": "zero or more"},
        ),
        lx.Damper: ({**between, "damping": number()}, {**ends, "damping": "number"}),
        lx.PointForce: (
            {"point": _place(draw, body), "force": draw(vectors), "axes": "frame"},
            {"point": "place", "force": "vector", "axes": "axes"},
        ),
        lx.PointMoment: (
            {"point": _place(draw, body), "moment": draw(vectors)},
            {"point": "place", "moment": "vector"},
        ),
        lx.ElasticRope: (
            {"points": rope, "stiffness": number(), "free_length": number(), "damping": number()},
            {"stiffness": "positive", "free_length": "positive", "damping": "zero or more"},
        ),
        lx.JointTorque: ({**along, "torque": number()}, {**of_joint, "torque": "number"}),
        lx.JointSpring: (
            {**along, "stiffness": number(), "free": number()},
            {**of_joint, "stiffness": "number", "free": "number"},
        ),
        lx.JointDamper: ({**along, "damping": number()}, {**of_joint, "damping": "number"}),
        lx.JointFriction: (
            {**along, "torque": number(), "scale": number()},
            {**of_joint, "torque": "zero or more", "scale": "positive"},
        ),
        lx.JointInertia: ({**along, "inertia": number()}, {**of_joint, "inertia": "zero or more"}),
    }[kind]
    return Part(kind, (kind.__name__,), arguments, sorts)


FORCES = (
    lx.Gravity, lx.Spring, lx.Damper, lx.PointForce, lx.PointMoment, lx.ElasticRope, lx.JointTorque, lx.JointSpring,
    lx.JointDamper, lx.JointFriction, lx.JointInertia,
)  # fmt: skip


def _constraint(draw, name, body, joint):
    kind = draw(st.sampled_from(["Coupling", "Drive", "Rope", "Distance"]))
    points = [_place(draw, None), _place(draw, body)]
    if kind == "Coupling":
        arguments = {"name": name, "coefficients": {joint: draw(sizes)}, "offset": draw(numbers)}
        sorts = {"name": "name", "coefficients": "coefficients", "offset": "number"}
        return Part(lx.Coupling, (name,), arguments, sorts)
    if kind == "Drive":
        arguments = {"name": name, "joint": joint, "motion": jax.tree_util.Partial(_turning, draw(numbers))}
        return Part(lx.Drive, (name,), arguments, {"name": "name", "joint": "joint", "motion": "law"})
    if kind == "Rope":
        arguments = {"name": name, "points": points, "length": draw(sizes)}
        return Part(lx.Rope, (name,), arguments, {"name": "name", "length": "positive"})
    return _joint(draw, lx.Distance, name, None, body)


def _turning(rate, t):
    return rate * jnp.sin(t)


@st.composite
def plans(draw, most=4):
    """Trees of bodies on joints of all types, with loops, forces and constraints."""
    count = draw(st.integers(1, most))
    bodies = tuple(_body(draw, f"body_{i}") for i in range(count))
    joints = [_joint(draw, lx.Revolute, "pin", None, "body_0")]
    for i in range(1, count):
        carrier = draw(st.integers(-1, i - 1))
        kind = draw(st.sampled_from(KINDS))
        joints.append(_joint(draw, kind, f"joint_{i}", f"body_{carrier}" if carrier >= 0 else None, f"body_{i}"))
    forces = [_force(draw, f"body_{draw(st.integers(0, count - 1))}", "pin") for _ in range(draw(st.integers(0, 3)))]
    constraints = []
    if draw(st.booleans()):
        constraints.append(_constraint(draw, "relation", f"body_{draw(st.integers(0, count - 1))}", "pin"))
    elif count > 1:  # a loop
        first, second = draw(st.permutations(range(count)))[:2]
        kind = draw(st.sampled_from([*KINDS, lx.Distance]))
        joints.append(_joint(draw, kind, "closing", f"body_{first}", f"body_{second}"))
    return Plan(bodies, tuple(joints), tuple(forces), tuple(constraints))
