"""A map over saved times, of which many may never have been reached."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from linkax.xla.arrays import Array
from linkax.xla.undefined import undefined_where


def map_saved_times(function: Callable[..., Any], saved: Bool[Array, " n"], *arrays: Float[Array, "n ..."]) -> Any:
    """Map a function over rows of arrays, one after another; NaN, zero or false where the row was not saved.

    A row that was not saved costs nothing, and one close to a singular configuration is no dearer for the others.
    Differentiable in both modes; derivatives of rows that were not saved are undefined.

    **Arguments:** `function`: of one row of each array; `saved`: which rows were, (n,); arrays (n, ...).
    """
    # Traced once, not for the shapes of its results too.
    once = jax.jit(lambda *row: function(*row))
    blank = jax.tree.map(_nothing, jax.eval_shape(once, *(array[0] for array in arrays)))
    found = lax.map(lambda row: lax.cond(row[0], lambda: once(*row[1:]), lambda: blank), (saved, *arrays))
    numbers, others = eqx.partition(found, eqx.is_inexact_array)
    missing = jax.tree.map(lambda part: jnp.logical_not(saved).reshape(-1, *(1,) * (part.ndim - 1)), numbers)
    return eqx.combine(undefined_where(missing, numbers, arrays), others)


def _nothing(shape):
    return jnp.full(shape.shape, jnp.nan if jnp.issubdtype(shape.dtype, jnp.inexact) else 0, shape.dtype)
