"""Reduced row echelon form by Gauss and Jordan's elimination with complete pivoting."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from linkax.model.numbers import Number
from linkax.xla.arrays import Array


class RowEchelon(NamedTuple):
    """E A, in which each pivot is one and alone in its column.

    - `reduced`: E A, (m, n). `transform`: E, (m, m).
    - `pivot_rows`, `pivot_columns`: in the order they were chosen, (min(m, n),); those from `rank` on are no pivots.
    - `rank`: number of pivots.
    """

    reduced: Float[Array, "m n"]
    transform: Float[Array, "m m"]
    pivot_rows: Int[Array, " k"]
    pivot_columns: Int[Array, " k"]
    rank: Int[Array, ""]


def row_echelon(matrix: Float[Array, "m n"], tolerance: Number) -> RowEchelon:
    """Reduce a matrix of any shape and rank; a pivot is larger than `tolerance` times the first one.

    Golub and Van Loan, Matrix Computations (4th ed.), section 3.4.8 for complete pivoting.
    """
    m, n = matrix.shape
    count = min(m, n)
    rows, columns = jnp.arange(m), jnp.arange(n)

    def eliminate(step, carry):
        work, free_rows, free_columns, pivot_rows, pivot_columns, first, rank = carry
        free = free_rows[:, None] & free_columns[None, :]
        sizes = jnp.where(free, jnp.abs(work[:, :n]), -1.0)
        row, column = jnp.divmod(jnp.argmax(sizes), n)
        size = sizes[row, column]
        first = jnp.where(step == 0, size, first)
        is_pivot = size > tolerance * first
        chosen = work[row] / jnp.where(is_pivot, work[row, column], 1.0)
        others = work - jnp.where(rows == row, 0.0, work[:, column])[:, None] * chosen[None, :]
        reduced = jnp.where((rows == row)[:, None], chosen[None, :], others)
        return (
            jnp.where(is_pivot, reduced, work),
            free_rows & (rows != row),
            free_columns & (columns != column),
            pivot_rows.at[step].set(row),
            pivot_columns.at[step].set(column),
            first,
            rank + is_pivot,
        )

    nothing = jnp.zeros(count, int)
    carry = (
        jnp.concatenate([matrix, jnp.eye(m, dtype=matrix.dtype)], axis=1),
        jnp.ones(m, bool),
        jnp.ones(n, bool),
        nothing,
        nothing,
        jnp.zeros((), matrix.dtype),
        jnp.zeros((), int),
    )
    work, _, _, pivot_rows, pivot_columns, _, rank = lax.fori_loop(0, count, eliminate, carry)
    return RowEchelon(work[:, :n], work[:, n:], pivot_rows, pivot_columns, rank)
