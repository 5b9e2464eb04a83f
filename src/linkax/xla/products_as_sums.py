"""Products of small matrices as sums of products of numbers, which a kernel can hold."""

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jax.extend.core.primitives import dot_general_p

from linkax.xla.flags import makes_kernels_of_loops

Output = TypeVar("Output")

FEW_MULTIPLICATIONS = 2**12  # which take no longer as a sum than a library takes


def with_products_as_sums(function: Callable[..., Output]) -> Callable[..., Output]:
    """Decorate a function of arrays: replace its products of small matrices by sums, where loops are kernels.

    XLA leaves products of matrices on a CPU to a library, which the kernel of a loop cannot call (jaxlib 0.12).
    Products inside of transformations applied within the function, and in functions of users, are replaced too.
    """

    @wraps(function)
    def summed(*args):
        if not makes_kernels_of_loops():
            return function(*args)
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        found = jaxpr_as_fun(_summed(traced, {}))(*jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return summed


def _summed(part, known):
    """Replace products in a part of a traced function; `known`: what earlier parts became, by identity."""
    if type(part) is tuple:  # of branches
        return tuple(_summed(of, known) for of in part)
    if not isinstance(part, Jaxpr | ClosedJaxpr):
        return part
    if id(part) not in known:
        if isinstance(part, Jaxpr):
            made = part.replace(eqns=[_summed_equation(equation, known) for equation in part.eqns])
        else:
            made = part.replace(jaxpr=_summed(part.jaxpr, known))
        known[id(part)] = made
    return known[id(part)]


def _summed_equation(equation, known):
    if equation.primitive is not dot_general_p:
        return equation.replace(params={name: _summed(value, known) for name, value in equation.params.items()})
    left, right, found = (of.aval for of in (*equation.invars, *equation.outvars))
    axes = equation.params["dimension_numbers"]
    summed = math.prod(left.shape[axis] for axis in axes[0][0])
    of_one_kind = left.dtype == right.dtype == found.dtype and jnp.issubdtype(found.dtype, jnp.floating)
    if not of_one_kind or found.size * summed > FEW_MULTIPLICATIONS:
        return equation
    (call,) = _sum_of_products(axes, *(jax.ShapeDtypeStruct(array.shape, array.dtype) for array in (left, right))).eqns
    return equation.replace(primitive=call.primitive, params=call.params)


@cache
def _sum_of_products(axes, left, right):
    """The call that computes `jax.lax.dot_general`: axes shared, axes of the left, axes of the right."""
    contracted, shared = axes
    own = [
        [i for i in range(array.ndim) if i not in (*c, *s)] for array, c, s in zip((left, right), *axes, strict=True)
    ]
    middle = len(shared[0]) + len(own[0])

    @jax.jit
    def sum_of_products(left, right):
        left = lax.transpose(left, (*shared[0], *own[0], *contracted[0]))
        right = lax.transpose(right, (*shared[1], *own[1], *contracted[1]))
        left = lax.expand_dims(left, range(middle, middle + len(own[1])))
        right = lax.expand_dims(right, range(len(shared[0]), middle))
        return jnp.sum(left * right, axis=range(middle + len(own[1]), left.ndim))

    return jax.make_jaxpr(sum_of_products)(left, right)
