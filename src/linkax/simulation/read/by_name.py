"""Functions of `Observables` for what a user names: a point of a body, a joint, a constraint.

Names share programs: what is named comes as a traced index, or is taken out of what is read of all.
"""

from collections.abc import Callable
from typing import Any, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped

from linkax.equations.reactions import Axes, Reaction, Side
from linkax.model.beams import Beam
from linkax.model.elements import AbstractElement
from linkax.model.forces.force import AbstractForce
from linkax.model.forces.internal_states import by_name, size_of
from linkax.model.joints.distance import Distance
from linkax.model.names import ByName, find
from linkax.model.numbers import Number, Vector, number, one_of, real
from linkax.simulation.integrate.results import Solution
from linkax.simulation.read.observables import Observables
from linkax.simulation.read.reading import read, read_in_motion
from linkax.xla.arrays import Array

# A point of a body: a frame, a position on it, or None for its centre of mass, see `Solution.position`.
BodyPoint = str | Number | Vector | None


def of_point(
    function: Callable[..., Any], solution: Solution, body: str, at: BodyPoint
) -> Float[Array, "*batch n_t 3"]:
    """Read a function for a point of a rigid body or of a beam.

    **Raises:** `ValueError` for an unknown body or frame, and a wrong position.
    """
    found = solution.mechanism.body(body)
    reader = read_in_motion if function is Observables.acceleration else read
    if at is None and isinstance(found, Beam):
        sections = np.stack([_index(solution, section) for section in found.sections], axis=-1)
        return reader(Observables.center_of_mass, solution, function, sections)
    if at is None and not isinstance(found, Beam):
        return reader(function, solution, _index(solution, body), found.center_of_mass)
    if isinstance(at, str):
        frame = found.at(at)
        offset = jnp.broadcast_to(frame.offset, (*solution.ts.shape[:-1], 3))
        return reader(function, solution, _index(solution, frame.body), offset)
    what = f"point on body {body!r} [m]"
    offset = real(at, what)
    if isinstance(found, Beam) and offset.shape == ():
        offset = number(offset, (), what) * np.eye(3)[0]
    offset = number(offset, (3,), what)
    offset = found.within(offset, what) if isinstance(found, Beam) else offset
    offset = jnp.broadcast_to(offset, (*solution.ts.shape[:-1], 3))
    if isinstance(found, Beam):
        return reader(Observables.on_beam, solution, function, found, offset)
    return reader(function, solution, _index(solution, body), offset)


def of_body(function: Callable[..., Any], solution: Solution, body: str) -> Float[Array, "..."]:
    """Read a function of a rigid body.

    **Raises:** `ValueError` for an unknown body and for a beam.
    """
    found = solution.mechanism.body(body)
    reader = read_in_motion if function is Observables.angular_acceleration else read
    if isinstance(found, Beam):
        some = ", ".join(map(repr, found.sections[:3]))
        raise ValueError(f"{body!r} is a beam and bends; ask for one of its sections, {some}, ...")
    return reader(function, solution, _index(solution, body))


def of_joint(function: Callable[..., Any], solution: Solution, name: str) -> Float[Array, "..."]:
    """Read a function of a joint: (n_t,), or (n_t, n) where it has several numbers.

    **Raises:** `ValueError` for an unknown joint.
    """
    solution.mechanism.joint(name)
    reader = read_in_motion if function is Observables.joint_acceleration else read
    values = reader(function, solution, name)
    return values[..., 0] if values.shape[-1] == 1 else values


def reaction_of(function: Callable[..., Any], solution: Solution, name: str, on: Side, axes: Axes) -> Reaction:
    """Read a function of reactions for one joint.

    **Raises:** `ValueError` for an unknown name, side or axes.
    """
    for what, entry, choices in (("on", on, get_args(Side)), ("axes", axes, get_args(Axes))):
        one_of(entry, choices, what)
    topology = solution.mechanism.topology
    index = find(name, (*topology.joints, *topology.constraints), "joint or constraint")
    force, moment = read_in_motion(function, solution, on, axes)
    return Reaction(force[..., index, :], moment[..., index, :])


