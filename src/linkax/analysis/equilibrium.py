"""Find an equilibrium, at rest or in steady motion, by a search downhill on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Bool, Float

from linkax.analysis.equilibrium_search import MOST_STEPS, STATICS, Balanced, search_downhill, search_standstill
from linkax.analysis.steady import (
    AGREES,
    instants,
    largest_force,
    may_move,
    missed_rates,
    of_missed_rate,
    system_in,
    widest_gap,
)
from linkax.equations.coordinates import retract
from linkax.equations.internal_states import bound
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.closing import CLOSED
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked, require_double_precision
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import all_concrete, evaluate_now
from linkax.xla.undefined import nan_where
from linkax.xla.users_line import warn
from scalarjit import scalarised

BALANCED_STEP = 1e-8  # last step above which the search has failed [rad, lengths of the mechanism]


class EquilibriumError(RuntimeError):
    """No equilibrium was found; `state` is where the search stopped."""

    def __init__(self, message: str, state: State | None = None) -> None:  # pickle calls it with the message alone
        super().__init__(message)
        self.state = state


class StabilityWarning(UserWarning):
    """An equilibrium may be unstable, which forces without a potential do not show."""


class _Ending(NamedTuple):
    """How a search ended.

    - `longest`: largest part of the last step, and `gap`: of the loops [rad, lengths of the mechanism].
    - `unstable`: whether the potential falls further in some direction.
    - `circulatory`: whether the equilibrium may be unstable, and stiffness without a potential hides it.
    - `missed`: by how much speeds miss the rate that each drive asks for, (k,), one entry for each constraint.
    - `changes`: relative forces and gaps of the loops that appear as the motion goes on.
    """

    longest: Float[Array, ""]
    gap: Float[Array, ""]
    unstable: Bool[Array, ""]
    circulatory: Bool[Array, ""]
    missed: Float[Array, " k"]
    changes: Float[Array, ""]

    @property
    def is_sound(self) -> Bool[Array, ""]:
        """Whether the search ended in an equilibrium."""
        steady = (jnp.max(self.missed, initial=0.0) <= AGREES) & (self.changes <= AGREES)
        return (self.longest <= BALANCED_STEP) & (self.gap <= CLOSED) & jnp.logical_not(self.unstable) & steady


def equilibrium(mechanism: Mechanism, state: State, *, t: ArrayLike = 0.0) -> State:
    """Find a stable equilibrium near a state: all forces balance, and no joint moves but those that drives move.

    Where all speeds of the state are zero, drives hold their joints in their positions at time t [s]. Else drives go
    on, at rates that the state must have, such as a rotation at constant speed: the result is a steady motion, in which
    centrifugal forces act and no other joint moves. Speeds of joints without drive are ignored.

    The search minimises the (effective) potential, and leaves unstable equilibria. Forces without a potential can make
    an equilibrium unstable without the search noticing: a `StabilityWarning` says where they may, and the eigenvalues
    of `linkax.linearise` decide.

    Differentiable to any order with respect to the mechanism's numbers, and not with respect to the initial state.

    **Arguments:** `mechanism`, `state`: see `linkax.simulate`; the search begins at the state. `t`: time [s].

    **Returns:** the `State` in equilibrium.

    Where force elements have internal states, such as currents and pressures, these stand still too. They have no
    potential, so that the search takes stable and unstable equilibria alike: see the eigenvalues of `linkax.linearise`.
    What the equations leave open, such as the pressure of locked oil, changes as little as they allow.

    **Raises:** `EquilibriumError` where the search does not converge, cannot close the loops or leave an unstable
    equilibrium, or where driven joints do not move steadily. Inside JAX transformations nothing is raised, and
    coordinates are NaN. `ValueError` for a state in single precision.

    **Warns:** `StabilityWarning`.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    require_double_precision(state, "state")
    moves = may_move(state) and any(constraint.is_driven for constraint in mechanism.constraints)
    reached, ending = _equilibrium(mechanism, state, t, moves)
    if not moves:
        # Concrete inside transformations too: whoever reads the state sees that nothing moves.
        reached = dataclasses.replace(reached, v=evaluate_now(jnp.zeros, reached.v.shape, reached.v.dtype))
    if not all_concrete((reached, ending)):
        q = nan_where(jnp.logical_not(ending.is_sound), reached.q, (mechanism, t))
        return dataclasses.replace(reached, q=marked(mechanism, q))
    _check_steady(mechanism, ending, reached, t)
    if not ending.gap <= CLOSED:
        raise EquilibriumError(
            f"the loops stay open by {float(ending.gap):.3g}, in radians or lengths of the mechanism; start from a "
            "state made with linkax.assemble, which says which joint is open",
            reached,
        )
    if not ending.longest <= BALANCED_STEP:
        raise EquilibriumError(
            f"no equilibrium near this state: step {MOST_STEPS} was still one of {float(ending.longest):.3g}, in "
            "radians or lengths of the mechanism; start elsewhere, or add what holds the mechanism",
            reached,
        )
    if ending.unstable:
        told = "the equilibrium found is unstable, and no way leads on from it; start elsewhere"
        raise EquilibriumError(told, reached)
    if ending.circulatory:
        remedy = "see the eigenvalues of linkax.linearise there"
        message = f"the equilibrium may be unstable: some of the forces have no potential; {remedy}"
        warn(message, StabilityWarning)
    return reached


