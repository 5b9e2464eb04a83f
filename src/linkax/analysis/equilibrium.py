"""Equilibrium, at rest or in steady motion: a search downhill on the tangent space of the loops."""

import dataclasses
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from linkax.analysis.steady import (
    AGREES,
    Nearby,
    eigh,
    instants,
    largest_force,
    may_move,
    missed_rates,
    of_missed_rate,
    system_in,
    widest_gap,
)
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import is_driven
from linkax.equations.motion import move
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.closing import CLOSED, LONGEST_STEP
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import pushforward
from linkax.xla.tracing import all_concrete, evaluate_now, quick_compile

MOST_STEPS = 200
AT_REST = 1e-12  # step [rad, lengths of the mechanism] below which the search for an equilibrium ends
BALANCED_STEP = 1e-8  # the same, above which it has failed
OVERSHOOT = 0.5  # of the work on a step, which forces may do against it at its end
NEUTRAL = 1e-12  # stiffness relative to the largest that counts as none
ASIDE = 1e-3  # first step out of an unstable equilibrium [rad, lengths of the mechanism]; each next one doubles it

_pseudo_inverse = one_by_one(lambda matrix: jnp.linalg.pinv(matrix, rtol=NEUTRAL))

# Equilibria need no mass, and forces differ less between soft and stiff directions than accelerations do.
_STATICS = TangentSpace(metric="identity")


class EquilibriumError(RuntimeError):
    """No equilibrium was found; `state` is where the search stopped."""

    def __init__(self, message, state=None):  # the message alone is what pickle gives, the rest follows
        super().__init__(message)
        self.state = state


class StabilityWarning(UserWarning):
    """An equilibrium that may be unstable: forces without a potential do not tell."""


class _Balanced(Nearby):
    """Forces, and no masses but for their centrifugal forces. The metric is that of radians and lengths."""

    @staticmethod
    def of(system, method, t, q) -> "_Balanced":
        basis = lax.stop_gradient(method.constraint_split(system, t, q).inverse.basis)
        return _Balanced(system, method, t, q, basis, basis.T / system.scales**2)

    def motion(self, y):
        """How the mechanism moves at y: as drives ask, and else as little as the loops allow. And its loops there."""
        rest = jnp.zeros_like(self.system.scales)
        q, v, *_ = self.method.correct(self.system, self.t, self.at(y), rest)
        crossing = self.method.constraint_split(self.system, self.t, q)
        return move(crossing.configuration, v if is_driven(self.system) else rest), crossing

    def force(self, y):
        """What the forces do along y, less what the loops take."""
        motion, crossing = self.motion(y)
        forces, none = generalised_force(motion), jnp.zeros(len(crossing.jacobian), y.dtype)
        metric = jnp.diag(self.system.scales**-2)
        left, _ = constrained_solve(crossing.inverse, metric, crossing.jacobian, forces, none)
        return self.dual @ left

    def at_rest(self):
        """The force at y = 0, and the stiffness, minus its derivative."""
        force, slopes = self.slopes(self.force, jnp.zeros_like(self.system.scales))
        return force, -slopes


class _Ending(NamedTuple):
    """How a search ended.

    - `longest`: part of the last step. `gap`: of the loops.
    - `unstable`: whether a direction leads further down; `circulatory`: whether that may be so and stiffness has
      a part without a potential, as large as what is unstable.
    - `missed`: rates that drives ask for and the state has not, one for each constraint. `changes`: how forces and
      loops differ from an equilibrium later on.
    """

    longest: Float[Array, ""]
    gap: Float[Array, ""]
    unstable: Bool[Array, ""]
    circulatory: Bool[Array, ""]
    missed: Float[Array, " k"]
    changes: Float[Array, ""]

    @property
    def is_sound(self):
        """Whether an equilibrium is found."""
        steady = (jnp.max(self.missed, initial=0.0) <= AGREES) & (self.changes <= AGREES)
        return (self.longest <= BALANCED_STEP) & (self.gap <= CLOSED) & jnp.logical_not(self.unstable) & steady


