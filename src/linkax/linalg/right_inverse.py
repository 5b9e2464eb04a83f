"""Right inverses G of a matrix A of any rank: A G r = r for every r in the range of A.

A row counts as dependent, or a singular value as zero, below a fixed cut-off, and always below rounding.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from linkax.linalg.row_echelon import row_echelon
from linkax.model.numbers import Number
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

ROUNDING_ULPS = 10.0


def _cut_off(matrix, tolerance):
    return jnp.maximum(tolerance, ROUNDING_ULPS * max(matrix.shape) * jnp.finfo(matrix.dtype).eps)


def by_svd(matrix: Float[Array, "m n"], tolerance: Number) -> Float[Array, "n m"]:
    """The Moore-Penrose inverse by singular values, without those below `tolerance` times the largest."""
    left, sizes, right = jnp.linalg.svd(matrix, full_matrices=False)
    kept = sizes > _cut_off(matrix, tolerance) * sizes[0]
    inverse = ratio(1.0, jnp.where(kept, sizes, 0.0), 0.0)
    return (right.T * inverse) @ left.T


def by_gram_schmidt(matrix: Float[Array, "m n"], tolerance: Number) -> Float[Array, "n m"]:
    """The Moore-Penrose inverse of the rows that are independent of those before them.

    Rows are orthonormalised one by one, twice; one of which less than `tolerance` of its length
    remains is left out.
    """
    m, _ = matrix.shape

    def orthonormalise(place, carry):
        basis, transform = carry  # basis = transform @ matrix
        row, combination = matrix[place], jnp.zeros(m, matrix.dtype).at[place].set(1.0)
        for _ in range(2):
            along = basis @ row
            row, combination = row - along @ basis, combination - along @ transform
        remains = jnp.linalg.norm(row)
        kept = remains > _cut_off(matrix, tolerance) * jnp.linalg.norm(matrix[place])
        scale = ratio(1.0, jnp.where(kept, remains, 0.0), 0.0)
        return basis.at[place].set(scale * row), transform.at[place].set(scale * combination)

    empty = jnp.zeros_like(matrix), jnp.zeros((m, m), matrix.dtype)
    basis, transform = lax.fori_loop(0, m, orthonormalise, empty)
    return basis.T @ transform


def by_partition(matrix: Float[Array, "m n"], tolerance: Number) -> Float[Array, "n m"]:
    """The right inverse that moves as few unknowns as there are independent rows.

    Which ones complete pivoting chooses: those that the rows decide best.
    """
    found = row_echelon(matrix, _cut_off(matrix, tolerance))
    is_pivot = jnp.arange(len(found.pivot_rows)) < found.rank
    decided = jnp.where(is_pivot[:, None], found.transform[found.pivot_rows], 0.0)
    return jnp.zeros(matrix.T.shape, matrix.dtype).at[found.pivot_columns].set(decided, unique_indices=True)
