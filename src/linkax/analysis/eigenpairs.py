"""Eigenvalues and eigenvectors, with derivatives of each by itself, NaN where it equals another one."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Complex, Float

from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one
from linkax.xla.undefined import undefined_where

EQUAL_ULPS = 100.0  # distance between eigenvalues, in what rounding moves them by, up to which they are equal
ZERO_ULPS = 1.0  # of a singular value, next to the largest one and for each row, up to which it is zero
CHAIN = 4  # how many zeros that follow from each other are set apart: place, speed, and what slips bar by them
SWEEPS = 8  # of scaling rows and columns

_svd = one_by_one(lambda matrix: tuple(jnp.linalg.svd(matrix)))
_eig = one_by_one(lambda matrix: tuple(lax.linalg.eig(matrix, compute_left_eigenvectors=True)))
_eigh = one_by_one(lambda matrix: tuple(jnp.linalg.eigh(matrix)))


@jax.custom_jvp
def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Eigenvalues of a symmetric matrix in rising order, and eigenvectors as columns; derivatives are finite.

    JAX's hold 1 / 0 of equal eigenvalues, which makes NaN of all that a loss leaves out. Here eigenvectors of equal
    ones do not change.
    """
    return _eigh(matrix)


@eigh.defjvp
def _eigh_jvp(primals, tangents):
    (matrix,), (change,) = primals, tangents
    values, vectors = eigh(matrix)
    along = vectors.T @ change @ vectors
    apart = values[None, :] - values[:, None]
    equal = jnp.abs(apart) < jnp.finfo(values.dtype).tiny  # of what is smaller the quotient overflows
    turned = jnp.where(equal, 0.0, along / jnp.where(equal, 1.0, apart))
    return (values, vectors), (jnp.diagonal(along), vectors @ turned)


def symmetric_spectrum(matrix: Float[Array, "n n"]) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """`eigh`, where derivatives of equal eigenvalues and of their eigenvectors are NaN."""
    values, vectors = eigh(matrix)
    steps = jnp.diff(lax.stop_gradient(values), prepend=-jnp.inf, append=jnp.inf)
    near = steps <= EQUAL_ULPS * jnp.finfo(values.dtype).eps * largest(lax.stop_gradient(values))
    equal = near[1:] | near[:-1]
    return undefined_where((equal, equal), (values, vectors), matrix)


def spectrum(matrix: Float[Array, "n n"]) -> tuple[Complex[jax.Array, " n"], Complex[jax.Array, "n n"]]:
    """Eigenvalues and eigenvectors of a matrix, differentiable to any order; derivatives of equal ones are NaN."""
    if not len(matrix):
        none = lax.complex(matrix, matrix)
        return jnp.sum(none, axis=0), none
    values, vectors, left = _eigenpairs(matrix)
    equal = _equal_another(*map(lax.stop_gradient, (matrix, values, vectors, left)))
    return undefined_where((equal, equal), (values, vectors), matrix)


def _equal_another(matrix, values, vectors, left) -> Bool[Array, " n"]:
    """Whether each eigenvalue is as close to another as rounding of the largest moves it, by ε |λ| / |wᵀ v|."""
    along = jnp.abs(jnp.sum(left * vectors, axis=0))  # of unit vectors
    apart = jnp.abs(values[:, None] - values[None, :]) + jnp.diag(jnp.full(len(values), jnp.inf, matrix.dtype))
    rounding = EQUAL_ULPS * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(values))
    # No quotient: of a double zero both sides are zero.
    return jnp.min(apart, axis=1) * along <= rounding


