"""Inverses of triangular factors: of small matrices by compiled loops, of larger ones by LAPACK.

For small ones, most of all in batches, LAPACK would take longer to be called than to compute.
"""

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one

SMALL = 32  # rows


def cholesky_inverse(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """L⁻¹ of a positive definite matrix L Lᵀ, and the diagonal of L; not numbers where it is not definite."""
    return (cholesky_inverse_by_elimination if len(matrix) <= SMALL else _cholesky_by_lapack)(matrix)


def upper_inverse(triangle: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """R⁻¹ of an upper triangular matrix R."""
    if len(triangle) > SMALL:
        return _upper_by_lapack(triangle)
    return _eliminated(triangle.T, lambda pivot: (pivot, 1.0))[:, len(triangle) :].T


def cholesky_inverse_by_elimination(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """`cholesky_inverse`, with derivatives, of a matrix of any size."""
    work = _eliminated(matrix, lambda pivot: (jnp.sqrt(pivot), jnp.sqrt(pivot)))
    return work[:, len(matrix) :], jnp.diagonal(work)


def _eliminated(matrix, factors):
    """[A, I], with multiples of rows taken off those below; of a pivot two `factors`, for its row and its column."""
    n = len(matrix)
    rows = jnp.arange(n)

    def eliminate(k, work):
        column = work[:, k]
        of_row, of_column = factors(column[k])
        row, below = work[k] / of_row, jnp.where(rows > k, column / of_column, 0.0)
        return jnp.where((rows == k)[:, None], row, work - below[:, None] * row)

    return lax.fori_loop(0, n, eliminate, jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1))


@one_by_one
def _cholesky_by_lapack(matrix):
    lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    return solve_triangular(lower, jnp.eye(len(matrix), dtype=matrix.dtype), lower=True), jnp.diagonal(lower)


@one_by_one
def _upper_by_lapack(triangle):
    return solve_triangular(triangle, jnp.eye(len(triangle), dtype=triangle.dtype))
