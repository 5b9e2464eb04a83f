"""Multipliers of minimum norm, where redundant rows leave a choice."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.saddle_inverse import invert
from linkax.xla.arrays import Array, ScalarLike


class LeastMultipliers(NamedTuple):
    """Multipliers of minimum norm, and the null space of Jᵀ.

    - `multipliers`: λ, (m,). `free`: orthonormal columns μ with Jᵀμ = 0, which may be added to λ, (m, m), else zero
      columns.
    """

    multipliers: Float[Array, " m"]
    free: Float[Array, "m m"]


def least_multipliers(
    jacobian: Float[Array, "m n"],
    multipliers: Float[Array, " m"],
    scales: Float[Array, " n"],
    tolerance: ScalarLike,
    rank: Int[Array | np.integer, ""] | int,
) -> LeastMultipliers:
    """The multipliers of minimum norm with the same Jᵀλ, differentiable like `constrained_solve`.

    They solve λ = J y, Jᵀλ = given, a constrained solve too. `scales`, `tolerance`: see `invert`;
    `rank`: of J.
    """
    transposed, size = (jacobian * scales).T, multipliers.shape[0]
    one = jnp.ones(size, multipliers.dtype)
    inverse = invert(None, transposed, one, tolerance, rank)
    given = transposed @ multipliers
    found, _ = constrained_solve(inverse, jnp.eye(size, dtype=given.dtype), transposed, 0.0 * one, given)
    return LeastMultipliers(found, inverse.basis)
