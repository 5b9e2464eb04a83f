"""Derivatives as linkax needs them: None for zero, quotients without NaN."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.xla.arrays import Array

Output = TypeVar("Output")


def positive_or_one(b: Float[Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """b where b > 0, elsewhere 1: a scale to divide by."""
    return jnp.where(b > 0.0, b, 1.0)


def ratio(
    a: Float[Array, "*#shape"] | float,
    b: Float[Array, "*#shape"],
    otherwise: Float[Array, "*#shape"] | float | None = None,
) -> Float[jax.Array, "*shape"]:
    """a / b where b > 0, elsewhere another value, or a; its derivatives hold no NaN of the branch not taken."""
    quotient = jnp.divide(a, positive_or_one(b))
    return quotient if otherwise is None else jnp.where(b > 0.0, quotient, otherwise)


def materialise(primal: Array | np.floating | float, change: Array | None) -> Array:
    """Return a tangent as an array; None, the tangent of what does not change, as zeros."""
    return jnp.zeros_like(primal) if change is None else change


def pushforward(function: Callable[..., Output], primals: tuple, tangents: tuple) -> tuple[Output, Any]:
    """Compute a function and its JVP, like `equinox.filter_jvp`, but with zeros where that gives None."""
    found, change = eqx.filter_jvp(function, primals, tangents)
    numbers, _ = eqx.partition(found, eqx.is_inexact_array)
    return found, jax.tree.map(materialise, numbers, change)
