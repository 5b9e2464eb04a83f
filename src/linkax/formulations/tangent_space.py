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
        return constrained_solve(split, weight, instant.jacobian, still, -residual(instant.cuts))[0]

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

    def correct(self, system: System, q, v):
        """q and v moved onto the manifold, for states close to it, and the distance d there."""
        if system.topology.num_rows == 0:
            return q, v, jnp.ones((), q.dtype)
        q, v, _, split = self._corrected(system, q, v)
        return q, v, split.distance

    def derivative(self, system: System, t, q, v, correct: bool):
        """q̇ and v̇ at (q, v), corrected before the equations of motion are formed."""
        if correct and system.topology.num_rows > 0:
            q, v, instant, split = self._corrected(system, q, v)
            return v, self._dynamics(system, t, instant, v, split, sweeps=2).acceleration
        instant = _at(system, q)
        split = self._split(system, instant)
        return v, self._dynamics(system, t, instant, v, split, sweeps=1).acceleration

    def dynamics(self, system: System, t, q, v) -> Dynamics:
        """Accelerations and multipliers at a state on the manifold."""
        instant = _at(system, q)
        return self._dynamics(system, t, instant, v, self._split(system, instant), sweeps=1)

    def close(self, system: System, q, v):
        """q and v on the manifold to rounding, from any state near it, with fresh factors."""
        if system.topology.num_rows == 0:
            return q, v
        closed = lax.stop_gradient(self._closed(*lax.stop_gradient((system, q))))
        # One more step carries the derivative: nearest to q on the loops linearised where they close.
        instant = _at(system, closed)
        split = self._split(system, instant)
        weight = self._weight(system, instant)
        gap = -residual(instant.cuts)
        q = closed + constrained_solve(split, weight, instant.jacobian, weight @ (q - closed), gap)[0]
        instant = _at(system, q)
        return q, self._on_velocity_level(system, instant, v, self._split(system, instant), sweeps=1)

    def _closed(self, system, q):
        """Newton steps until the loops close to rounding or stop closing further."""
        small = ROUNDING_ULPS * jnp.finfo(q.dtype).eps

        def unfinished(carry):
            count, _, gap, best = carry
            return (count < MOST_CORRECTIONS) & (gap > small) & (gap < best)

        def improve(carry):
            count, q, gap, _ = carry
            instant = _at(system, q)
            q = q + self._step(system, instant, self._split(system, instant))
            return count + 1, q, self._gap(system, q), gap

        start = (jnp.zeros((), int), q, self._gap(system, q), jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, improve, start)[1]

    def _gap(self, system, q):
        return jnp.max(jnp.abs(residual(cut_frames(configure(system, q)))))
