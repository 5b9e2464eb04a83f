"""Newton's method and its like: iterate for as long as it helps."""

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jax import lax

from linkax.xla.arrays import Array, ScalarLike

Carry = TypeVar("Carry")


def while_falling(
    improve: Callable[[Carry, Array], tuple[Carry, Array]],
    begin: Carry,
    most: int,
    small: ScalarLike,
    dtype: np.dtype,
    least_fall: float = 0.0,
) -> Carry:
    """Iterate until the residual is small, stops falling, or `most` iterations are done; at least once.

    **Arguments:** `improve`: (state, residual of the iteration before, at first as large as can be) ↦ (state,
    residual); `begin`: the first state; `dtype`: floating-point type of the residual; `least_fall`: the share of the
    residual below which an iteration does not count as falling.

    **Returns:** the last state.
    """

    def unfinished(carry):
        count, _, missed, before = carry
        return (count == 0) | ((count < most) & (missed > small) & (missed < (1.0 - least_fall) * before))

    def iterate(carry):
        count, state, before, _ = carry
        state, missed = improve(state, before)
        return count + 1, state, missed, before

    largest = jnp.asarray(jnp.finfo(dtype).max, dtype)
    return lax.while_loop(unfinished, iterate, (jnp.zeros((), int), begin, largest, largest))[1]
