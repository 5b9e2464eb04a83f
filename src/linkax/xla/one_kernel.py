"""A computation as one kernel of the CPU."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool

from linkax.xla.arrays import Array
from linkax.xla.flags import makes_kernels_of_loops
from linkax.xla.products_as_sums import with_products_as_sums
from linkax.xla.tracing import jit_inline


def in_one_kernel(
    when: Callable[..., bool], sound: Callable[..., Bool[Array, ""]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a function: where `when(*args)`, compute it as one kernel of the CPU, if XLA makes such kernels.

    XLA starts each operation of a program by itself, which takes longer than one on few numbers runs. A loop it
    compiles as a whole, see `linkax.xla.flags`. So the function becomes a loop that runs once, without products of
    matrices. In a batch, where one operation has many numbers, and on other devices it stays as it is. Not
    differentiable backwards.

    **Arguments:** `when`, a Python bool, and `sound`, a bool array, as functions of the same arguments. Where `sound`
    is false, results are not a number.
    """

    def decorate(function):
        inline = jit_inline(function)

        @wraps(function)
        def computed(*args):
            if not (when(*args) and makes_kernels_of_loops()):
                return function(*args)
            dynamic, static = eqx.partition(args, eqx.is_array)
            shapes = eqx.filter_eval_shape(inline, *args)
            shapes, fixed = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))

            def plain(sound, dynamic):
                found = eqx.filter(inline(*eqx.combine(dynamic, static)), eqx.is_array)
                return jax.tree.map(lambda array, shape: lax.convert_element_type(array, shape.dtype), found, shapes)

            return eqx.combine(_alone_in_a_loop(plain, shapes)(sound(*args), dynamic), fixed)

        return computed

    return decorate


def _alone_in_a_loop(plain, shapes):
    """A function of (sound, arrays) as a loop that runs once; as it is in batches and on other devices."""

    def looping(sound, dynamic):
        once = lambda carry: (jnp.zeros_like(sound), with_products_as_sums(plain)(sound, dynamic))
        return lax.while_loop(lambda carry: carry[0], once, (sound, jax.tree.map(_undefined, shapes)))[1]

    @jax.custom_batching.custom_vmap
    def single(sound, dynamic):
        return lax.platform_dependent(sound, dynamic, cpu=looping, default=plain)

    @single.def_vmap
    def _(_size, batched, sound, dynamic):
        axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
        found = jax.vmap(plain, in_axes=tuple(axes))(sound, dynamic)
        return found, jax.tree.map(lambda _: True, found)

    return single


def _undefined(shape):
    return jnp.full(shape.shape, jnp.nan if jnp.issubdtype(shape.dtype, jnp.inexact) else 0, shape.dtype)
