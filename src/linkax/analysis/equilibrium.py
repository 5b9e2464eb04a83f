"""Find an equilibrium, at rest or in steady motion, by a search downhill on the tangent space of the loops."""

import dataclasses
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Bool, Float, Int

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
from linkax.equations.motion import Motion, move
from linkax.equations.system import System
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.closing import CLOSED, LONGEST_STEP
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import pushforward
from linkax.xla.tracing import all_concrete, evaluate_now, quick_compile

MOST_STEPS = 200
SMALLEST_STEP = 1e-12  # at which the search ends [rad, lengths of the mechanism]
BALANCED_STEP = 1e-8  # last step above which the search has failed [rad, lengths of the mechanism]
OVERSHOOT = 0.5  # work of the forces at the end of a step, against it, relative to their work at its start
NEUTRAL = 1e-12  # stiffness, relative to the largest, up to which it counts as zero
ASIDE = 1e-3  # first step out of an unstable equilibrium [rad, lengths of the mechanism]; each next one doubles it

_pseudo_inverse = one_by_one(lambda matrix: jnp.linalg.pinv(matrix, rtol=NEUTRAL))

# An equilibrium needs no mass, and forces differ less between soft and stiff directions than accelerations do.
_STATICS = TangentSpace(metric="identity")


class EquilibriumError(RuntimeError):
    """No equilibrium was found; `state` is where the search stopped."""

    def __init__(self, message: str, state: State | None = None) -> None:  # pickle calls it with the message alone
        super().__init__(message)
        self.state = state


class StabilityWarning(UserWarning):
    """An equilibrium may be unstable, which forces without a potential do not show."""


