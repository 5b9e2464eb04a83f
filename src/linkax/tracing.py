"""Functions that JAX traces once, however often one program calls them.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked here JAX keeps what it has found for each kind of arguments. XLA compiles
it in place, so that it runs as fast as without the mark.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

traced_once = eqx.filter_jit


def differentiated_whole(function):
    """A function (static, *arrays) of few numbers each whose derivative is found once, for all directions.

    A Jacobian by many directions, of which few concern this function, then costs no more than its own.
    """

    @partial(jax.custom_jvp, nondiff_argnums=(0,))
    def whole(static, *arrays):
        return function(static, *arrays)

    def rule(static, arrays, changes):
        moves = [type(change) is not jax.custom_derivatives.SymbolicZero for change in changes]
        moving = lambda values: [value for value, of in zip(values, moves, strict=True) if of]
        at, restored = ravel_pytree(moving(arrays))

        def of_moving(flat):
            moved = iter(restored(flat))
            return function(static, *(next(moved) if of else array for array, of in zip(arrays, moves, strict=True)))

        slopes = jax.vmap(lambda change: jax.jvp(of_moving, (at,), (change,))[1])(jnp.eye(len(at), dtype=at.dtype))
        change = ravel_pytree(moving(changes))[0]
        return function(static, *arrays), jax.tree.map(lambda slope: jnp.tensordot(change, slope, 1), slopes)

    whole.defjvp(rule, symbolic_zeros=True)
    return whole