def force_of(solution: Solution, element: str | AbstractElement | Distance) -> Float[Array, "..."]:
    """Read the strength of a force element, or the force of a constraint or a `Distance`.

    **Raises:** `ValueError` for an unknown element, and for one that has no one force.
    """
    of, index = _place(solution, element)
    if of == "forces":
        return read(Observables.strength, solution, index)
    if of == "joints":
        return read_in_motion(Observables.tension, solution, index)
    return of_constraint(Observables.constraint_forces, solution, solution.mechanism.topology.constraints[index])


def states_of(solution: Solution, element: str | AbstractForce) -> dict[str, Float[Array, "..."]]:
    """Take the internal states of a force element, by name.

    **Raises:** `ValueError` for an unknown element, for one without, and for a solution that saved no states.
    """
    of, index = _place(solution, element)
    shapes, names = _shapes_of_states(solution), solution.mechanism.force_names
    if of != "forces" or not shapes[index]:
        having = ", ".join(repr(name) for name, found in zip(names, shapes, strict=True) if found)
        raise ValueError(f"{element!r} has no internal states; known: {having or 'none'}")
    if solution.internal is None:
        raise ValueError("this solution saved functions of its own in ys; simulate without SaveAt(fn=...)")
    start = sum(size_of(found) for found in shapes[:index])
    values = solution.internal[..., start : start + size_of(shapes[index])]
    return ByName(by_name(shapes[index], values), "internal state")


def _shapes_of_states(solution) -> list[dict[str, tuple[int, ...]]]:
    """Shapes of the internal states of each force element, of one member of a batch."""
    of_member = lambda mechanism: [dict(force.states) for force in mechanism.forces]
    axes = solution.ts.ndim - 1
    for _ in range(axes):
        of_member = eqx.filter_vmap(of_member)
    found = eqx.filter_eval_shape(of_member, solution.mechanism)
    return [{name: state.initial.shape[axes:] for name, state in states.items()} for states in found]


def length_of(solution: Solution, element: str | AbstractElement | Distance) -> Float[Array, "*batch n_t"]:
    """Read the length of a force element, a constraint or a `Distance`.

    **Raises:** `ValueError` for an unknown element, and for one without length.
    """
    return read(Observables.extent, solution, *_place(solution, element))


def _place(solution, element):
    """In which list of the mechanism an element is, and its index there."""
    mechanism = solution.mechanism
    forces, constraints, joints = mechanism.force_names, mechanism.topology.constraints, mechanism.topology.joints
    rods = [joint.name for joint in mechanism.joints if isinstance(joint, Distance)]
    name: Any = element
    if not isinstance(element, str):
        name = getattr(element, "name", None) or getattr(element, "display_name", element)
        if f"{name} (2)" in forces:
            raise ValueError(f"there are several elements {name!r}; give each a name: Spring(..., name='strut')")
    find(name, (*forces, *constraints, *rods), "force, constraint or Distance")
    lists = {"forces": forces, "constraints": constraints, "joints": joints}
    return next((of, names.index(name)) for of, names in lists.items() if name in names)


def is_constraint(solution: Solution, name: str) -> bool:
    """Whether this names a constraint."""
    return isinstance(name, str) and name in solution.mechanism.topology.constraints


def of_constraint(function: Callable[..., Any], solution: Solution, name: str) -> Shaped[Array, "..."]:
    """Read a function of constraints' forces for one of them: (n_t,), or (n_t, k) where it has several rows."""
    topology = solution.mechanism.topology
    rows = np.flatnonzero(topology.constraint_of_row == topology.constraints.index(name))
    return read_in_motion(function, solution)[..., rows[0] if len(rows) == 1 else rows]


def _index(solution, section) -> Int[np.ndarray, "*batch"]:
    """The index of a body, for each member of a batch."""
    return np.full(solution.ts.shape[:-1], solution.mechanism.topology.bodies.index(section))