def _check_steady(mechanism, ending, reached, t):
    """Raise an EquilibriumError where drives do not move steadily."""
    still = "give a state with speeds of zero, for the equilibrium where drives hold"
    missed = np.asarray(ending.missed)
    misses = np.logical_not(missed <= AGREES)
    if np.any(misses):
        told = of_missed_rate(mechanism, missed, int(np.argmax(misses)), t)
        raise EquilibriumError(f"{told}, or {still}", reached)
    if ending.longest <= BALANCED_STEP and not ending.changes <= AGREES:
        driven = [constraint.display_name for constraint in mechanism.constraints if constraint.is_driven]
        raise EquilibriumError(
            f"no equilibrium lasts while {' and '.join(driven)} goes on: forces or loops change by "
            f"{float(ending.changes):.3g} of the largest; {still}, or drive at a constant rate what changes neither",
            reached,
        )


@scalarised
def _equilibrium(mechanism, state, t, moves):
    """The state in which the search ends, and its `_Ending`."""
    system = system_in(mechanism, state, t, moves)
    internal = state.internal
    if internal is None:
        q, search = search_downhill(system, t, lax.stop_gradient(state.q))
        lowest, circulation = search.lowest, search.circulation
    else:
        q, internal, search = search_standstill(system, t, *lax.stop_gradient((state.q, internal)))
        system, lowest, circulation = bound(system, internal), jnp.zeros((), system.dtype), 0.0
    v, method = jnp.zeros(system.topology.num_speeds, system.dtype), STATICS.prepared(system.dtype)
    topology = system.topology
    missed, changes = jnp.zeros(topology.num_constraint_rows, system.dtype), jnp.zeros((), system.dtype)
    gap = jnp.where(jnp.all(jnp.isfinite(state.v)), widest_gap(system, t, q), jnp.inf)
    if moves:
        v = method.correct(system, t, q, v)[1]
        driven = np.array([constraint.is_driven for constraint in system.constraints])[topology.constraint_of_row]
        rates = missed_rates(system, t, state.q, state.v)[-len(driven) :]
        missed = jnp.where(driven, rates, 0.0)
        changes = _changes(system, method, t, q, v)
    unstable = lowest < 0.0
    circulatory = unstable & (circulation > -lowest)
    ending = _Ending(search.longest, gap, unstable & ~circulatory, circulatory, missed, changes)
    return State(q, v, system.topology, internal), lax.stop_gradient(ending)


def _changes(system, method, t, q, v):
    """The largest force, relative to all forces, and gap of the loops as the motion goes on at speeds v."""

    def at(duration):
        later = Balanced.of(system, method, t + duration, retract(system.topology, q, duration * v))
        zero = jnp.zeros_like(v)
        scale, left = largest_force(later.motion(zero)[0]), jnp.max(jnp.abs(later.force(zero)), initial=0.0)
        gap = widest_gap(system, later.t, later.q)
        return jnp.maximum(ratio(left, scale), gap)

    return jnp.max(lax.map(at, instants(system, v)))
