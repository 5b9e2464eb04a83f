"""Products of vectors along the last axis."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.xla.arrays import Array
from linkax.xla.cross_product import cross as cross


def dot(a: Float[Array, "*#batch n"], b: Float[Array, "*#batch n"]) -> Float[jax.Array, "..."]:
    """Scalar product along the last axis, shape (...)."""
    return jnp.sum(a * b, axis=-1)


def length(a: Float[Array, "..."], axis: int = -1) -> Float[jax.Array, "..."]:
    """Euclidean length along an axis; its derivative is zero where the length is."""
    square = jnp.sum(a * a, axis=axis)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def largest(values: Float[Array, "..."]) -> Float[jax.Array, ""]:
    """The largest magnitude of an array, max |x|; zero for none."""
    return jnp.max(jnp.abs(values), initial=0.0)
