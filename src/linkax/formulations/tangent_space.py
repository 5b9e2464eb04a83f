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


class TangentSpace(eqx.Module):
    """Corrections, accelerations and multipliers by the split of the space of speeds.

    - `rank_tolerance`: τ; a loop row is independent where |R_kk| > τ max(|R₁₁|, 1).
    - `metric`: in which corrections are smallest and normal and tangent space orthogonal:
      "mass" (W = M + JᵀDJ) or "identity" (radians, and lengths of the mechanism).
    - `corrections`: position corrections in each evaluation and after each step.
    """

    rank_tolerance: Float[Array, ""]
    metric: Literal["mass", "identity"] = eqx.field(static=True, default="mass")
    corrections: int = eqx.field(static=True, default=1)

    def _weight(self, system: System, instant: _Instant):
        """W of the corrections."""
        return instant.mass if self.metric == "mass" else jnp.diag(system.coordinate_units**-2)

    def _split(self, system: System, instant: _Instant) -> Inverse:
        weight = instant.mass if self.metric == "mass" else None
        return invert(weight, instant.jacobian, system.coordinate_units, self.rank_tolerance)

    def _dynamics(self, system, t, instant, v, split, sweeps) -> Dynamics:
        motion = move(instant.configuration, v)
        inverse = split if self.metric == "mass" else with_mass(split, instant.mass)
        gamma = bias(instant.cuts, motion)
        acceleration, multipliers = constrained_solve(
            inverse, instant.mass, instant.jacobian, generalised_force(t, motion), gamma, sweeps
        )
        violation = instant.jacobian @ acceleration - gamma
        return Dynamics(acceleration, multipliers, split.rank, split.distance, violation)

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

    @eqx.filter_jit  # traced once, however often a solver asks
    def correct(self, system: System, q, v):
        """q and v moved onto the manifold, for states close to it, and the distance d there."""
        if system.topology.num_rows == 0:
            return q, v, jnp.ones((), q.dtype)
        q, v, _, split = self._corrected(system, q, v)
        return q, v, split.distance

    @eqx.filter_jit  # traced once, however often a solver asks
    def derivative(self, system: System, t, q, v, correct: bool):
        """q̇ and v̇ at (q, v), corrected before the equations of motion are formed."""
        if correct and system.topology.num_rows > 0:
            q, v, instant, split = self._corrected(system, q, v)
            return v, self._dynamics(system, t, instant, v, split, sweeps=2).acceleration
        instant = _at(system, q)
        split = self._split(system, instant)
        return v, self._dynamics(system, t, instant, v, split, sweeps=1).acceleration

    @eqx.filter_jit
    def dynamics(self, system: System, t, q, v) -> Dynamics:
        """Accelerations and multipliers at a state on the manifold."""
        instant = _at(system, q)
        return self._dynamics(system, t, instant, v, self._split(system, instant), sweeps=1)

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
            count, _, _, gap, before = carry
            return (count < MOST_CORRECTIONS) & (gap > small) & (gap < before)

        def improve(carry):
            count, q, _, before, _ = carry
            instant = _at(system, q)
            split = self._split(system, instant)
            gap = jnp.max(jnp.abs(residual(instant.cuts)))
            done = (gap <= small) | (gap >= before)
            closer = jnp.where(done, q, q + self._step(system, instant, split))
            return count + 1, closer, self._on_velocity_level(system, instant, v, split, sweeps=1), gap, before

        far = jnp.asarray(jnp.finfo(q.dtype).max, q.dtype)
        start = (jnp.zeros((), int), q, v, far, 2.0 * far)
        _, q, v, _, _ = lax.while_loop(unfinished, improve, start)
        return q, v

    def _last_step(self, system, closed, q, v):
        """What `close` does near a closed state, as a function to be differentiated."""
        instant = _at(system, closed)
        split, weight = self._split(system, instant), self._weight(system, instant)
        away = weight @ (q - closed)
        q = closed + constrained_solve(split, weight, instant.jacobian, away, -residual(instant.cuts))[0]
        instant = _at(system, q)
        return q, self._on_velocity_level(system, instant, v, split, sweeps=2)


@eqx.filter_custom_jvp
def _close(arguments):
    method, system, q, v = arguments
    return method._approach(system, q, v)


@_close.def_jvp
def _close_jvp(primals, tangents):
    """The nearest state on the loops, linearised where they close."""
    (arguments,), (tangent,) = primals, tangents
    closed = _close(arguments)

    def last_step(arguments):
        method, system, q, v = arguments
        return method._last_step(system, closed[0], q, v)

    return closed, eqx.filter_jvp(last_step, (arguments,), (tangent,))[1]
