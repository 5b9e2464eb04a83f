"""Functions of few numbers whose Jacobians are computed whole."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree


def whole_jacobian(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function (static, *arrays) of few numbers: compute its Jacobian once, and contract it with each
    tangent.

    Of a Jacobian with many columns, few of which concern this function, it then costs no more than its own.
    """

    @partial(jax.custom_jvp, nondiff_argnums=(0,))
    def whole(static, *arrays):
        # From here JAX takes which results have a row for each member of a batch, and it fails where the changes of
        # others have one (https://github.com/jax-ml/jax/issues/16374). So all of them depend on all arrays.
        of_all = jnp.sum(ravel_pytree(arrays)[0])
        return jax.tree.map(lambda result: jnp.where(True, result, of_all), function(static, *arrays))

    def rule(static, arrays, tangents):
        moves = [type(change) is not jax.custom_derivatives.SymbolicZero for change in tangents]
        moving = lambda values: [value for value, of in zip(values, moves, strict=True) if of]
        at, restored = ravel_pytree(moving(arrays))
        straight = partial(function, static)

        def of_moving(flat):
            moved = iter(restored(flat))
            return straight(*(next(moved) if of else array for array, of in zip(arrays, moves, strict=True)))

        along = lambda change: jax.jvp(of_moving, (at,), (change,))
        found, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(at), dtype=at.dtype))
        change = ravel_pytree(moving(tangents))[0]
        return found, jax.tree.map(lambda slope: jnp.tensordot(change, slope, 1), slopes)

    whole.defjvp(rule, symbolic_zeros=True)
    return whole
