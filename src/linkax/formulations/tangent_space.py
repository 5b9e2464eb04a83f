"""The paper's method: tangent and normal space by column-pivoted QR.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
Positions and velocities are corrected along the normal space before the equations of motion are
formed; accelerations and multipliers follow from the same split.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import on_manifold, retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma, is_driven, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations.branches import Crossing
from linkax.formulations.formulation import AbstractFormulation, Coefficients, Dynamics, coefficients
from linkax.formulations.linearised import Changes, Moved, moved, unbalanced
from linkax.formulations.passage import Course, Value, limit
from linkax.linalg.chained_inverse import ChainedInverse, SaddlePointInCells, invert_chain, with_identity_metric
from linkax.linalg.constrained_solve import (
    Inverse,
    SaddlePoint,
    constrained_solve,
    invert_apart,
    least_multipliers,
    singularity_distance,
    with_mass,
)
from linkax.tracing import traced_once

ROUNDING_ULPS = 8.0
MOST_CORRECTIONS = 20
ALONG = (1e-4, 1e-3, 1e-2)  # radians or lengths of the mechanism, along which ranks of cells show


class Departure(NamedTuple):
    """A configuration as a crossing of branches, and v̇ at rest there.

    - `mass`: M. `definiteness`: of M on the tangent space, see `linkax.linalg.constrained_solve.Inverse`.
    """

    crossing: Crossing
    mass: Float[Array, "n_v n_v"]
    acceleration: Float[Array, " n_v"]
    definiteness: Float[Array, ""]


def _of_islands(topology, ranks):
    """Ranks of cells, (k,), added up for each island."""
    return jnp.asarray(topology.cells_of_islands, int) @ ranks


def _largest(rows):
    return jnp.max(jnp.abs(rows), initial=0.0)


class TangentSpace(AbstractFormulation):
    """Corrections, accelerations and multipliers by the split of the space of speeds.

    - `rank_tolerance`: τ; a loop row is independent where |R_kk| > τ max(|R₁₁|, 1).
    - `rank_nearby`: rank of each island (see `linkax.model.topology.Topology`), or of each cell of its
      chain where it has one, along the motion, where it is known; in a singular configuration the rank
      itself is smaller.
    - `metric`: in which corrections are smallest and normal and tangent space orthogonal:
      "mass" (W = M + JᵀDJ) or "identity" (radians, and lengths of the mechanism).
    - `corrections`: position corrections in each evaluation and after each step.
    """

    rank_tolerance: Float[Array, ""]
    rank_nearby: Int[Array, " k"] | None = None
    metric: Literal["mass", "identity"] = eqx.field(static=True, default="mass")
    corrections: int = eqx.field(static=True, default=1)

    @property
    def nearest(self):
        """Below the rank tolerance rows count as dependent."""
        return self.rank_tolerance

    @property
    def moves_after_steps(self) -> bool:
        """No: derivatives are those of the corrected state."""
        return False

    def _weight(self, instant: Coefficients):
        """W of the corrections."""
        if self.metric == "mass":
            return instant.mass
        return jnp.diag(instant.configuration.system.units**-2)

    def _ranks_of_islands(self, topology):
        """`rank_nearby` of the islands."""
        if topology.chain is None or self.rank_nearby is None:
            return self.rank_nearby
        return _of_islands(topology, self.rank_nearby)

    def _split_at_once(self, instant: Coefficients) -> Inverse:
        """The split with a basis of the tangent space."""
        weight = instant.mass if self.metric == "mass" else None
        system = instant.configuration.system
        islands, ranks = system.topology.islands, self._ranks_of_islands(system.topology)
        return invert_apart(weight, instant.jacobian, system.units, self.rank_tolerance, islands, ranks)

    def _split(self, instant: Coefficients) -> Inverse | ChainedInverse:
        """The split as it is found soonest."""
        if instant.configuration.system.topology.chain is None:
            return self._split_at_once(instant)
        return self._chained(instant, self._blocks(instant))

    def _chained(self, instant: Coefficients, blocks) -> ChainedInverse:
        system = instant.configuration.system
        return invert_chain(blocks, system.units, self.rank_tolerance, system.topology.chain, self.rank_nearby)

    def _blocks(self, instant: Coefficients):
        """What cells have of J and of the weight of corrections; None without cells."""
        system = instant.configuration.system
        if instant.blocks is None or self.metric == "mass":
            return instant.blocks
        return with_identity_metric(instant.blocks, system.topology.chain, system.units)

    def _product(self, instant: Coefficients, weight, blocks):
        """[[W, -Jᵀ], [J, 0]] as a function of one vector."""
        if blocks is None:
            return SaddlePoint(weight, instant.jacobian)
        return SaddlePointInCells(blocks, instant.configuration.system.topology.chain, instant.jacobian.shape[::-1])

    def _for_dynamics(self, split, instant: Coefficients):
        """The inverse with M, for the same split."""
        if self.metric == "mass":
            return split
        if isinstance(split, ChainedInverse):
            return self._chained(instant, instant.blocks)
        return with_mass(split, instant.mass)

    def _solve(self, split, instant, f, gamma, sweeps):
        """v̇ and λ of M v̇ = f + Jᵀλ, J v̇ = γ."""
        inverse, product = self._for_dynamics(split, instant), self._product(instant, instant.mass, instant.blocks)
        return constrained_solve(inverse, instant.mass, instant.jacobian, f, gamma, sweeps, product)

    def _on_velocity_level(self, instant, v, split, sweeps):
        """The speeds nearest to v that satisfy J v = b."""
        weight, configuration = self._weight(instant), instant.configuration
        asked = rate(configuration.system, configuration.t)
        product = self._product(instant, weight, self._blocks(instant))
        momentum = product(jnp.concatenate([v, jnp.zeros_like(asked)]))[: len(v)]
        return constrained_solve(split, weight, instant.jacobian, momentum, asked, sweeps, product)[0]

    def _least_change(self, instant, split, rows, sweeps):
        """The smallest change of coordinates or speeds that changes the linearised rows so much."""
        weight = self._weight(instant)
        still, product = jnp.zeros(weight.shape[0], weight.dtype), self._product(instant, weight, self._blocks(instant))
        return constrained_solve(split, weight, instant.jacobian, still, rows, sweeps, product)[0]

    def _in_tangent_space(self, instant, split, change):
        """The part of a change that keeps the loops closed."""
        product = self._product(instant, self._weight(instant), self._blocks(instant))
        none = jnp.zeros(instant.jacobian.shape[0], change.dtype)
        along, _ = split.apply(product(jnp.concatenate([change, none]))[: len(change)], none)
        # The factors are those of the state before its correction.
        opened = product(jnp.concatenate([along, none]))[len(change) :]
        return along - split.apply(jnp.zeros_like(change), opened)[0]

    def _approximated(self, system, t, q, v, correct=True):
        """One factorisation, at q; then a fixed number of corrections with it, of no change unless `correct`."""
        instant = coefficients(system, t, on_manifold(system.topology, q))
        split = self._split(instant)
        first = instant
        for _ in range(self.corrections):
            step = self._least_change(first, split, -residual(instant.configuration), sweeps=0)
            step = jnp.where(correct, step, 0.0)
            instant = coefficients(system, t, retract(system.topology, instant.configuration.q, step))
        v = jnp.where(correct, self._on_velocity_level(instant, v, split, sweeps=2), v)
        return v, instant, split

    def _moved(self, instant, v, split, changes) -> Moved:
        """How the state on the loops here changes with a system's numbers, time, and a state near it."""
        onto = None if split is None else lambda rows: self._least_change(instant, split, rows, sweeps=2)
        system, t, q = (getattr(instant.configuration, name) for name in ("system", "t", "q"))
        return moved(onto, system, t, q, v, Changes(*changes))

    def _limit(self, function, powers, system, t, q, v):
        """A function of (method, system, v), t and q at q, or as a limit along v."""
        step = lambda q, change: retract(system.topology, q, change)
        return limit(function, powers, (self, system, v), Course(t, q, v, system.units, step, is_driven(system)))

    @traced_once
    def correct(self, system: System, t, q, v, errors=()):
        """q and v moved onto the manifold, for states close to it, and the distance d there.

        `errors`, of q and of v, (n_v,) each, are estimates of errors of the state. Of them only the
        part in the tangent space remains in the state, and only that is returned; what the
        correction leaves of the loops open counts as an error of all coordinates.
        """
        if system.topology.num_rows == 0:
            return on_manifold(system.topology, q), v, errors, jnp.ones((), q.dtype)
        q, v, split = _corrected((self, system, t, q, v))
        if errors:
            instant = lax.stop_gradient(coefficients(system, t, q))
            in_q, in_v = jax.vmap(lambda error: self._in_tangent_space(instant, split, error))(jnp.stack(errors))
            open_ = _largest(residual(instant.configuration)) * system.units
            errors = jnp.where(jnp.abs(in_q) < open_, open_, in_q), in_v
        return q, v, errors, split.distance

    @traced_once
    def derivative(self, system: System, t, q, v, correct):
        """v and v̇ at (t, q, v), corrected before the equations of motion are formed, q and d there."""
        found = _evaluated((self, system, t, q, v), correct if system.topology.num_rows > 0 else False)
        return found.v, found.acceleration, found.q, found.split.distance

    def crossing(self, system: System, t, q) -> Crossing:
        """The configuration as a crossing of branches."""
        instant = coefficients(system, t, q)
        return Crossing(instant.configuration, instant.jacobian, self._split_at_once(instant))

    def right_inverse(self, system: System, t, q):
        """J, (m, n_v), a right inverse G of its independent rows, (n_v, m), and d at coordinates q."""
        instant = coefficients(system, t, q)
        split, (rows, n) = self._split(instant), instant.jacobian.shape
        column = lambda gamma: split.apply(jnp.zeros(n, gamma.dtype), gamma)[0]
        return instant.jacobian, jax.vmap(column, out_axes=1)(jnp.eye(rows, dtype=q.dtype)), split.distance

    def distance(self, system: System, t, q) -> Float[Array, ""]:
        """The distance d from the nearest singular configuration, with derivatives."""
        instant = coefficients(system, t, q)
        weight = instant.mass if self.metric == "mass" else None
        islands, ranks = system.topology.islands, self._ranks_of_islands(system.topology)
        return singularity_distance(weight, instant.jacobian, system.units, self.rank_tolerance, islands, ranks)

    def departure(self, system: System, t, q) -> "Departure":
        """What decides where a motion from rest goes."""
        instant = coefficients(system, t, q)
        split, rest = self._split_at_once(instant), jnp.zeros(system.topology.num_speeds, system.dtype)
        inverse = self._for_dynamics(split, instant)
        motion = move(instant.configuration, rest)
        acceleration, _ = inverse.apply(generalised_force(motion), gamma(motion))
        crossing = Crossing(instant.configuration, instant.jacobian, split)
        return Departure(crossing, instant.mass, acceleration, inverse.definiteness)

    def ranks_along(self, system: System, t, q, v, rank) -> Int[Array, " k"]:
        """`rank_nearby` along motion from here with speeds v, of any size, where `rank` is that of each island.

        That of cells shows at states a little farther on. Where it does not add up there, a cell has as many
        independent rows as the tolerance says.
        """
        topology = system.topology
        if topology.chain is None:
            return rank
        fastest = jnp.max(jnp.abs(v / system.units))
        duration = jnp.where(fastest > 0.0, 1.0 / jnp.where(fastest > 0.0, fastest, 1.0), 0.0)

        def found(place):
            later = t + place * duration if is_driven(system) else t
            closed, _, _ = self._approach(system, later, retract(topology, q, place * duration * v), v)
            return self._split(coefficients(system, later, closed)).rank

        ranks = jnp.max(lax.map(found, jnp.asarray(ALONG, q.dtype)), axis=0)
        adds_up = jnp.all(_of_islands(topology, ranks) == rank)
        return jnp.where(adds_up, ranks, topology.chain.most_independent)

    @traced_once
    def dynamics(self, system: System, t, q, v) -> Dynamics:
        """Accelerations and multipliers at a state on the manifold."""
        instant = coefficients(system, t, q)
        split = self._split(instant)
        motion = move(instant.configuration, v)
        force, right = generalised_force(motion), gamma(motion)
        if system.topology.num_rows == 0:
            acceleration, multipliers = self._solve(split, instant, force, right, sweeps=1)
        else:
            (_, acceleration), _ = self._limit(_acceleration_at, (0, 2), system, t, q, v)
            _, multipliers = self._solve(split, instant, force, instant.jacobian @ acceleration, sweeps=1)
        violation = instant.jacobian @ acceleration - right
        return Dynamics(acceleration, multipliers, violation)

    @traced_once
    def least_multipliers(self, system: System, t, q, v) -> Float[Array, " m"]:
        """Multipliers of minimum norm at a state on the manifold, close to a singular configuration as a limit.

        There J has fewer independent rows than the motion needs. Not numbers where motion goes through it and they
        have no limit: forces that press against it make them grow without bound, and change sign in it.
        """
        (_, per_inertia), _ = self._limit(_multipliers_at, (0, 2), system, t, q, v)
        return per_inertia * _inertia(system)

    @traced_once
    def close(self, system: System, t, q, v):
        """q and v on the manifold to rounding, from any state near it, with fresh factors."""
        if system.topology.num_rows == 0:
            return on_manifold(system.topology, q), v
        return _close((self, system, t, q, v))

    def _approach(self, system, t, q, v):
        """Newton steps on q until the loops close to rounding or stop closing further, then v."""
        small = ROUNDING_ULPS * jnp.finfo(q.dtype).eps

        def unfinished(carry):
            count, _, _, _, gap, before = carry
            return (count < MOST_CORRECTIONS) & (gap > small) & (gap < before)

        def improve(carry):
            count, q, _, _, before, _ = carry
            instant = coefficients(system, t, q)
            split, rows = self._split(instant), residual(instant.configuration)
            gap = _largest(rows)
            done = (gap <= small) | (gap >= before)
            closer = retract(system.topology, q, self._least_change(instant, split, -rows, sweeps=0))
            on_level = self._on_velocity_level(instant, v, split, sweeps=1)
            return count + 1, jnp.where(done, q, closer), on_level, split.distance, gap, before

        far, one = jnp.asarray(jnp.finfo(q.dtype).max, q.dtype), jnp.ones((), q.dtype)
        begin = (jnp.zeros((), int), on_manifold(system.topology, q), v, one, far, 2.0 * far)
        _, q, v, distance, _, _ = lax.while_loop(unfinished, improve, begin)
        return q, v, distance


