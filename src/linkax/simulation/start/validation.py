"""Checks of what users give for a mechanism: numbers for joints, states, times."""

from collections.abc import Mapping
from functools import reduce
from itertools import chain
from operator import and_
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from linkax.model.elements import is_own
from linkax.model.forces.internal_states import initial_values
from linkax.model.functions import Law
from linkax.model.mechanism import Mechanism, require_unchanged
from linkax.model.numbers import Number, Vector, is_finite, namespace, number, real, require, require_type
from linkax.model.poses import Pose, Velocity
from linkax.model.terms import TermLike, term
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from linkax.xla.tracing import concrete
from linkax.xla.undefined import nan_where
from scalarjit import kept_while_alive

# What a user may give for joints, by their names, or by (name, index of a speed).
JointNumbers = (
    Mapping[str, Number | Vector] | Mapping[tuple[str, int], Number | Vector] | Mapping[TermLike, Number | Vector]
)
# The same, or places of bodies or their motion in the world, by the names of bodies, or "body.frame".
WorldPlaces = Mapping[str, Number | Vector | Pose] | JointNumbers | Mapping[TermLike, Number | Vector | Pose]
WorldMotion = Mapping[str, Number | Vector | Velocity] | JointNumbers | Mapping[TermLike, Number | Vector | Velocity]
Tree = TypeVar("Tree")


def _is_law(node) -> bool:
    return isinstance(node, Law)


def check_mechanism(mechanism: Mechanism) -> None:
    """Check that this is one mechanism, that its functions are unchanged, and that JAX is in double precision."""
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "jax_enable_x64 is False, switched off after linkax was imported; switch it on again by "
            'jax.config.update("jax_enable_x64", True), and for a run in single precision give dtype=jnp.float32'
        )
    require_type(
        mechanism, Mechanism, "mechanism", "give a linkax.Mechanism, such as your function of parameters returns"
    )
    require_unchanged(mechanism)
    for body in mechanism.bodies:
        if np.shape(body.mass) != ():
            raise ValueError(
                f"mechanism is a batch: body {body.name!r} has masses of shape {np.shape(body.mass)}; use jax.vmap, or "
                "linkax.sweep, for the function that makes it and uses it"
            )
    if mechanism.topology.num_speeds == 0:
        names = ", ".join(map(repr, mechanism.topology.joints))
        raise ValueError(
            f"mechanism cannot move, nor be computed: none of its joints {names} does; make one a joint that does"
        )


@kept_while_alive
def sound_numbers(mechanism: Mechanism) -> Bool[Array, ""] | np.bool_:
    """Whether all numbers of a mechanism that are or were traced are possible, see `linkax.model.numbers.require`.

    A user's own elements and functions are not looked at.
    """
    places = (mechanism.bodies, mechanism.beams, mechanism.joints, mechanism.forces, mechanism.constraints)
    known_kinds = [element for element in chain(*places) if not is_own(element)]
    arrays = [*filter(eqx.is_array, jax.tree.leaves(known_kinds, is_leaf=_is_law))]
    traced = [array for array in arrays if concrete(array) is None]
    # At once: a call of NumPy takes longer than their few numbers.
    known = np.concatenate([np.zeros(0), *(np.ravel(array) for array in arrays if concrete(array) is not None)])
    return reduce(and_, map(is_finite, traced), is_finite(known))


def marked(mechanism: Mechanism, found: Tree) -> Tree:
    """Replace results of a mechanism by NaN where `sound_numbers` is false."""
    sound = sound_numbers(mechanism)
    return found if concrete(sound) else nan_where(jnp.logical_not(sound), found, mechanism)


def checked_time(entry: Any, name: str) -> Float[Array, ""]:
    """Check one time [s]."""
    return number(entry, (), f"{name} [s]")


