"""Describe the internal states of force elements: currents, pressures, integrators."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float

from linkax.model.numbers import is_finite, real, require, require_type
from linkax.xla.arrays import Array

GIVE_STATES = 'give a dictionary such as {"current": linkax.InternalState(0.0, "A")}'
States = Mapping[str, Any]  # values of the internal states of one element, or their rates


class InternalState(eqx.Module):
    """An internal state of a force element, such as a current: see `AbstractForce.states`.

    **Arguments:**

    - `initial`: its value where a motion begins, a number or an array.
    - `unit`: of its value, such as "A"; of its rate it is this per second.
    - `scale`: its typical magnitude, one number or an array of the shape of `initial`, in the same unit. A step may be
      off by rtol × |value| + atol × scale, see `linkax.Accuracy`: where values pass zero, the scale alone counts.
    """

    initial: Float[Array, "..."]
    scale: Float[Array, "..."]
    unit: str = eqx.field(static=True)

    def __init__(self, initial: Any, unit: str = "", *, scale: Any = 1.0) -> None:
        self.initial = require(real(initial, "initial"), is_finite, "initial", "it must be finite")
        positive = lambda x: ((x > 0.0) & (x < np.inf)).all()
        self.scale = require(real(scale, "scale"), positive, "scale", "it must be positive")
        if self.scale.shape not in ((), self.initial.shape):
            raise ValueError(f"scale has shape {self.scale.shape}; give one number, or the shape {self.initial.shape}")
        self.unit = require_type(unit, str, "unit", 'give text, such as "A"')


def checked_states(states: Any, what: str) -> Mapping[str, InternalState]:
    """Check what the property `states` of an element is; `what` names the element."""
    for name, state in require_type(states, Mapping, f"{what}: states", GIVE_STATES).items():
        require_type(name, str, f"{what}: the name of a state", GIVE_STATES)
        require_type(state, InternalState, f"{what}: state {name!r}", GIVE_STATES)
    return states


def shapes_of(states: Mapping[str, InternalState]) -> dict[str, tuple[int, ...]]:
    """Shapes of the states of an element by name."""
    return {name: state.initial.shape for name, state in states.items()}


def size_of(shapes: Mapping[str, tuple[int, ...]]) -> int:
    """Count the numbers of all states of an element."""
    return sum(map(math.prod, shapes.values()))


def initial_values(forces: Sequence[Any], dtype: DTypeLike) -> Float[jax.Array, " n_s"] | None:
    """Join the initial values of all states of force elements; None where there are none."""
    found = [state.initial for force in forces for state in force.states.values()]
    return _joined(found, dtype) if found else None


def scales(forces: Sequence[Any], dtype: DTypeLike) -> Float[jax.Array, " n_s"]:
    """Join the scales of all states of force elements."""
    found = [state for force in forces for state in force.states.values()]
    return _joined([jnp.broadcast_to(state.scale, state.initial.shape) for state in found], dtype)


def by_name(shapes: Mapping[str, tuple[int, ...]], values: Float[Array, "*batch n"]) -> dict[str, Any]:
    """Split the numbers of an element's states, (..., n), into arrays of their shapes."""
    found, start = {}, 0
    for name, shape in shapes.items():
        stop = start + math.prod(shape)
        found[name] = values[..., start:stop].reshape(*values.shape[:-1], *shape)
        start = stop
    return found


def joined_rates(
    states: Mapping[str, InternalState], rates: Any, what: str, dtype: DTypeLike
) -> Float[jax.Array, " n"]:
    """Check the rates of an element's states, {name: number or array}, and join them."""
    names = ", ".join(map(repr, states))
    require_type(rates, Mapping, f"{what}: its rates", f"give a dictionary of the rates of {names}")
    if set(rates) != set(states):
        raise ValueError(f"{what}: its rates are of {', '.join(map(repr, rates)) or 'nothing'}; give those of {names}")
    for name, state in states.items():
        shape, kind = jnp.shape(rates[name]), jnp.result_type(rates[name])
        if shape != state.initial.shape or not jnp.issubdtype(kind, jnp.floating):
            raise ValueError(
                f"{what}: the rate of {name!r} has shape {shape} and type {kind}; give real numbers of the shape "
                f"{state.initial.shape} of its initial value"
            )
    return _joined([rates[name] for name in states], dtype)


def _joined(arrays, dtype):
    return jnp.concatenate([jnp.ravel(jnp.asarray(array, dtype)) for array in arrays])