def _gap(system, t, q):
    return _largest(residual(configure(system, t, q)))


class _Evaluated(NamedTuple):
    """A state on the loops, its acceleration and multipliers, and the split that they follow from."""

    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]
    multipliers: Float[Array, " m"]
    split: Inverse | ChainedInverse


def _constant(tree):
    """The change of what does not change."""
    return jax.tree.map(lambda _: None, tree)


@eqx.filter_custom_jvp
def _evaluated(arguments, correct) -> _Evaluated:
    """The acceleration at a state, or at the one on the loops next to it."""
    method, system, t, q, v = arguments
    if correct is False:
        instant = coefficients(system, t, q)
        split = method._split(instant)
    else:
        v, instant, split = method._approximated(system, t, q, v, correct)
    motion = move(instant.configuration, v)
    sides = generalised_force(motion), gamma(motion)
    acceleration, multipliers = method._solve(split, instant, *sides, sweeps=1 if correct is False else 2)
    return _Evaluated(instant.configuration.q, v, acceleration, multipliers, split)


@_evaluated.def_jvp
def _evaluated_jvp(primals, changes):
    (arguments, correct), (changes, _) = primals, changes
    method, system, t, _, _ = arguments
    found = _evaluated(arguments, correct)
    instant = coefficients(system, t, found.q)
    state = method._moved(instant, found.v, None if correct is False else found.split, changes[1:])
    sides = unbalanced(state, found.acceleration, found.multipliers)
    acceleration, multipliers = method._solve(found.split, instant, *sides, sweeps=2)
    return found, _Evaluated(state.to_q, state.to_v, acceleration, multipliers, _constant(found.split))


