"""Inverses of triangular factors: of one matrix by LAPACK, in batches of small ones by compiled loops.

A batch of small matrices would spend its time in calling LAPACK. Larger ones go to it one by one.
"""

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import solve_triangular
from jaxtyping import Float

from linkax.xla.arrays import Array
from linkax.xla.batches import small_in_batches


def cholesky_inverse(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """L⁻¹ of a positive definite matrix L Lᵀ, and the diagonal of L; not numbers where it is not definite."""
    return _cholesky_inverse(matrix)


def upper_inverse(triangle: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """R⁻¹ of an upper triangular matrix R."""
    return _upper_inverse(triangle)


def _by_lapack(matrix):
    lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    identity = jnp.eye(len(matrix), dtype=matrix.dtype)
    return solve_triangular(lower, identity, lower=True), jnp.diagonal(lower)


def cholesky_inverse_by_elimination(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
    """`cholesky_inverse`, with derivatives: rows of [A, I] less multiples of those above, [Lᵀ, L⁻¹]."""
    n = len(matrix)
    rows = jnp.arange(n)

    def eliminate(k, work):
        column = work[:, k]
        size = jnp.sqrt(column[k])
        row = work[k] / size
        factor = jnp.where(rows > k, column / size, 0.0)
        return jnp.where((rows == k)[:, None], row, work - factor[:, None] * row)

    work = lax.fori_loop(0, n, eliminate, jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1))
    return work[:, n:], jnp.diagonal(work[:, :n])


def _upper_by_lapack(triangle):
    return solve_triangular(triangle, jnp.eye(len(triangle), dtype=triangle.dtype))


def _upper_by_elimination(triangle):
    """Rows of [R, I] less multiples of those below: [I, R⁻¹]."""
    n = len(triangle)
    rows = jnp.arange(n)

    def eliminate(done, work):
        k = n - 1 - done
        column = work[:, k]
        row = work[k] / column[k]
        factor = jnp.where(rows < k, column, 0.0)
        return jnp.where((rows == k)[:, None], row, work - factor[:, None] * row)

    work = lax.fori_loop(0, n, eliminate, jnp.concatenate([triangle, jnp.eye(n, dtype=triangle.dtype)], axis=1))
    return work[:, n:]


_cholesky_inverse = small_in_batches(_by_lapack, cholesky_inverse_by_elimination)
_upper_inverse = small_in_batches(_upper_by_lapack, _upper_by_elimination)
