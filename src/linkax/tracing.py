"""How JAX and XLA are to treat functions: traced once, computed in one kernel, differentiated whole.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked `traced_once` JAX keeps what it has found for each kind of arguments. XLA
compiles it in place, so that it runs as fast as without the mark.
"""

import math
from functools import cache, partial, wraps

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jax.extend.core.primitives import dot_general_p
from jax.flatten_util import ravel_pytree

from linkax.compiler import makes_kernels_of_loops, quickest_to_compile

FEW_MULTIPLICATIONS = 2**12  # which take no longer as a sum than a library takes, see `with_products_as_sums`

traced_once = eqx.filter_jit


def all_known(tree) -> bool:
    """Whether no array of a tree is traced by a transformation."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def compiled(function):
    """A function as a program of its own, to be called with `once=True` where that is seldom run more than once.

    Of known numbers it is compiled in half of the time then, also inside of a transformation, which has no part in it.
    """
    often = traced_once(function)
    quick = cache(lambda: eqx.filter_jit(function, compiler_options=quickest_to_compile()))  # XLA is asked when it runs

    @wraps(function)
    def program(*args, once: bool):
        if not once or not all_known(args):
            return often(*args)
        # Not `jax.ensure_compile_time_eval`: with it JAX compiles each operation on constants by itself.
        with jax.core.eval_context():
            return quick()(*args)

    return program


def runs_once(function):
    """A function for a program that is seldom run more than once on the same kind of arguments, see `compiled`."""
    return wraps(function)(partial(compiled(function), once=True))


def materialised(primal, change):
    """A change as an array: of zeros, where None stands for none."""
    return jnp.zeros_like(primal) if change is None else change


def pushed_forward(function, primals, changes):
    """Value and change of a function, like `equinox.filter_jvp`, which gives None for no change; this gives zeros."""
    found, change = eqx.filter_jvp(function, primals, changes)
    numbers, _ = eqx.partition(found, eqx.is_inexact_array)
    return found, jax.tree.map(materialised, numbers, change)


def in_one_kernel(function, sound, *args):
    """function(*args), as one kernel of the CPU where that can be; no numbers where `sound` is false.

    Of a program on the CPU XLA starts each of its operations by itself, which takes longer than one on a few
    numbers. A loop it compiles as a whole, see `linkax.compiler`, and this is a loop that runs once, without products
    of matrices. In a batch,
    where one operation concerns many numbers, and on other devices it is no loop. Not to be differentiated backwards.
    """
    if not makes_kernels_of_loops():
        return function(*args)
    function = traced_once(function)
    dynamic, static = eqx.partition(args, eqx.is_array)
    shapes = eqx.filter_eval_shape(function, *args)
    shapes, fixed = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))

    def plain(sound, dynamic):
        found = eqx.filter(function(*eqx.combine(dynamic, static)), eqx.is_array)
        return jax.tree.map(lambda array, shape: lax.convert_element_type(array, shape.dtype), found, shapes)

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

    return eqx.combine(single(sound, dynamic), fixed)


def _undefined(shape):
    return jnp.full(shape.shape, jnp.nan if jnp.issubdtype(shape.dtype, jnp.inexact) else 0, shape.dtype)


def with_products_as_sums(function):
    """A function of arrays whose products of small matrices are sums of products of numbers, where loops are kernels.

    XLA leaves products of matrices on a CPU to a library, which the kernel of a loop cannot call (jaxlib 0.12). Those
    of transformations that have been applied within the function, and of functions of users, are among them.
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
    """A part of a traced function with products as sums; `known`: what has become of those before, by identity."""
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
    """The call of what is `jax.lax.dot_general`: its axes are those shared, those of the left, those of the right."""
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


def one_by_one(function):
    """A function of pytrees that calls LAPACK, for one member of a batch after another on a CPU.

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
    differentiable.defjvp(lambda primals, changes: jax.jvp(function, primals, changes))
    return differentiable


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
