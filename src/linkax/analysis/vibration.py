"""Static equilibrium, and small motions about it, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gaps
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import known, whole_number
from linkax.simulation.accuracy import BALANCED, Accuracy
from linkax.simulation.assembly import CLOSED, LONGEST_STEP
from linkax.simulation.diagnosis import massless_bodies
from linkax.simulation.given import checked_state, checked_time, marked
from linkax.simulation.state import State
from linkax.tracing import all_known, one_by_one, pushed_forward, runs_once

MOST_STEPS = 200
AT_REST = 1e-12  # step [rad, lengths of the mechanism] below which the search for an equilibrium ends
BALANCED_STEP = 1e-8  # the same, above which it has failed
OVERSHOOT = 0.5  # of the work on a step, which forces may do against it at its end
NEUTRAL = 1e-12  # stiffness relative to the largest that counts as none

_eigh = one_by_one(jnp.linalg.eigh)
_eigenvalues = jnp.vectorize(one_by_one(jnp.linalg.eigvals), signature="(n,n)->(n)")
_pseudo_inverse = one_by_one(lambda matrix: jnp.linalg.pinv(matrix, rtol=NEUTRAL))

# Mechanisms at rest need no mass, and forces differ less between soft and stiff directions than accelerations do.
_STATICS = Accuracy(metric="identity")


class EquilibriumError(RuntimeError):
    """No equilibrium was found; `state` is where the search stopped."""

    def __init__(self, message, state=None):  # the message alone is what pickle gives, the rest follows
        super().__init__(message)
        self.state = state


def _held_system(mechanism, dtype, t) -> System:
    """The mechanism's numbers, with drives that hold their joints where they are at time t."""
    system = system_of(mechanism, dtype)
    return dataclasses.replace(system, constraints=tuple(constraint.held(t) for constraint in system.constraints))


class _Nearby(eqx.Module):
    """A mechanism near closed coordinates q, in coordinates y of the tangent space: q ⊕ T y.

    - `basis`: T, (n_v, n_v), columns orthonormal in a metric, zero where there is no tangent; `dual`: its inverse
      on the tangent space.
    """

    system: System
    method: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    basis: Float[Array, "n_v n_v"]
    dual: Float[Array, "n_v n_v"]

    def at(self, y):
        """Coordinates q."""
        return retract(self.system.topology, self.q, self.basis @ y)

    @staticmethod
    def slopes(function, rest):
        """A function of a vector at `rest`, and its derivative."""
        follow = lambda change: jax.jvp(function, (rest,), (change,))
        return jax.vmap(follow, out_axes=(None, 1))(jnp.eye(len(rest), dtype=rest.dtype))


class _Still(_Nearby):
    """Held at rest: forces, and no masses. The metric is that of radians and lengths of the mechanism."""

    @staticmethod
    def of(system, method, t, q) -> "_Still":
        basis = lax.stop_gradient(method.crossing(system, t, q).inverse.basis)
        return _Still(system, method, t, q, basis, basis.T / system.units**2)

    def force(self, y):
        """What the forces do along y, less what the loops take."""
        rest, units = jnp.zeros_like(self.system.units), self.system.units
        q = self.method.correct(self.system, self.t, self.at(y), rest)[0]
        crossing = self.method.crossing(self.system, self.t, q)
        forces, none = generalised_force(move(crossing.configuration, rest)), jnp.zeros(len(crossing.jacobian), q.dtype)
        left, _ = constrained_solve(crossing.inverse, jnp.diag(units**-2), crossing.jacobian, forces, none)
        return self.dual @ left

    def at_rest(self):
        """The force at y = 0, and the stiffness, minus its derivative."""
        force, slopes = self.slopes(self.force, jnp.zeros_like(self.system.units))
        return force, -slopes


class _Moving(_Nearby):
    """In free motion. The metric is that of the masses, and T stays orthonormal where numbers change."""

    @staticmethod
    def of(system, method, t, q) -> "_Moving":
        departure = method.departure(system, t, q)
        crossing, mass = departure.crossing, departure.mass
        fixed = crossing.inverse.basis
        still = jnp.zeros(len(crossing.jacobian), mass.dtype)

        def tangent(column):
            return constrained_solve(crossing.inverse, mass, crossing.jacobian, mass @ column, still)[0]

        basis = jax.vmap(tangent, in_axes=1, out_axes=1)(fixed)
        empty = jnp.diag((jnp.sum(fixed**2, axis=0) == 0.0).astype(mass.dtype))
        basis = basis @ cholesky_inverse_by_elimination(basis.T @ mass @ basis + empty)[0].T
        return _Moving(system, method, t, q, basis, basis.T @ mass)

    def acceleration(self, y, y_rate):
        """ÿ."""
        _, acceleration, *_ = self.method.derivative(self.system, self.t, self.at(y), self.basis @ y_rate, True)
        return self.dual @ acceleration