@jax.custom_jvp
def _eigenpairs(matrix):
    """Eigenvalues λ, and right and left eigenvectors A v = λ v, wᵀ A = λ wᵀ, as columns.

    Of a chain of n zeros, such as those of places that nothing depends on, rounding makes a circle of radius ε^(1/n),
    and moves what is beside it: the capsize of a bicycle at −4e-3 1/s by 1e-8. So zeros are set apart, by
    A + σ N Nᵀ for the space N of A N = 0, which leaves other eigenvalues as they are (Brauer, Duke Mathematical
    Journal 19, 1952), and left eigenvectors.
    """
    scales = _scales(matrix)
    scaled = matrix * scales / scales[:, None]
    far = 2.0 * jnp.linalg.norm(scaled)
    moved = scaled
    spaces = []
    for _ in range(CHAIN):
        _, sizes, rows = _svd(moved)
        least = ZERO_ULPS * len(matrix) * jnp.finfo(matrix.dtype).eps * sizes[0]
        rows = jnp.where((sizes <= least)[:, None], rows, 0.0)
        spaces.append(rows.T @ rows)
        moved = moved + far * spaces[-1]
    # A zero by itself is as exact as others, and has derivatives.
    alone = jnp.trace(sum(spaces)) < 1.5
    values, left, vectors = _eig(jnp.where(alone, scaled, moved))
    zero = jnp.logical_not(alone) & (jnp.abs(values) > 0.75 * far)
    values = jnp.where(zero, 0.0, values)
    factors = jnp.where(alone | zero, 0.0, far / jnp.where(values == 0.0, 1.0, values))
    within = spaces[0] @ vectors
    for space in reversed(spaces):
        vectors = vectors - factors * (space @ vectors)
    vectors = jnp.where(zero & jnp.any(within != 0.0, axis=0), within, vectors)
    return values, _with_unit_columns(vectors * scales[:, None]), _with_unit_columns(left.conj() / scales[:, None])


@_eigenpairs.defjvp
def _eigenpairs_jvp(primals, tangents):
    """Of each eigenvalue λ by itself: (A − λ) v̇ − λ̇ v = −Ȧ v and wᵀ v̇ = 0.

    That has one solution whatever the others are, such as a double zero, whose eigenvectors are parallel.
    """
    (matrix,), (change,) = primals, tangents
    values, vectors, left = _eigenpairs(matrix)
    equal = _equal_another(matrix, values, vectors, left)
    unit = jnp.eye(len(values) + 1, dtype=values.dtype)

    def slopes(matrix, change, vectors, left):
        def of_one(each):
            value, vector, left, equal = each
            shifted = matrix - value * unit[1:, 1:]
            bordered = jnp.block([[shifted, -vector[:, None]], [left[None], jnp.zeros((1, 1), values.dtype)]])
            right = jnp.pad(change.astype(values.dtype) @ vector, (0, 1))
            return -jnp.linalg.solve(jnp.where(equal, unit, bordered), right)

        found = lax.map(of_one, (values, vectors.T, left.T, equal))
        return found[:, -1], found[:, :-1].T

    to_values, to_vectors = slopes(matrix, change, vectors, left)
    _, to_left = slopes(matrix.T, change.T, left, vectors)
    return (values, vectors, left), (to_values, to_vectors, to_left)


def _scales(matrix):
    """Scales of rows, powers of two, with which off the diagonal each row is about as large as its column: Osborne."""

    def scaled_one(step, scales):
        k = step % len(matrix)
        others = jnp.arange(len(matrix)) != k
        row = jnp.linalg.norm(jnp.where(others, matrix[k] * scales, 0.0)) / scales[k]
        column = jnp.linalg.norm(jnp.where(others, matrix[:, k] / scales, 0.0)) * scales[k]
        coupled = (row > 0.0) & (column > 0.0)
        ratio = jnp.where(coupled, row, 1.0) / jnp.where(coupled, column, 1.0)
        return scales.at[k].multiply(jnp.exp2(jnp.round(jnp.log2(ratio) / 2.0)))

    ones = jnp.ones(len(matrix), matrix.dtype)
    return lax.fori_loop(0, SWEEPS * len(matrix), scaled_one, ones)


def _with_unit_columns(matrix):
    return matrix / jnp.linalg.norm(matrix, axis=0)
