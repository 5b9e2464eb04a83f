"""Lagrange's equations of the first kind, index 1, for independent loop rows."""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, lu_factor, lu_solve
from jaxtyping import Float

from linkax.formulations.classical import AbstractAcceleration
from linkax.xla.arrays import Array

ROUNDING = 10.0  # times n ε: what is left of a pivot, of the largest one, where rows depend on one another


class LagrangeMultipliers(AbstractAcceleration):
    """Solve the constrained equations for v̇ and λ by LU; fails where rows depend on one another.

    García de Jalón and Bayo, Kinematic and Dynamic Simulation of Multibody Systems, 1994, ch. 5.

    - `block`: solve [[M, −Jᵀ], [J, 0]] at once; else (default) first (J M⁻¹ Jᵀ) λ = γ − J M⁻¹ f
      for the multipliers, which needs a positive definite M.
    """

    block: bool = eqx.field(static=True, default=False)

    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        m, n = jacobian.shape
        if self.block:
            matrix = jnp.block([[mass, -jacobian.T], [jacobian, jnp.zeros((m, m), mass.dtype)]])
            solved = _solved(matrix, jnp.concatenate([force, gamma]))
            return solved[:n], solved[n:]
        factor = cho_factor(mass)
        free, moved = cho_solve(factor, force), cho_solve(factor, jacobian.T)
        multipliers = _solved(jacobian @ moved, gamma - jacobian @ free)
        return free + moved @ multipliers, multipliers


def _solved(matrix, right):
    """The solution by LU; not a number where the matrix is singular but for how its pivots are rounded."""
    factor, pivots = lu_factor(matrix)
    sizes = jnp.abs(jnp.diagonal(factor))
    rounding = ROUNDING * len(matrix) * jnp.finfo(matrix.dtype).eps
    is_regular = jnp.min(sizes, initial=jnp.inf) > rounding * jnp.max(sizes, initial=0.0)
    return jnp.where(is_regular, lu_solve((factor, pivots), right), jnp.nan)