def equilibrium(mechanism: Mechanism, state: State, *, t=0.0) -> State:
    """A state of static equilibrium near a given one: at rest, with all forces in balance.

    The search goes downhill, so that it ends in a stable equilibrium unless it begins exactly in
    another one. Drives hold their joints where they are at time t [s]. Differentiable with
    respect to the numbers of the mechanism, to any order, and not to the state where it begins.

    **Raises:** `EquilibriumError` where the search does not come to rest, or cannot close the loops; inside
    JAX transformations nothing is raised, and coordinates are not finite then.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    found, remaining, gap = _equilibrium(mechanism, state, t)
    if not all_known((found, remaining, gap)):
        at_rest = State(jnp.where((remaining <= BALANCED_STEP) & (gap <= CLOSED), found.q, jnp.nan), found.v)
        return marked(mechanism, at_rest)
    if not gap <= CLOSED:
        raise EquilibriumError(
            f"the loops stay open by {float(gap):.3g}, in radians or lengths of the mechanism; start from a state made "
            "with linkax.assemble, which says which joint is open",
            found,
        )
    if not remaining <= BALANCED_STEP:
        raise EquilibriumError(
            f"no equilibrium near this state: step {MOST_STEPS} was still one of {float(remaining):.3g}, in radians or "
            "lengths of the mechanism; start elsewhere, or add what holds the mechanism",
            found,
        )
    return found


@runs_once
def _equilibrium(mechanism, state, t):
    system = _held_system(mechanism, state.q.dtype, t)
    q, longest = _at_rest(system, t, lax.stop_gradient(state.q))
    loops = gaps(configure(system, t, q))
    open_ = jnp.concatenate([loops.distance / system.length, loops.angle, loops.constraints / system.coupling_unit])
    gap = jnp.where(jnp.all(jnp.isfinite(state.v)), jnp.max(open_, initial=0.0), jnp.inf)
    return State(q, jnp.zeros(system.topology.num_speeds, system.dtype)), longest, gap


class _Search(NamedTuple):
    """Where a search for an equilibrium is, the step to try from there, its longest part and the forces' work on it."""

    count: Int[Array, ""]
    q: Float[Array, " n_q"]
    step: Float[Array, " n_v"]
    longest: Float[Array, ""]
    work: Float[Array, ""]


@eqx.filter_custom_jvp
def _at_rest(system, t, q):
    """Coordinates of an equilibrium, by a search from q; and the longest part of its last step."""
    method, rest = _STATICS.method(system.dtype), jnp.zeros(system.topology.num_speeds, system.dtype)
    size = lambda step: jnp.max(jnp.abs(step / system.units), initial=0.0)

    def unfinished(search):
        return (search.count < MOST_STEPS) & (search.longest > AT_REST)

    def advance(search):
        """Try a step; where it goes beyond the lowest potential, half of it next, or else a new one from there.

        A step is by the stiffness, all of whose directions count as stable.
        """
        q, _ = method.close(system, t, retract(system.topology, search.q, search.step), rest)
        still = _Still.of(system, method, t, q)
        force, stiffness = still.at_rest()
        values, vectors = _eigh((stiffness + stiffness.T) / 2.0)
        stiff = jnp.abs(values) > NEUTRAL * jnp.max(jnp.abs(values))
        along = vectors.T @ force
        downhill = vectors @ jnp.where(stiff, along / jnp.where(stiff, jnp.abs(values), 1.0), along)
        step = still.basis @ downhill
        shorter = jnp.minimum(1.0, LONGEST_STEP / jnp.where(size(step) > 0.0, size(step), 1.0))
        onwards = _Search(search.count + 1, q, shorter * step, shorter * size(step), shorter * (downhill @ force))
        half = _Search(search.count + 1, search.q, search.step / 2.0, search.longest / 2.0, search.work / 2.0)
        beyond = (still.dual @ search.step) @ force < -OVERSHOOT * search.work
        return jax.tree.map(lambda a, b: jnp.where(beyond, a, b), half, onwards)

    nothing = jnp.zeros((), system.dtype)
    begin = _Search(jnp.zeros((), int), q, rest, nothing + jnp.inf, nothing)
    found = lax.while_loop(unfinished, advance, begin)
    return found.q, found.longest