class _Balanced(Nearby):
    """A mechanism near an equilibrium: its forces, centrifugal ones included, on a T orthonormal in the scales."""

    @staticmethod
    def of(system: System, method: TangentSpace, t: Float[Array, ""], q: Float[Array, " n_q"]) -> "_Balanced":
        basis = lax.stop_gradient(method.constraint_split(system, t, q).inverse.basis)
        return _Balanced(system, method, t, q, basis, basis.T / system.scales**2)

    def motion(self, y: Float[Array, " n_v"]) -> tuple[Motion, ConstraintSplit]:
        """The motion at y, v as drives ask and else as small as the loops allow, and the constraints there."""
        zero = jnp.zeros_like(self.system.scales)
        q, v, *_ = self.method.correct(self.system, self.t, self.at(y), zero)
        crossing = self.method.constraint_split(self.system, self.t, q)
        return move(crossing.configuration, v if is_driven(self.system) else zero), crossing

    def force(self, y: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
        """Forces along y, less the reactions of the loops."""
        motion, crossing = self.motion(y)
        forces, none = generalised_force(motion), jnp.zeros(len(crossing.jacobian), y.dtype)
        metric = jnp.diag(self.system.scales**-2)
        left, _ = constrained_solve(crossing.inverse, metric, crossing.jacobian, forces, none)
        return self.dual @ left

    def force_and_stiffness(self) -> tuple[Float[Array, " n_v"], Float[Array, "n_v n_v"]]:
        """The force f at y = 0, and the stiffness −∂f/∂y."""
        force, slopes = self.slopes(self.force, jnp.zeros_like(self.system.scales))
        return force, -slopes


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

    **Raises:** `EquilibriumError` where the search does not converge, cannot close the loops or leave an unstable
    equilibrium, or where driven joints do not move steadily. Inside JAX transformations nothing is raised, and
    coordinates are NaN.

    **Warns:** `StabilityWarning`.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    moves = may_move(state) and any(constraint.is_driven for constraint in mechanism.constraints)
    reached, ending = _equilibrium(mechanism, state, t, moves)
    if not moves:
        # Concrete inside transformations too: whoever reads the state sees that nothing moves.
        reached = State(reached.q, evaluate_now(jnp.zeros, reached.v.shape, reached.v.dtype))
    if not all_concrete((reached, ending)):
        return State(marked(mechanism, jnp.where(ending.is_sound, reached.q, jnp.nan)), reached.v)
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
        warnings.warn(message, StabilityWarning, stacklevel=2)
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


@quick_compile
def _equilibrium(mechanism, state, t, moves):
    """The state in which the search ends, and its `_Ending`."""
    system = system_in(mechanism, state, t, moves)
    q, search = _search(system, t, lax.stop_gradient(state.q))
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
    """The largest force, relative to all forces, and gap of the loops as the motion goes on at speeds v."""

    def at(instant):
        later = _Balanced.of(system, method, instant.t, retract(system.topology, q, instant.motion))
        zero = jnp.zeros_like(v)
        scale, left = largest_force(later.motion(zero)[0]), jnp.max(jnp.abs(later.force(zero)), initial=0.0)
        gap = widest_gap(system, instant.t, later.q)
        return jnp.maximum(jnp.where(left > 0.0, left / jnp.where(scale > 0.0, scale, 1.0), 0.0), gap)

    return jnp.max(lax.map(at, instants(system, t, v)))


class _Search(NamedTuple):
    """A search for an equilibrium.

    - `steps`: number of steps tried.
    - `q`: coordinates reached. `step`: change of them to try next, (n_v,); `longest`: its largest part [rad, lengths of
      the mechanism]; `work`: of the forces on it [J].
    - `lowest`: smallest stiffness in any direction, zero where none is negative.
    - `circulation`: largest entry of the skew part of the stiffness, which has no potential.
    """

    steps: Int[Array, ""]
    q: Float[Array, " n_q"]
    step: Float[Array, " n_v"]
    longest: Float[Array, ""]
    work: Float[Array, ""]
    lowest: Float[Array, ""]
    circulation: Float[Array, ""]


@eqx.filter_custom_jvp
def _search(system, t, q):
    """Coordinates of an equilibrium, and the last `_Search`, from coordinates q."""
    method, zero = _STATICS.prepared(system.dtype), jnp.zeros(system.topology.num_speeds, system.dtype)
    size = system.fastest

    def unfinished(search):
        return (search.steps < MOST_STEPS) & (search.longest > SMALLEST_STEP)

    def advance(search):
        """Try a step. If it goes beyond the minimum of the potential, halve it, else choose the next one from there.

        A step is f / |k| along each eigenvector of the stiffness. At an equilibrium that is unstable it is one along
        the least stable direction.
        """
        q, _ = method.close(system, t, retract(system.topology, search.q, search.step), zero)
        here = _Balanced.of(system, method, t, q)
        force, stiffness = here.force_and_stiffness()
        values, vectors = eigh((stiffness + stiffness.T) / 2.0)
        stiff = jnp.abs(values) > NEUTRAL * jnp.max(jnp.abs(values))
        along = vectors.T @ force
        downhill = vectors @ jnp.where(stiff, along / jnp.where(stiff, jnp.abs(values), 1.0), along)
        step = here.basis @ downhill
        shorter = jnp.minimum(1.0, LONGEST_STEP / jnp.where(size(step) > 0.0, size(step), 1.0))
        lowest = jnp.where(stiff[0], jnp.minimum(values[0], 0.0), 0.0)
        circulation = jnp.max(jnp.abs(stiffness - stiffness.T)) / 2.0
        aside = here.basis @ vectors[:, 0]
        # The sign of an eigenvector is arbitrary: let its largest part be positive.
        aside = aside * jnp.sign(aside[jnp.argmax(jnp.abs(aside / system.scales))])
        leave = (size(step) <= SMALLEST_STEP) & (lowest < 0.0) & (circulation <= -lowest)
        step, work = jnp.where(leave, ASIDE * aside / size(aside), shorter * step), shorter * (downhill @ force)
        onwards = _Search(search.steps + 1, q, step, size(step), jnp.where(leave, 0.0, work), lowest, circulation)
        half = search._replace(
            steps=search.steps + 1, step=search.step / 2.0, longest=search.longest / 2.0, work=search.work / 2.0
        )
        beyond = (here.dual @ search.step) @ force < -OVERSHOOT * search.work
        return jax.tree.map(lambda a, b: jnp.where(beyond, a, b), half, onwards)

    nothing = jnp.zeros((), system.dtype)
    begin = _Search(jnp.zeros((), int), q, zero, nothing + jnp.inf, *3 * (nothing,))
    search = lax.while_loop(unfinished, advance, begin)
    return search.q, search


@_search.def_jvp
def _search_jvp(primals, changes):
    """Derivatives, to any order, of the coordinates at which the forces balance; those of the search do not matter."""
    (system, t, begin), (system_change, t_change, _) = primals, changes
    q, search = _search(system, t, begin)
    here = _Balanced.of(system, _STATICS.prepared(system.dtype), t, q)
    zero = jnp.zeros(system.topology.num_speeds, system.dtype)
    force = lambda system, t: dataclasses.replace(here, system=system, t=t).force(zero)
    _, unbalanced = pushforward(force, (system, t), (system_change, t_change))
    change = _pseudo_inverse(here.force_and_stiffness()[1]) @ unbalanced

    def moved(system, t, y):
        return here.method.close(system, t, retract(system.topology, q, here.basis @ y), zero)[0]

    _, q_change = pushforward(moved, (system, t, zero), (system_change, t_change, change))
    return (q, search), (q_change, jax.tree.map(lambda _: None, search))
