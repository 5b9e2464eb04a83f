"""Functions with another way of computing in a batch, where JAX's own rules cost too much or hang."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def one_by_one(function: Callable[..., Any]) -> Callable[..., Any]:
    """Map a function that calls LAPACK over the members of a batch one after another, on a CPU.

    jaxlib (0.10) spreads a LAPACK call for a batch over the threads that the program itself runs in, and waits for
    them: two such calls at once wait for each other for ever. Derivatives are those of the function as it is.
    """

    @jax.custom_batching.custom_vmap
    def single(*arrays):
        return function(*arrays)

    @single.def_vmap
    def _(size, batched, *arrays):
        each = lambda array, of_batch: array if of_batch else jnp.broadcast_to(array, (size, *jnp.shape(array)))
        arrays = jax.tree.map(each, arrays, tuple(batched))
        mapped = lambda *arrays: lax.map(lambda members: single(*members), arrays)
        found = lax.platform_dependent(*arrays, cpu=mapped, default=jax.vmap(function))
        return found, jax.tree.map(lambda _: True, found)

    differentiable = jax.custom_jvp(single)
    differentiable.defjvp(lambda primals, tangents: jax.jvp(function, primals, tangents))
    return differentiable
