"""Branches of motion that cross in a singular configuration: which one a state is on.

Where the rank of J falls, more speeds satisfy J v = b than motions exist. A motion has an
acceleration, so γ must lie in the range of J: uᵀγ(v, v) = 0 for every u with uᵀJ = 0, quadratic
equations for the speeds, whose solutions are the branches.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import Configuration, configure
from linkax.equations.loops import drive_acceleration, jacobian, velocity_gamma
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.linalg.saddle_inverse import SaddleInverse, invert_apart
from linkax.spatial.vectors import largest, length
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import positive_or_one, ratio

OPENING = 1e-6  # growth of a row of R per unit of motion that counts as none
SEEN_ULPS = 100.0  # of what drives ask for, over the distance d: what is less is rounding


class ConstraintSplit(eqx.Module):
    """J at a configuration and its split into normal and tangent space; where branches cross, what tells them apart.

    - `jacobian`: J, (m, n_v), and `inverse`, its split, in any metric.
    """

    configuration: Configuration
    jacobian: Float[Array, "m n_v"]
    inverse: SaddleInverse

    @staticmethod
    def at(system: System, t: ScalarLike, q: Float[Array, " n_q"], rank_tolerance: ScalarLike) -> "ConstraintSplit":
        """Split at coordinates q, in the identity metric."""
        return ConstraintSplit.of(configure(system, t, q), rank_tolerance)

    @staticmethod
    def of(configuration: Configuration, rank_tolerance: ScalarLike) -> "ConstraintSplit":
        """Split in the identity metric."""
        system, rows = configuration.system, jacobian(configuration)
        inverse = invert_apart(None, rows, system.scales, rank_tolerance, system.structure.islands)
        return ConstraintSplit(configuration, rows, inverse)

    def _outside(self, rows):
        """The part of rows outside the range of J: r − J G r."""
        return rows - self.jacobian @ (self.inverse.normal @ rows)

    def _bias(self, v):
        return velocity_gamma(move(self.configuration, v))

    def _basis_of_ones(self):
        """The basis of the null space of J, each direction of length one in scales."""
        basis = self.inverse.basis
        return ratio(basis, length(basis / self.configuration.system.scales[:, None], axis=0))

    def off_branch(self, v: Float[Array, " n_v"], scale: ScalarLike = 1.0) -> Float[Array, " m"]:
        """The part of γ(v, v) outside the range of J, (m,): zero for speeds on a branch.

        **Arguments:** `scale`: a factor of the speeds v, whose square is one of γ.
        """
        gamma, scales = self._bias(v) + self.driven(v, scale), self.configuration.system.scales
        # With derivatives, which the split has none of; J a is the same in any metric.
        metric, still = jnp.diag(scales**-2), jnp.zeros_like(v)
        return (
            gamma
            - self.jacobian @ constrained_solve(self.inverse, metric, self.jacobian, still, gamma, refinements=0)[0]
        )

    def driven(self, v: Float[Array, " n_v"], scale: ScalarLike = 1.0) -> Float[Array, " m"]:
        """The part of γ that drives cause, likewise, (m,)."""
        # Not over the square, which a small scale does not have.
        return drive_acceleration(move(self.configuration, scale * v)) / scale / scale

    def seen(self, off: Float[Array, " m"], driven: Float[Array, " m"]) -> Float[Array, " m"]:
        """What is off a branch, (m,), but for rounding of what drives ask for, which slow speeds are small next to."""
        return jnp.where(jnp.abs(off) > self._rounding(driven), off, 0.0)

    def slowest(self) -> Float[Array, ""]:
        """The largest speed up to which rounding of what drives ask for hides whether speeds are on a branch."""
        rounding = self._rounding(self.driven(jnp.zeros_like(self.configuration.system.scales)))
        return jnp.sqrt(lax.stop_gradient(rounding))  # whose slope at zero is none

    def _rounding(self, driven):
        return SEEN_ULPS * jnp.finfo(driven.dtype).eps * largest(driven) / self.inverse.distance

    def is_crossing(self, tolerance: ScalarLike) -> Bool[Array, ""]:
        """Whether branches cross here: speeds that J leaves open are not all those of motions."""
        basis = self._basis_of_ones()
        speeds = basis @ np.random.default_rng(0).normal(size=basis.shape[1]).astype(basis.dtype)
        outside = self._outside(self._bias(speeds))
        return largest(outside) > tolerance * self.configuration.system.fastest(speeds) ** 2

    def along(
        self, v: Float[Array, " n_v"], from_rest: bool | Bool[Array, ""]
    ) -> tuple[Float[Array, " m"], Int[Array, " k"]]:
        """Tell how far speeds v are from a branch, and the rank of J of each island a little farther along them.

        **Arguments:** `from_rest`: whether v are accelerations; what drives ask for is relative to them then, not their
        square.

        **Returns:** `off_branch` for the largest speed one, (m,); by first-order perturbation
        rank(J) + rank(Uᵀ J̇ N), U and N the null spaces of Jᵀ and J, (k,).
        """
        scale = positive_or_one(self.configuration.system.fastest(v))
        direction = v / scale
        # γ = −J̇ v is quadratic in v, so −J̇ w is a quarter of γ(v + w) − γ(v − w). All at once, to compile γ once.
        basis = self._basis_of_ones()
        speeds = jnp.concatenate([direction[:, None], direction[:, None] + basis, direction[:, None] - basis], axis=1)
        outside = self._outside(jax.vmap(self._bias, in_axes=1, out_axes=1)(speeds))
        plus, minus = jnp.split(outside[:, 1:], 2, axis=1)
        turning = 0.25 * (plus - minus)

        def opening(rows, columns):
            if not rows:
                return jnp.zeros((), int)
            block = turning[np.ix_(rows, columns)]
            return jnp.sum(jnp.abs(jnp.diagonal(pivoted_qr(block).r)) > OPENING)

        opened = jnp.stack([opening(*island) for island in self.configuration.system.structure.islands])
        driven = self.driven(jnp.where(from_rest, 0.0, direction), jnp.where(from_rest, jnp.sqrt(scale), scale))
        return self.seen(outside[:, 0] + self._outside(driven), driven), self.inverse.rank + opened


class AtRest(NamedTuple):
    """Acceleration from rest at a configuration, and what selects its branch.

    - `split`: see `ConstraintSplit`. `mass`: M. `acceleration`: v̇ at v = 0.
    - `definiteness`: of M on the tangent space, see `linkax.linalg.saddle_inverse.SaddleInverse`.
    """

    split: ConstraintSplit
    mass: Float[Array, "n_v n_v"]
    acceleration: Float[Array, " n_v"]
    definiteness: Float[Array, ""]