def equilibrium(mechanism: Mechanism, state: State, *, t=0.0) -> State:
    """A stable equilibrium near a given state: all forces in balance, and nothing moves but what is driven.

    Where the speeds of the state are zero it is one at rest, and drives hold their joints where they are at time t [s].
    Else drives go on, at rates that the state must have, such as a rotation at a constant rate: the equilibrium
    is that of a steady motion, in which nothing else moves, with its centrifugal forces. Speeds of the state
    that nothing drives do not matter.

    The search goes downhill, and on from equilibria that are unstable, to a least (effective) potential. Forces
    without a potential may make an equilibrium unstable unseen; where they may, a `StabilityWarning` says so, and the
    eigenvalues of `linkax.linearise` tell.

    Differentiable with respect to the numbers of the mechanism, to any order, and not to the state where it begins.

    **Raises:** `EquilibriumError` where the search does not come to rest, cannot close the loops or leave an
    unstable equilibrium, or where what is driven does not move steadily; inside JAX transformations nothing
    is raised, and coordinates are not finite then.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    moves = may_move(state) and any(constraint.is_driven for constraint in mechanism.constraints)
    found, ending = _equilibrium(mechanism, state, t, moves)
    if not moves:
        # Known inside of transformations too, so that what reads the state need not reckon with motion.
        found = State(found.q, evaluate_now(jnp.zeros, found.v.shape, found.v.dtype))
    if not all_concrete((found, ending)):
        return State(marked(mechanism, jnp.where(ending.is_sound, found.q, jnp.nan)), found.v)
    _check_steady(mechanism, ending, found, t)
    if not ending.gap <= CLOSED:
        raise EquilibriumError(
            f"the loops stay open by {float(ending.gap):.3g}, in radians or lengths of the mechanism; start from a "
            "state made with linkax.assemble, which says which joint is open",
            found,
        )
    if not ending.longest <= BALANCED_STEP:
        raise EquilibriumError(
            f"no equilibrium near this state: step {MOST_STEPS} was still one of {float(ending.longest):.3g}, in "
            "radians or lengths of the mechanism; start elsewhere, or add what holds the mechanism",
            found,
        )
    if ending.unstable:
        raise EquilibriumError("the equilibrium found is unstable, and no way leads on from it; start elsewhere", found)
    if ending.circulatory:
        remedy = "see the eigenvalues of linkax.linearise there"
        message = f"the equilibrium may be unstable: some of the forces have no potential; {remedy}"
        warnings.warn(message, StabilityWarning, stacklevel=2)
    return found


def _check_steady(mechanism, ending, found, t):
    """Raise where drives do not move steadily."""
    still = "give a state with speeds of zero, for the equilibrium where drives hold"
    missed = np.asarray(ending.missed)
    misses = np.logical_not(missed <= AGREES)
    if np.any(misses):
        told = of_missed_rate(mechanism, missed, int(np.argmax(misses)), t)
        raise EquilibriumError(f"{told}, or {still}", found)
    if ending.longest <= BALANCED_STEP and not ending.changes <= AGREES:
        driven = [constraint.display_name for constraint in mechanism.constraints if constraint.is_driven]
        raise EquilibriumError(
            f"no equilibrium lasts while {' and '.join(driven)} goes on: forces or loops change by "
            f"{float(ending.changes):.3g} of the largest; {still}, or drive at a constant rate what changes neither",
            found,
        )


@quick_compile
def _equilibrium(mechanism, state, t, moves):
    system = system_in(mechanism, state, t, moves)
    q, search = _at_rest(system, t, lax.stop_gradient(state.q))
    v, method = jnp.zeros(system.topology.num_speeds, system.dtype), _STATICS.prepared(system.dtype)
    missed, changes = jnp.zeros(len(system.constraints), system.dtype), jnp.zeros((), system.dtype)
    gap = jnp.where(jnp.all(jnp.isfinite(state.v)), widest_gap(system, t, q), jnp.inf)
    if moves:
        v = method.correct(system, t, q, v)[1]
        driven = np.array([constraint.is_driven for constraint in system.constraints])
        rates = missed_rates(system, t, state.q, state.v)[-len(driven) :]
        missed = jnp.where(driven, rates, 0.0)
        changes = _changes(system, method, t, q, v)
    unstable = search.lowest < 0.0
    circulatory = unstable & (search.circulation > -search.lowest)
    ending = _Ending(search.longest, gap, unstable & ~circulatory, circulatory, missed, changes)
    return State(q, v), lax.stop_gradient(ending)


def _changes(system, method, t, q, v):
    """How far a motion on at speeds v leads from balance and from closed loops, relative to all forces."""

    def at(instant):
        later = _Balanced.of(system, method, instant.t, retract(system.topology, q, instant.motion))
        rest = jnp.zeros_like(v)
        scale, left = largest_force(later.motion(rest)[0]), jnp.max(jnp.abs(later.force(rest)), initial=0.0)
        gap = widest_gap(system, instant.t, later.q)
        return jnp.maximum(jnp.where(left > 0.0, left / jnp.where(scale > 0.0, scale, 1.0), 0.0), gap)

    return jnp.max(lax.map(at, instants(system, t, v)))


class _Search(NamedTuple):
    """Where a search for an equilibrium is, the step to try from there, its longest part and the forces' work on it.

    `lowest`: stiffness of all directions, zero where none is unstable; `circulation`: the largest part of the stiffness
    without a potential.
    """

    count: Int[Array, ""]
    q: Float[Array, " n_q"]
    step: Float[Array, " n_v"]
    longest: Float[Array, ""]
    work: Float[Array, ""]
    lowest: Float[Array, ""]
    circulation: Float[Array, ""]


@eqx.filter_custom_jvp
def _at_rest(system, t, q):
    """Coordinates of an equilibrium, by a search from q; and how it ended."""
    method, rest = _STATICS.prepared(system.dtype), jnp.zeros(system.topology.num_speeds, system.dtype)
    size = system.fastest

    def unfinished(search):
        return (search.count < MOST_STEPS) & (search.longest > AT_REST)

    def advance(search):
        """Try a step; where it goes beyond the lowest potential, half of it next, or else a new one from there.

        A step is by the stiffness, all of whose directions count as stable. Where that leads no further, it is one
        out of an unstable equilibrium, if it is one.
        """
        q, _ = method.close(system, t, retract(system.topology, search.q, search.step), rest)
        here = _Balanced.of(system, method, t, q)
        force, stiffness = here.at_rest()
        values, vectors = eigh((stiffness + stiffness.T) / 2.0)
        stiff = jnp.abs(values) > NEUTRAL * jnp.max(jnp.abs(values))
        along = vectors.T @ force
        downhill = vectors @ jnp.where(stiff, along / jnp.where(stiff, jnp.abs(values), 1.0), along)
        step = here.basis @ downhill
        shorter = jnp.minimum(1.0, LONGEST_STEP / jnp.where(size(step) > 0.0, size(step), 1.0))
        lowest = jnp.where(stiff[0], jnp.minimum(values[0], 0.0), 0.0)
        circulation = jnp.max(jnp.abs(stiffness - stiffness.T)) / 2.0
        aside = here.basis @ vectors[:, 0]
        # The sign of an eigenvector is chance.
        aside = aside * jnp.sign(aside[jnp.argmax(jnp.abs(aside / system.scales))])
        leave = (size(step) <= AT_REST) & (lowest < 0.0) & (circulation <= -lowest)
        step, work = jnp.where(leave, ASIDE * aside / size(aside), shorter * step), shorter * (downhill @ force)
        onwards = _Search(search.count + 1, q, step, size(step), jnp.where(leave, 0.0, work), lowest, circulation)
        half = search._replace(
            count=search.count + 1, step=search.step / 2.0, longest=search.longest / 2.0, work=search.work / 2.0
        )
        beyond = (here.dual @ search.step) @ force < -OVERSHOOT * search.work
        return jax.tree.map(lambda a, b: jnp.where(beyond, a, b), half, onwards)

    nothing = jnp.zeros((), system.dtype)
    begin = _Search(jnp.zeros((), int), q, rest, nothing + jnp.inf, *3 * (nothing,))
    found = lax.while_loop(unfinished, advance, begin)
    return found.q, found


@_at_rest.def_jvp
def _at_rest_jvp(primals, changes):
    """Where the forces stay in balance, to any order: the search has no derivative."""
    (system, t, begin), (system_change, t_change, _) = primals, changes
    q, search = _at_rest(system, t, begin)
    here = _Balanced.of(system, _STATICS.prepared(system.dtype), t, q)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    force = lambda system, t: dataclasses.replace(here, system=system, t=t).force(rest)
    _, unbalanced = pushforward(force, (system, t), (system_change, t_change))
    change = _pseudo_inverse(here.at_rest()[1]) @ unbalanced

    def moved(system, t, y):
        return here.method.close(system, t, retract(system.topology, q, here.basis @ y), rest)[0]

    _, q_change = pushforward(moved, (system, t, rest), (system_change, t_change, change))
    return (q, search), (q_change, jax.tree.map(lambda _: None, search))
