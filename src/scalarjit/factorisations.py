"""Factorisations of matrices, for which JAX calls LAPACK, in operations that have rules."""

from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

UNROLLED = 12  # rows of a matrix up to which each is written by itself


def _each_row(count, body, initial):
    """body(row, found) for all rows in their order."""
    if count <= UNROLLED:
        for row in range(count):
            initial = body(row, initial)
        return initial
    return lax.fori_loop(0, count, body, initial)


def cholesky(matrix, **_params):
    """L of A = L Lᵀ, of the lower triangle of A; not a number where A is not positive definite."""
    count = len(matrix)
    places = jnp.arange(count)

    def column(number, lower):
        row = lower[number]
        below = matrix[:, number] - lower @ row
        pivot = jnp.sqrt(below[number])
        return lower.at[:, number].set(jnp.where(places >= number, below / pivot, 0.0))

    return (_each_row(count, column, jnp.zeros_like(matrix)),)


def triangular_solve(matrix, right, *, left_side, lower, transpose_a, conjugate_a, unit_diagonal):
    """X of op(A) X = B, or of X op(A) = B."""
    if not left_side:
        matrix = matrix.T
        right = right.T
        lower = not lower
    if transpose_a:
        matrix = matrix.T
        lower = not lower
    count = len(matrix)
    places = jnp.arange(count)

    def solve(step, solved):
        number = step if lower else count - 1 - step
        row = jnp.where((places < number) if lower else (places > number), matrix[number], 0.0)
        rest = right[number] - row @ solved
        return solved.at[number].set(rest if unit_diagonal else rest / matrix[number, number])

    solved = _each_row(count, solve, jnp.zeros_like(right))
    return (solved if left_side else solved.T,)


def _exchanged(array, one, other):
    return array.at[one].set(array[other]).at[other].set(array[one])


def lu(matrix, **_params):
    """L and U of P A = L U in one matrix, pivots, the largest of their columns, and the permutation of rows.

    Rows stay in their places until the end: to exchange them would be to choose among them for each entry of each step.
    """
    rows, columns = matrix.shape
    places = jnp.arange(rows)

    def step(number, found):
        rest, lower, is_above, pivots, order = found
        column = rest[:, number]
        pivot = jnp.argmax(jnp.where(places >= number, jnp.abs(column[order]), -1.0)).astype(pivots.dtype)
        row = order[pivot]
        at = column[row]
        is_above = is_above.at[row].set(True)
        factors = jnp.where(is_above, 0.0, jnp.where(at != 0.0, column / at, column))
        right = jnp.where(jnp.arange(columns) > number, rest[row], 0.0)
        return (
            rest - factors[:, None] * right,
            lower.at[:, number].set(factors),
            is_above,
            pivots.at[number].set(pivot),
            _exchanged(order, number, pivot),
        )

    count = min(rows, columns)
    order = jnp.arange(rows, dtype=jnp.int32)
    begin = matrix, jnp.zeros_like(matrix), jnp.zeros(rows, bool), jnp.zeros(count, jnp.int32), order
    upper, lower, _, pivots, order = _each_row(count, step, begin)
    is_below = places[:, None] > jnp.arange(columns)
    return jnp.where(is_below, lower[order], upper[order]), pivots, order


def lu_pivots_to_permutation(pivots, *, permutation_size):
    """The permutation that exchanges of rows make."""

    def exchange(number, order):
        return _exchanged(order, number, pivots[number])

    return (_each_row(len(pivots), exchange, jnp.arange(permutation_size, dtype=jnp.int32)),)


FACTORISATIONS = {
    "cholesky": (cholesky, 2),
    "triangular_solve": (triangular_solve, 2),
    "lu": (lu, 2),
    "lu_pivots_to_permutation": (lu_pivots_to_permutation, 1),
}  # functions, and of how many axes their arrays are


@lru_cache(maxsize=256)
def traced(name: str, shapes: tuple[Any, ...], params: tuple[tuple[str, Any], ...]) -> Any:
    """A factorisation as JAX traces it, of members of batches too."""
    function, rank = FACTORISATIONS[name]
    compute = lambda *arrays: function(*arrays, **dict(params))
    for _ in range(len(shapes[0][0]) - rank):
        compute = jax.vmap(compute)
    return jax.make_jaxpr(compute)(*(jax.ShapeDtypeStruct(*shape) for shape in shapes))
