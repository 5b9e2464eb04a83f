"""The paper's method: tangent and normal space by column-pivoted QR.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
Positions and velocities are corrected along the normal space before the equations of motion are
formed; accelerations and multipliers follow from the same split.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from linkax.equations.dynamics import generalised_force, mass_matrix
from linkax.equations.kinematics import configure, move
from linkax.equations.loops import bias, cut_frames, jacobian, residual
from linkax.equations.system import System
from linkax.formulations.branches import Crossing
from linkax.formulations.passage import Value, limit
from linkax.linalg.constrained_solve import Inverse, constrained_solve, invert, with_mass

ROUNDING_ULPS = 8.0
MOST_CORRECTIONS = 20


class Dynamics(NamedTuple):
    """What holds at a state on the manifold.

    - `acceleration`: v̇, (n_v,). `multipliers`: λ, (m,).
    - `rank`: independent loop rows. `distance`: see `linkax.linalg.constrained_solve.Inverse`.
    - `violation`: J v̇ − γ, (m,).
    """

    acceleration: Float[Array, " n_v"]
    multipliers: Float[Array, " m"]
    rank: Int[Array, ""]
    distance: Float[Array, ""]
    violation: Float[Array, " m"]


class _Instant(NamedTuple):
    """Loop rows and mass matrix at coordinates q."""

    configuration: object
    cuts: object
    jacobian: Float[Array, "m n_v"]
    mass: Float[Array, "n_v n_v"]


def _at(system, q) -> _Instant:
    configuration = configure(system, q)
    cuts = cut_frames(configuration)
    return _Instant(configuration, cuts, jacobian(cuts), mass_matrix(configuration))


def _largest(rows):
    return jnp.max(jnp.abs(rows), initial=0.0)


class TangentSpace(eqx.Module):
    """Corrections, accelerations and multipliers by the split of the space of speeds.

    - `rank_tolerance`: τ; a loop row is independent where |R_kk| > τ max(|R₁₁|, 1).
    - `rank_nearby`: rank along the motion, where it is known; in a singular configuration the
      rank itself is smaller.
    - `metric`: in which corrections are smallest and normal and tangent space orthogonal:
      "mass" (W = M + JᵀDJ) or "identity" (radians, and lengths of the mechanism).
    - `corrections`: position corrections in each evaluation and after each step.
    """

    rank_tolerance: Float[Array, ""]
    rank_nearby: Int[Array, ""] | None = None
    metric: Literal["mass", "identity"] = eqx.field(static=True, default="mass")
    corrections: int = eqx.field(static=True, default=1)

    def _weight(self, system: System, instant: _Instant):
        """W of the corrections."""
        return instant.mass if self.metric == "mass" else jnp.diag(system.coordinate_units**-2)

    def _split(self, system: System, instant: _Instant) -> Inverse:
        weight = instant.mass if self.metric == "mass" else None
        return invert(weight, instant.jacobian, system.coordinate_units, self.rank_tolerance, self.rank_nearby)

    def _solve(self, split, instant, f, gamma, sweeps):
        """v̇ and λ of M v̇ = f + Jᵀλ, J v̇ = γ."""
        inverse = split if self.metric == "mass" else with_mass(split, instant.mass)
        return constrained_solve(inverse, instant.mass, instant.jacobian, f, gamma, sweeps)

    def _acceleration(self, system, t, instant, v, split, sweeps):
        motion = move(instant.configuration, v)
        return self._solve(split, instant, generalised_force(t, motion), bias(instant.cuts, motion), sweeps)[0]

    def _on_velocity_level(self, system, instant, v, split, sweeps):
        """The speeds nearest to v that satisfy J v = 0."""
        weight = self._weight(system, instant)
        rest = jnp.zeros(instant.jacobian.shape[0], v.dtype)
        return constrained_solve(split, weight, instant.jacobian, weight @ v, rest, sweeps)[0]

    def _step(self, system, instant, split):
        """The smallest correction of q that closes the linearised loops."""
        weight = self._weight(system, instant)
        still = jnp.zeros(weight.shape[0], weight.dtype)
        return constrained_solve(split, weight, instant.jacobian, still, -residual(instant.cuts), sweeps=0)[0]

    def _corrected(self, system, q, v):
        """One factorisation, at q; then a fixed number of corrections with it."""
        instant = _at(system, q)
        split = self._split(system, instant)
        first = instant
        for _ in range(self.corrections):
            q = q + self._step(system, first._replace(cuts=instant.cuts), split)
            instant = _at(system, q)
        v = self._on_velocity_level(system, instant, v, split, sweeps=2)
        return q, v, instant, split

    def _limit(self, function, powers, details, system, q, v):
        """A function of (method, system, v, details) and q at q, or as a limit along v."""
        return limit(function, powers, (self, system, v, details), q, v, system.coordinate_units)

    @eqx.filter_jit  # traced once, however often a solver asks
    def correct(self, system: System, q, v, errors=()):
        """q and v moved onto the manifold, for states close to it, and the distance d there.

        `errors`, arrays (n_v,), are estimates of errors of the state. Of them only the part in the
        tangent space remains in the state, and only that is returned.
        """
        if system.topology.num_rows == 0:
            return q, v, errors, jnp.ones((), q.dtype)
        q, v, instant, split = self._corrected(system, q, v)
        if errors:
            remaining = split.tangent @ (self._weight(system, instant) @ jnp.stack(errors, axis=1))
            # The factors are those of the state before its correction.
            remaining = remaining - split.normal @ (instant.jacobian @ remaining)
            errors = tuple(remaining.T)
        return q, v, errors, split.distance

    @eqx.filter_jit  # traced once, however often a solver asks
    def derivative(self, system: System, t, q, v, correct: bool):
        """q̇ and v̇ at (q, v), corrected before the equations of motion are formed, and d there."""
        if correct and system.topology.num_rows > 0:
            q, v, instant, split = self._corrected(system, q, v)
            return v, self._acceleration(system, t, instant, v, split, sweeps=2), split.distance
        instant = _at(system, q)
        split = self._split(system, instant)
        return v, self._acceleration(system, t, instant, v, split, sweeps=1), split.distance

    def crossing(self, system: System, q) -> Crossing:
        """The configuration as a crossing of branches."""
        instant = _at(system, q)
        return Crossing(instant.configuration, instant.cuts, instant.jacobian, self._split(system, instant))

    def departure(self, system: System, t, q):
        """The configuration as a crossing of branches, and v̇ at rest there."""
        instant = _at(system, q)
        split, rest = self._split(system, instant), jnp.zeros(system.topology.num_coordinates, system.dtype)
        inverse = split if self.metric == "mass" else with_mass(split, instant.mass)
        acceleration = inverse.tangent @ generalised_force(t, move(instant.configuration, rest))
        return Crossing(instant.configuration, instant.cuts, instant.jacobian, split), acceleration

    @eqx.filter_jit
    def dynamics(self, system: System, t, q, v) -> Dynamics:
        """Accelerations and multipliers at a state on the manifold."""
        instant = _at(system, q)
        split = self._split(system, instant)
        motion = move(instant.configuration, v)
        force, gamma = generalised_force(t, motion), bias(instant.cuts, motion)
        if system.topology.num_rows == 0:
            acceleration, multipliers = self._solve(split, instant, force, gamma, sweeps=1)
        else:
            (_, acceleration), _ = self._limit(_acceleration_at, (0, 2), t, system, q, v)
            _, multipliers = self._solve(split, instant, force, instant.jacobian @ acceleration, sweeps=1)
        violation = instant.jacobian @ acceleration - gamma
        return Dynamics(acceleration, multipliers, split.rank, split.distance, violation)

    @eqx.filter_jit
    def close(self, system: System, q, v):
        """q and v on the manifold to rounding, from any state near it, with fresh factors."""
        if system.topology.num_rows == 0:
            return q, v
        return _close((self, system, q, v))

    def _approach(self, system, q, v):
        """Newton steps on q until the loops close to rounding or stop closing further, then v."""
        small = ROUNDING_ULPS * jnp.finfo(q.dtype).eps

        def unfinished(carry):
            count, _, _, _, gap, before = carry
            return (count < MOST_CORRECTIONS) & (gap > small) & (gap < before)

        def improve(carry):
            count, q, _, _, before, _ = carry
            instant = _at(system, q)
            split = self._split(system, instant)
            gap = _largest(residual(instant.cuts))
            done = (gap <= small) | (gap >= before)
            closer = jnp.where(done, q, q + self._step(system, instant, split))
            speeds = self._on_velocity_level(system, instant, v, split, sweeps=1)
            return count + 1, closer, speeds, split.distance, gap, before

        far, one = jnp.asarray(jnp.finfo(q.dtype).max, q.dtype), jnp.ones((), q.dtype)
        _, q, v, distance, _, _ = lax.while_loop(unfinished, improve, (jnp.zeros((), int), q, v, one, far, 2.0 * far))
        return q, v, distance

    def _last_step(self, system, closed, q, v):
        """What `close` does near a closed state, as a function to be differentiated."""
        instant = _at(system, closed)
        split, weight = self._split(system, instant), self._weight(system, instant)
        away = weight @ (q - closed)
        q = closed + constrained_solve(split, weight, instant.jacobian, away, -residual(instant.cuts))[0]
        instant = _at(system, q)
        return q, self._on_velocity_level(system, instant, v, split, sweeps=2)


def _acceleration_at(arguments, q) -> Value:
    method, system, v, t = arguments
    gap = _largest(residual(cut_frames(configure(system, q))))
    q, v, instant, split = method._corrected(system, q, v)
    return Value((q, method._acceleration(system, t, instant, v, split, sweeps=2)), split.distance, gap)


def _closed_state(arguments, q) -> Value:
    method, system, v, _ = arguments
    gap = _largest(residual(cut_frames(configure(system, q))))
    q, v, distance = method._approach(system, q, v)
    return Value((q, v), distance, gap)


@eqx.filter_custom_jvp
def _close(arguments):
    method, system, q, v = arguments
    return method._limit(_closed_state, (0, 1), None, system, q, v)[0]


@_close.def_jvp
def _close_jvp(primals, tangents):
    """The nearest state on the loops, linearised where they close."""
    (arguments,), (tangent,) = primals, tangents
    closed = _close(arguments)

    def last_step(arguments):
        method, system, q, v = arguments
        return method._last_step(system, closed[0], q, v)

    return closed, eqx.filter_jvp(last_step, (arguments,), (tangent,))[1]
