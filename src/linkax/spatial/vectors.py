"""Vectors along the last axis: products, lengths."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.xla.arrays import Array
from linkax.xla.cross_product import cross as cross


def dot(a: Float[Array, "*#batch n"], b: Float[Array, "*#batch n"]) -> Float[jax.Array, "..."]:
    """Multiply vectors along the last axis: a · b, shape (...)."""
    return jnp.sum(a * b, axis=-1)


def length(a: Float[Array, "..."], axis: int = -1) -> Float[jax.Array, "..."]:
    """Compute the Euclidean length along an axis; its derivative is zero where the length is zero."""
    square = jnp.sum(a * a, axis=axis)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def largest(values: Float[Array, "..."]) -> Float[jax.Array, ""]:
    """Find the largest magnitude in an array, max |x|; zero in an empty one."""
    return jnp.max(jnp.abs(values), initial=0.0)