def checked_state(mechanism: Mechanism, state: State) -> State:
    """Check a state of a mechanism: floating-point numbers of the right shapes, finite where they are known.

    Coordinates and speeds of different precision become double precision.
    """
    check_mechanism(mechanism)
    topology, made = mechanism.topology, "make the state with linkax.assemble"
    require_type(state, State, "state", made)
    found = []
    for what, array, slices, size in (
        ("q", state.q, topology.coordinates, topology.num_coordinates),
        ("v", state.v, topology.speeds, topology.num_speeds),
    ):
        if not (eqx.is_array(array) and jnp.issubdtype(array.dtype, jnp.floating)):
            array = real(array, f"state.{what}")
        if array.shape != (size,):
            raise ValueError(
                f"state.{what} has shape {array.shape}; this mechanism's tree has {topology.num_coordinates} "
                f"coordinates and {topology.num_speeds} speeds: {made}"
            )
        found.append(array)
        if (entries := concrete(array)) is None:
            continue
        for (name, taken), kind in zip(slices.items(), topology.joint_types, strict=False):
            of_joint = f"state.{what} of joint {name!r}"
            require(entries[taken], is_finite, of_joint, "it must be finite")
            if kind.has_quaternion and what == "q":
                _check_quaternion(entries[taken], of_joint)
    q, v = found
    if q.dtype != v.dtype:
        q, v = (array.astype(jnp.result_type(q.dtype, v.dtype)) for array in found)
    return State(q, v, topology, _checked_internal(mechanism, state.internal, q.dtype))


def require_double_precision(state: State, name: str) -> None:
    """**Raises:** `ValueError` for a state in single precision, in which a search does not see where it ends."""
    if state.q.dtype != np.float64:
        raise ValueError(f"{name} is in {state.q.dtype}; make it with linkax.assemble, in double precision")


def _checked_internal(mechanism, given, dtype):
    """Internal states of a mechanism, by default their initial values; None where it has none."""
    initial = initial_values(mechanism.forces, dtype)
    if given is None or initial is None:
        if given is not None:
            raise ValueError(
                f"state.internal is {given!r}, and no force element of this mechanism has internal states; give None"
            )
        return initial
    what = "state.internal"
    return require(number(given, initial.shape, what), is_finite, what, "it must be finite").astype(dtype)


def _check_quaternion(coordinates, what):
    """Check that coordinates begin with a quaternion of a rotation."""

    def turns(entries):
        size = namespace(entries).linalg.norm(entries[:4])
        return (size > 0.0) & (size < np.inf)

    with np.errstate(over="ignore"):
        return require(
            coordinates, turns, what, "its quaternion is no rotation; give one of length 1, like (1, 0, 0, 0)"
        )


def speeds_by_joint(mechanism: Mechanism, given: Mapping[Any, Any] | None, what: str) -> JointValues:
    """Check speeds for joints, {joint or (joint, index): number or array}, or their rates."""
    pairs = _by_joint(mechanism, given, what, lambda joint: len(joint.speed_units))
    return JointValues.of(mechanism.topology, [(along, entry) for along, _, entry in pairs])


def coordinates_by_joint(mechanism: Mechanism, given: Mapping[Any, Any] | None, what: str) -> JointValues:
    """Check coordinates for joints likewise: quaternions whole and not zero."""
    found = []
    for along, joint, entry in _by_joint(mechanism, given, what, lambda joint: joint.num_coordinates):
        if joint.has_quaternion and along.index is None:
            entry = _check_quaternion(entry, f"{what} of joint {joint.name!r}")
        if joint.has_quaternion and along.index in (0, 1, 2):
            raise ValueError(
                f"{what} of joint {joint.name!r}: index {along.index} is part of a quaternion; give all of it"
            )
        found.append((along, entry))
    return JointValues.of(mechanism.topology, found)


def _by_joint(mechanism, given, what, count):
    """Check numbers for joints.

    **Arguments:** `count`: joint ↦ how many numbers it has.

    **Yields:** terms, joints and arrays of their numbers.
    """
    given, seen = {} if given is None else given, set()
    require_type(given, Mapping, what, "give {joint: number, ...}")
    for key, entry in given.items():
        along = term(key, what)
        if along in seen:
            raise ValueError(f"{what} of joint {along.joint!r} is given twice, again by {key!r}; give it once")
        seen.add(along)
        joint = mechanism.joint(along.joint)
        expected = count(joint) if along.index is None else 1
        if along.index is not None and not 0 <= along.index < len(joint.speed_units):
            most = len(joint.speed_units)
            raise ValueError(
                f"{what} of joint {joint.name!r}: index {along.index}; it has {most} speeds, counted from 0"
            )
        of_joint = f"{what} of joint {joint.name!r}"
        array = real(entry, of_joint)
        if array.shape == () and expected != 1:
            raise ValueError(f"{of_joint} is one number; the joint has {expected} of them")
        yield along, joint, number(array[None] if array.shape == () else array, (expected,), of_joint)
