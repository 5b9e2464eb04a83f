"""A map over saved times, of which many may never have been reached."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from linkax.xla.arrays import Array
from linkax.xla.products_as_sums import with_products_as_sums

ROWS = 16  # evaluated at a time: few share the price of one close to a singular configuration


def map_saved_times(function: Callable[..., Any], saved: Bool[Array, " n"], *arrays: Float[Array, "n ..."]) -> Any:
    """Map a function over rows of arrays; NaN, zero or false where the row was not saved.

    The map goes in parts. A part of which nothing was saved costs nothing, and one close
    to a singular configuration is no dearer for the others. Differentiable in both modes.

    **Arguments:** `function`: of one row of each array; `saved`: which rows were, (n,); arrays (n, ...).
    """

    @with_products_as_sums
    def of_part(saved, *arrays):
        across = lambda array: saved.reshape(-1, *[1] * (array.ndim - 1))
        # A saved row stands in for others, whose infinite numbers would count as a singular configuration.
        stand_in = jnp.argmax(saved)
        found = jax.vmap(function)(*(jnp.where(across(array), array, array[stand_in]) for array in arrays))
        return jax.tree.map(lambda array: jnp.where(across(array), array, _nothing(array)), found)

    count = len(saved)
    if count <= ROWS:
        return of_part(saved, *arrays)
    parts = -(-count // ROWS)
    split = lambda array: jnp.pad(array, [(0, parts * ROWS - count)] + [(0, 0)] * (array.ndim - 1)).reshape(
        parts, ROWS, *array.shape[1:]
    )
    given = tuple(map(split, (saved, *arrays)))
    shapes = jax.eval_shape(of_part, *(part[0] for part in given))
    blank = jax.tree.map(lambda shape: jnp.broadcast_to(_nothing(shape), shape.shape), shapes)
    found = lax.map(lambda part: lax.cond(jnp.any(part[0]), lambda: of_part(*part), lambda: blank), given)
    return jax.tree.map(lambda array: array.reshape(parts * ROWS, *array.shape[2:])[:count], found)


def _nothing(array):
    return jnp.asarray(jnp.nan if jnp.issubdtype(array.dtype, jnp.inexact) else 0, array.dtype)
