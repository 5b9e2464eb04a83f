"""The largest magnitude of a matrix's eigenvalues, by products alone: for batches, and on any device."""

import jax.numpy as jnp
from jaxtyping import Float

from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

SQUARINGS = 10


def spectral_radius(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch"]:
    """ρ = lim ‖Aᴺ‖^(1/N) (Gelfand), with N = 2¹⁰.

    Too large by thousandths, for a nearly defective A by hundredths.
    """
    logarithm, weight = jnp.zeros(matrix.shape[:-2], matrix.dtype), 1.0
    for _ in range(SQUARINGS):
        size, matrix = _scaled(matrix)
        logarithm, weight = logarithm + weight * jnp.log(size), weight / 2.0
        matrix = matrix @ matrix
    return jnp.exp(logarithm + weight * jnp.log(_scaled(matrix)[0]))


def _scaled(matrix):
    """The largest row sum of a matrix, and the matrix over it."""
    size = jnp.max(jnp.sum(jnp.abs(matrix), axis=-1), axis=-1, initial=0.0)
    return size, ratio(matrix, size[..., None, None])
