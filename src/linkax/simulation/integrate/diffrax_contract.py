"""What diffrax is given that it does not expect, behind names.

diffrax integrates one vector y, takes one error estimate of it, and hands a solver's state from step to step unread.
linkax tells a step control more: how close the stages of a step came to a singular configuration. It does so

- in y, whose last entry is ∫ d dt, d the distance from the nearest singular configuration: the rates of that entry at
  the stages are d there, and its end value the mean;
- in the error, which is a `StepError` where diffrax has a vector like y: only `MechanismControl` reads it;
- in the solver's state, which is a `SolverState`: the saved one tells the smallest d of all stages.

diffrax checks that times are in order, and calls back to Python where they are not; of a program with such a call JAX
keeps nothing on disk. linkax has checked its times, and leaves these checks out, see `times_in_order`.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, cast

import diffrax
import equinox.internal as eqxi
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from linkax.model.topology import Topology
from linkax.simulation.integrate.placement import Placement
from linkax.simulation.integrate.switches import Sides
from linkax.xla.arrays import Array


class StepError(NamedTuple):
    """What `ProjectedSolver` tells `MechanismControl` of a step.

    - `error`: estimates of q and v, and of internal states where there are some, or None.
    - `leaves`: distance d from the nearest singular configuration where the step begins.
    - `placement`: of its stages next to one.
    - `opens`: the largest gap of the loops on the way, where states between steps are read before they are corrected
      [rad, lengths of the mechanism], at its end as many times that as less is allowed there; None without loops.
    - `switch`: by how much to shorten the step so that it ends at the first switch of a force element that it goes
      past, or before an event would be passed over, one for neither; None where there are none.
    - `turns`: how fast joints turn between bodies whose force elements switch, at the faster of its ends [rad/s]; None
      without such elements.
    - `locks`: one where it leads up to where the mechanism locks, else zero: diffrax makes numbers of all of these.
    - `solver`: the state of the solver inside before the step.
    """

    error: Any
    leaves: Float[Array, ""]
    placement: Placement
    opens: Float[Array, ""] | None = None
    switch: Float[Array, ""] | None = None
    turns: Float[Array, ""] | None = None
    locks: Float[Array, ""] | float = 0.0
    solver: Any = None


class SolverState(NamedTuple):
    """The state of the solver inside, d at the end of the last step, the smallest d so far at any stage, and whether
    the last step led up to where the mechanism locks.
    """

    inner: Any
    arrives: Float[Array, ""]
    closest: Float[Array, ""]
    locks: Bool[Array, ""]


def pack(
    sides: Sides,
    q: Float[Array, " n_q"],
    v: Float[Array, " n_v"],
    internal: Float[Array, " n_s"] | None,
    integral: Float[Array, ""] | float,
) -> Float[Array, " n"]:
    """The vector y that diffrax integrates: sides of switches, if any, q, v, internal states, if any, and ∫ d dt; or
    its rates.
    """
    first: list[Any] = [sides] if len(sides) else []
    later: list[Any] = [] if internal is None else [internal]
    return jnp.concatenate([*first, q, v, *later, jnp.reshape(jnp.asarray(integral, q.dtype), (1,))])


def unpack(
    topology: Topology, num_states: int, y: Float[Array, "*batch n"]
) -> tuple[
    Float[Array, "*batch k"], Float[Array, "*batch n_q"], Float[Array, "*batch n_v"], Float[Array, "*batch n_s"] | None
]:
    """Sides, q, v and internal states, None for none, of vectors y, (..., k + n_q + n_v + n_s + 1)."""
    first = y.shape[-1] - topology.num_coordinates - topology.num_speeds - num_states - 1
    middle = first + topology.num_coordinates
    last = middle + topology.num_speeds
    return y[..., :first], y[..., first:middle], y[..., middle:last], y[..., last:-1] if num_states else None


def integral_of_distance(y: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """∫ d dt of a vector y."""
    return y[..., -1]


def stage_distances(
    dense_info: Any, duration: Float[Array, ""], solver: diffrax.AbstractSolver
) -> Float[Array, " stages"] | None:
    """d at the stages of a Runge-Kutta step, whose increments `k` diffrax keeps to interpolate; None for others."""
    if not (isinstance(dense_info, dict) and "k" in dense_info and hasattr(solver, "tableau")):
        return None
    return lax.stop_gradient(dense_info["k"][:, -1] / duration)


def closest(solution: diffrax.Solution) -> Float[Array, ""]:
    """The smallest d at any stage of a diffrax solution that saved the solver's state."""
    state: Any = solution.solver_state
    return state.closest


def locked(solution: diffrax.Solution) -> Bool[Array, ""]:
    """Whether a diffrax solution that saved the solver's state ended where the mechanism locks."""
    state: Any = solution.solver_state
    return state.locks & (solution.result == diffrax.RESULTS.dt_min_reached)


_in_order = ContextVar("times_in_order", default=False)


@contextmanager
def times_in_order() -> Iterator[None]:
    """Meanwhile `diffrax.diffeqsolve` does not check times."""
    before = _in_order.set(True)
    try:
        yield
    finally:
        _in_order.reset(before)


class _Internals:
    """`equinox.internal` as diffrax sees it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(eqxi, name)

    def error_if(self, x: Any, *check: Any) -> Any:
        return x if _in_order.get() else eqxi.error_if(x, *check)


if (module := sys.modules.get(diffrax.diffeqsolve.__module__)) is not None:
    cast(Any, module).eqxi = _Internals()
