"""Products of vectors along the last axis."""

import jax.numpy as jnp

from linkax.xla.cross_product import cross as cross


def dot(a, b):
    """Scalar product along the last axis, shape (...)."""
    return jnp.sum(a * b, axis=-1)


def length(a, axis=-1):
    """Euclidean length along an axis; its derivative is zero where the length is."""
    square = jnp.sum(a * a, axis=axis)
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def largest(values):
    """The largest magnitude of an array, max |x|; zero for none."""
    return jnp.max(jnp.abs(values), initial=0.0)