@_at_rest.def_jvp
def _at_rest_jvp(primals, changes):
    """Where the forces stay in balance, to any order: the search has no derivative."""
    (system, t, begin), (system_change, t_change, _) = primals, changes
    q, longest = _at_rest(system, t, begin)
    still = _Still.of(system, _STATICS.method(system.dtype), t, q)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    force = lambda system, t: dataclasses.replace(still, system=system, t=t).force(rest)
    _, unbalanced = pushed_forward(force, (system, t), (system_change, t_change))
    change = _pseudo_inverse(still.at_rest()[1]) @ unbalanced

    def moved(system, t, y):
        return still.method.close(system, t, retract(system.topology, q, still.basis @ y), rest)[0]

    _, q_change = pushed_forward(moved, (system, t, rest), (system_change, t_change, change))
    return (q, longest), (q_change, None)


class Linearisation(NamedTuple):
    """Small motions about a state: ÿ + damping ẏ + stiffness y = 0 on the tangent space, v = basis × ẏ.

    With d degrees of freedom:

    - `natural_frequencies`: undamped, (d,) [rad/s], rising. One that is negative is no frequency:
      its mode grows at that rate [1/s].
    - `modes`: speeds of the tree's joints in each mode, (n_v, d), of mass one.
    - `basis`: (n_v, d), orthonormal in the mass metric. `stiffness`, `damping`: (d, d) [1/s², 1/s].

    Differentiable, where no two frequencies are equal.
    """

    natural_frequencies: Float[Array, " d"]
    modes: Float[Array, "n_v d"]
    basis: Float[Array, "n_v d"]
    stiffness: Float[Array, "d d"]
    damping: Float[Array, "d d"]

    @property
    def eigenvalues(self) -> Complex[Array, " 2d"]:
        """Of the motion with damping [1/s]; with first derivatives alone."""
        nothing = jnp.zeros_like(self.stiffness)
        identity = nothing + jnp.eye(nothing.shape[-1])
        return _eigenvalues(jnp.block([[nothing, identity], [-self.stiffness, -self.damping]]))


def linearise(mechanism: Mechanism, state: State, *, t=0.0, degrees_of_freedom: int | None = None) -> Linearisation:
    """Natural frequencies and modes about a state at rest, see `linkax.equilibrium`.

    **Arguments:** `degrees_of_freedom`: of the mechanism; needed inside JAX transformations, where
    they cannot be found.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    if degrees_of_freedom is None:
        rank = known(_rank(mechanism, state, t))
        if rank is None:
            raise ValueError("linearise inside a JAX transformation needs degrees_of_freedom=; give their number")
        degrees_of_freedom = mechanism.topology.num_speeds - int(rank)
    asked = whole_number(degrees_of_freedom, "degrees_of_freedom", least=0)
    found, there = _linearise(mechanism, state, t, asked)
    if known(there) is not None and there != asked:
        raise ValueError(f"degrees_of_freedom is {asked}; the mechanism has {there} here: give that, or leave it out")
    frequencies = known(found.natural_frequencies)
    if frequencies is not None and not np.all(np.isfinite(frequencies)):
        system = system_of(mechanism, state.q.dtype)
        massless = massless_bodies(system, BALANCED.method(system.dtype), t, state.q)
        why = f"bodies {', '.join(map(repr, massless))} move without mass" if massless else "forces are not finite"
        raise ValueError(f"frequencies are not finite, because {why}; give mass and inertia, or finite numbers")
    return marked(mechanism, found)


@runs_once
def _rank(mechanism, state, t):
    system = _held_system(mechanism, state.q.dtype, t)
    return jnp.sum(BALANCED.method(system.dtype).crossing(system, t, state.q).inverse.rank)


@runs_once
def _linearise(mechanism, state, t, count):
    system = _held_system(mechanism, state.q.dtype, t)
    method = BALANCED.method(system.dtype)
    moving = _Moving.of(system, method, t, state.q)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    none = jnp.sum(moving.basis**2, axis=0) == 0.0
    columns = jnp.argsort(none)[:count]
    at_columns = lambda matrix: matrix[columns[:, None], columns[None, :]]
    _, slopes = moving.slopes(lambda both: moving.acceleration(*jnp.split(both, 2)), jnp.concatenate([rest, rest]))
    stiffness, damping = (at_columns(-part) for part in jnp.split(slopes, 2, axis=1))
    values, vectors = _eigh((stiffness + stiffness.T) / 2.0)
    basis = moving.basis[:, columns]
    found = Linearisation(
        natural_frequencies=jnp.sign(values) * jnp.sqrt(jnp.where(values == 0.0, 1.0, jnp.abs(values))),
        modes=basis @ vectors,
        basis=basis,
        stiffness=stiffness,
        damping=damping,
    )
    return found, jnp.sum(jnp.logical_not(none))