@eqx.filter_custom_jvp
def _corrected(arguments):
    """The state on the loops next to one that is close, and the split that corrected it."""
    method, system, t, q, v = arguments
    v, instant, split = method._approximated(system, t, q, v)
    return instant.configuration.q, v, split


@_corrected.def_jvp
def _corrected_jvp(primals, changes):
    (arguments,), (changes,) = primals, changes
    method, system, t, _, _ = arguments
    q, v, split = _corrected(arguments)
    state = method._moved(coefficients(system, t, q), v, split, changes[1:])
    return (q, v, split), (state.to_q, state.to_v, _constant(split))


@traced_once
def _acceleration_at(arguments, t, q) -> Value:
    method, system, v = arguments
    found = _evaluated((method, system, t, q, v), True)
    return Value((found.q, found.acceleration), found.split.distance, _gap(system, t, q))


def _inertia(system):
    """Of the magnitude of the mechanism's [kg m²]: multipliers over it are of that of accelerations."""
    found = jnp.sum(system.mass) * system.length**2 + jnp.max(jnp.abs(system.inertia), initial=0.0)
    return lax.stop_gradient(jnp.where(found > 0.0, found, 1.0))


@traced_once
def _multipliers_at(arguments, t, q) -> Value:
    method, system, v = arguments
    found = _evaluated((method, system, t, q, v), True)
    rows, rank = coefficients(system, t, found.q).jacobian, jnp.sum(found.split.rank)
    least = least_multipliers(rows, found.multipliers, system.units, method.rank_tolerance, rank)
    undefined = (found.split.distance < method.rank_tolerance) & jnp.any(v != 0.0)
    per_inertia = jnp.where(undefined, jnp.nan, least.multipliers / _inertia(system))
    return Value((found.q, per_inertia), found.split.distance, _gap(system, t, q))


@traced_once
def _closed_state(arguments, t, q) -> Value:
    method, system, v = arguments
    gap = _gap(system, t, q)
    q, v, distance = method._approach(system, t, q, v)
    return Value((q, v), distance, gap)


@eqx.filter_custom_jvp
def _close(arguments):
    method, system, t, q, v = arguments
    (q, v), _ = method._limit(_closed_state, (0, 1), system, t, q, v)
    return on_manifold(system.topology, q), v


@_close.def_jvp
def _close_jvp(primals, changes):
    (arguments,), (changes,) = primals, changes
    method, system, t, _, _ = arguments
    q, v = _close(arguments)
    instant = coefficients(system, t, q)
    state = method._moved(instant, v, method._split(instant), changes[1:])
    return (q, v), (state.to_q, state.to_v)
