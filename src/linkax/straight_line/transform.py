"""`straight_line`: a function of arrays as a straight line, with derivatives in both modes, and batches over lanes."""

from collections.abc import Callable, Sequence
from functools import cache, cached_property, lru_cache, partial, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxlib import version as jaxlib

from linkax.straight_line.graph import TooLong
from linkax.straight_line.kernel import Scalars, kernels_of
from linkax.straight_line.known import patterns_of
from linkax.straight_line.program import Pattern, Program, straighten
from linkax.xla.flags import makes_kernels_of_loops
from linkax.xla.tracing import all_concrete, evaluate_now, is_compiled
from linkax.xla.users_line import warn

Output = TypeVar("Output")

MOST_OPERATIONS = 30_000  # scalar ones, which take some seconds to compile
MOST_AT_ONCE = 4_000  # of what runs a few times: more take longer to compile than to run on arrays
KEPT = 16  # straight lines, of some megabytes each; others are made anew where they are compiled again
LANES = 64  # that are computed together
NEAR_BYTES = 2**15  # that a kernel reads and writes, for the nearest cache of a processor
BYTES_OF_A_LANE = 8  # of each argument and result


def straight_line(function: Callable[..., Output], most: int = MOST_OPERATIONS) -> Callable[..., Output]:
    """Decorate a function of pytrees of arrays: compute it as a straight line of scalar operations.

    What folds keeps its rounding, but for the order of sums, and that 0·x is 0. Where a number of its arguments that
    results are computed with is not finite, they are not a number. A function of more than `most` operations stays on
    arrays, as does all of it on other devices than a CPU. Differentiable in both modes, to any order, as the function
    itself is. What a `KnowsEntries` among its arguments knows, folds.
    """

    @wraps(function)
    def straight(*args):
        # Operation by operation where nothing is to be compiled, as for debugging.
        if not (is_compiled() and computes_kernels()):
            return function(*args)
        dynamic, static = eqx.partition(args, eqx.is_array)
        leaves, tree = jax.tree.flatten(dynamic)

        def of_leaves(*leaves):
            return function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))

        made, shapes = jax.make_jaxpr(of_leaves, return_shape=True)(*leaves)
        traced, outside = _without_tracers(made)
        traced = Traced(traced, [*(None for _ in outside), *patterns_of(args)], most)
        operands = *outside, *leaves
        found = _computed(*operands, traced=traced, lanes=None, batched=(False,) * len(operands))
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return straight


@cache
def computes_kernels() -> bool:
    """Whether XLA computes kernels as they are meant, which no version promises: one is tried. Warns where not."""
    if not makes_kernels_of_loops():
        return False
    function = lambda x, y: (jnp.sin(x) * y - x, x > y)
    given = np.array([0.5, 0.25]), np.array([0.125, 3.0])
    traced = Traced(jax.make_jaxpr(function)(0.5, 0.125), known=(None, None), most=10)
    program = jax.jit(partial(_in_kernels, traced=traced, lanes=len(given[0]), batched=(True, True)))
    found, expected = evaluate_now(program, *given), (np.sin(given[0]) * given[1] - given[0], given[0] > given[1])
    right = all(np.allclose(a, b, rtol=1e-6) for a, b in zip(found, expected, strict=True))
    if not right:
        warn(
            f"runs take several times as long as they could: jaxlib {jaxlib.__version__} does not compute what "
            "linkax.straight_line asks of it; install another jaxlib",
            RuntimeWarning,
        )
    return right


def _without_tracers(made: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    """A traced function whose constants are known, and its others, which become its first arguments."""
    jaxpr = made.jaxpr
    outside = [not all_concrete(constant) for constant in made.consts]
    pairs = list(zip(jaxpr.constvars, made.consts, outside, strict=True))
    if not any(outside):
        return made, []
    variables = [variable for variable, _, is_outside in pairs if is_outside]
    inner = jaxpr.replace(
        constvars=[variable for variable, _, is_outside in pairs if not is_outside],
        invars=[*variables, *jaxpr.invars],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    constants = [constant for _, constant, is_outside in pairs if not is_outside]
    return ClosedJaxpr(inner, constants), [constant for _, constant, is_outside in pairs if is_outside]


class Traced:
    """A traced function of arrays, and what has been made of it. Two are the same where they are one object.

    `known`, `most`: see `linkax.straight_line.program.straighten`. `knowing`: the same, with more that is `known`.
    """

    def __init__(self, jaxpr: ClosedJaxpr, known: Sequence[Pattern | None], most: int) -> None:
        self.jaxpr, self.known, self.most = jaxpr, known, most
        self.function = jaxpr_as_fun(jaxpr)
        self.inputs = [ShapedArray(variable.aval.shape, variable.aval.dtype) for variable in jaxpr.jaxpr.invars]
        self.outputs = [ShapedArray(aval.shape, aval.dtype) for aval in jaxpr.out_avals]
        self.tangent, self.transposed = cache(self._tangent), cache(self._transposed)
        self.compiled = cache(self._compiled)
        self.knowing = cache(lambda known: Traced(self.jaxpr, known, self.most))

    @property
    def program(self) -> Program | None:
        """Its straight line; None where that is too long, or none of it is one."""
        return _program(self)

    @cached_property
    def is_straight(self) -> bool:
        return self.program is not None

    @property
    def has_tangents(self) -> tuple[bool, ...]:
        """Which results have tangents."""
        return tuple(jnp.issubdtype(aval.dtype, jnp.inexact) for aval in self.outputs)

    def over_lanes(self, lanes: int, batched: tuple[bool, ...]) -> ClosedJaxpr:
        """The straight line over lanes, as one operation that is traced."""
        avals = [
            ShapedArray((lanes, *aval.shape), aval.dtype) if is_batched else aval
            for aval, is_batched in zip(self.inputs, batched, strict=True)
        ]
        return jax.make_jaxpr(partial(_straight.bind, traced=self, lanes=lanes, batched=batched))(*avals)

    def _tangent(self, moves: tuple[bool, ...]) -> "Traced":
        """The function of all arguments, and tangents of those that move, to the tangents of its real results."""

        def tangents(*operands):
            primals, moving = operands[: len(moves)], iter(operands[len(moves) :])
            along = [next(moving) if does else _no_tangent(primal) for primal, does in zip(primals, moves, strict=True)]
            _, found = jax.jvp(self.function, primals, tuple(along))
            return [tangent for tangent, has in zip(found, self.has_tangents, strict=True) if has]

        moving = [aval for aval, does in zip(self.inputs, moves, strict=True) if does]
        known = *self.known, *(None for _ in moving)
        return Traced(jax.make_jaxpr(tangents)(*self.inputs, *moving), known, self.most)

    def _transposed(self, linear: tuple[bool, ...]) -> "Traced":
        """The function of the other arguments, and cotangents of results, to cotangents of the linear arguments."""

        def cotangents(*operands):
            count = len(linear) - sum(linear)
            fixed, given = iter(operands[:count]), list(operands[count:])
            others = [None if is_linear else next(fixed) for is_linear in linear]

            def of_linear(*arguments):
                moving = iter(arguments)
                return self.function(*(next(moving) if of else other for of, other in zip(linear, others, strict=True)))

            at_zero = [jnp.zeros(aval.shape, aval.dtype) for aval, of in zip(self.inputs, linear, strict=True) if of]
            return jax.vjp(of_linear, *at_zero)[1](given)

        fixed = [aval for aval, of in zip(self.inputs, linear, strict=True) if not of]
        known = [pattern for pattern, of in zip(self.known, linear, strict=True) if not of]
        known += [None] * len(self.outputs)
        return Traced(jax.make_jaxpr(cotangents)(*fixed, *self.outputs), known, self.most)

    def _compiled(self, lanes, batched):
        """A program of its own, for calls outside of others; kept with this object, and no longer."""
        return jax.jit(partial(_straight.bind, traced=self, lanes=lanes, batched=batched))


@lru_cache(maxsize=KEPT)
def _program(traced: Traced) -> Program | None:
    try:
        program = straighten(traced.jaxpr, traced.known, traced.most)
    except TooLong:
        return None
    return program if program.graph.count or not program.between else None


def _no_tangent(primal):
    if jnp.issubdtype(primal.dtype, jnp.inexact):
        return jnp.zeros_like(primal)
    return jnp.zeros(primal.shape, jax.dtypes.float0)


def _computed(*operands, traced: Traced, lanes: int | None, batched: tuple[bool, ...]):
    """A straight line where it is one, else on arrays."""
    if not traced.is_straight:
        return _on_arrays(*operands, traced=traced, lanes=lanes, batched=batched)
    return _straight.bind(*operands, traced=traced, lanes=lanes, batched=batched)


def _on_arrays(*operands, traced: Traced, lanes: int | None, batched: tuple[bool, ...]):
    if lanes is None:
        return traced.function(*operands)
    if not any(batched):
        return [jnp.broadcast_to(array, (lanes, *array.shape)) for array in traced.function(*operands)]
    return jax.vmap(traced.function, in_axes=tuple(0 if is_batched else None for is_batched in batched))(*operands)


def _in_kernels(*operands, traced: Traced, lanes: int | None, batched: tuple[bool, ...]):
    """A straight line on a CPU."""
    program = traced.program
    assert program is not None
    kernels = kernels_of(program)
    compute = partial(_kernel_by_kernel, program, kernels, traced.outputs)
    rows = max((kernel.size for kernel in kernels if kernel is not None), default=1)
    together = max(1, min(LANES, NEAR_BYTES // (BYTES_OF_A_LANE * rows)))
    if lanes is None or lanes <= together:
        return compute(*operands, lanes=lanes, batched=batched)
    return _in_parts(compute, *operands, lanes=lanes, batched=batched, together=together)


def _kernel_by_kernel(program, kernels, outputs, *operands, lanes, batched):
    shape = () if lanes is None else (lanes,)
    scalars = Scalars(program.graph, shape)

    def keep(entries, array, is_batched):
        flat = jnp.moveaxis(array, 0, -1) if is_batched else array
        scalars.keep(entries.ravel().tolist(), flat.reshape(entries.size, *(shape if is_batched else ())))

    for entries, array, is_batched in zip(program.inputs, operands, batched, strict=True):
        keep(entries, array, is_batched)
    for part, kernel in zip([*program.between, None], kernels, strict=True):
        if kernel is not None:
            kernel.compute(scalars)
        if part is not None:
            function = jaxpr_as_fun(part.traced)
            avals = part.traced.in_avals
            arrays = [scalars.dense(entries, aval.dtype) for entries, aval in zip(part.reads, avals, strict=True)]
            found = function(*arrays) if lanes is None else jax.vmap(function, axis_size=lanes)(*arrays)
            for entries, array in zip(part.returns, found, strict=True):
                keep(entries, array, lanes is not None)
    return [scalars.dense(entries, aval.dtype) for entries, aval in zip(program.outputs, outputs, strict=True)]


def _in_parts(compute, *operands, lanes, batched, together):
    """A straight line over many lanes, some at a time."""
    parts = -(-lanes // together)
    together = -(-lanes // parts)

    def split(array):
        filled = jnp.concatenate([array, jnp.broadcast_to(array[:1], (parts * together - lanes, *array.shape[1:]))])
        return filled.reshape(parts, together, *array.shape[1:])

    wide = [split(array) for array, is_batched in zip(operands, batched, strict=True) if is_batched]

    def of_part(part):
        mine = iter(part)
        arrays = [next(mine) if is_batched else array for array, is_batched in zip(operands, batched, strict=True)]
        return compute(*arrays, lanes=together, batched=batched)

    found = lax.map(of_part, wide)
    return [array.reshape(parts * together, *array.shape[2:])[:lanes] for array in found]


def _abstract(*operands, traced: Traced, lanes, batched):
    return [aval if lanes is None else ShapedArray((lanes, *aval.shape), aval.dtype) for aval in traced.outputs]


def _jvp(primals, tangents, *, traced: Traced, lanes, batched):
    real = [jnp.issubdtype(aval.dtype, jnp.inexact) for aval in traced.inputs]
    moves = tuple(type(change) is not ad.Zero and is_real for change, is_real in zip(tangents, real, strict=True))
    moving = [change for change, does in zip(tangents, moves, strict=True) if does]
    of_moving = tuple(is_batched for is_batched, does in zip(batched, moves, strict=True) if does)
    found = _straight.bind(*primals, traced=traced, lanes=lanes, batched=batched)
    along = iter(
        _computed(*primals, *moving, traced=traced.tangent(moves), lanes=lanes, batched=(*batched, *of_moving))
    )
    none = lambda array: ad.Zero(jax.typeof(array).to_tangent_aval())
    return found, [next(along) if has else none(array) for array, has in zip(found, traced.has_tangents, strict=True)]


def _transpose(cotangents, *operands, traced: Traced, lanes, batched):
    linear = tuple(ad.is_undefined_primal(operand) for operand in operands)
    lead = () if lanes is None else (lanes,)
    given = [
        jnp.zeros((*lead, *aval.shape), aval.dtype) if type(cotangent) is ad.Zero else cotangent
        for cotangent, aval in zip(cotangents, traced.outputs, strict=True)
    ]
    fixed = [operand for operand, of in zip(operands, linear, strict=True) if not of]
    of_fixed = [is_batched for is_batched, of in zip(batched, linear, strict=True) if not of]
    of_batch = (*of_fixed, *(lanes is not None for _ in given))
    found = iter(_computed(*fixed, *given, traced=traced.transposed(linear), lanes=lanes, batched=of_batch))

    def cotangent(is_batched):
        array = next(found)
        return array if lanes is None or is_batched else jnp.sum(array, axis=0)

    return [cotangent(is_batched) if of else None for is_batched, of in zip(batched, linear, strict=True)]


def _batch(operands, axes, *, traced: Traced, lanes, batched):
    size = next(array.shape[axis] for array, axis in zip(operands, axes, strict=True) if axis is not None)
    total = size * (1 if lanes is None else lanes)

    def widened(array, axis, was):
        """With lanes of both batches in one axis, or without any."""
        if axis is None and not was:
            return array
        array = array[None] if axis is None else jnp.moveaxis(array, axis, 0)
        if lanes is None:
            return array
        array = array if was else array[:, None]
        return jnp.broadcast_to(array, (size, lanes, *array.shape[2:])).reshape(total, *array.shape[2:])

    wide = [widened(*parts) for parts in zip(operands, axes, batched, strict=True)]
    of_batch = tuple(axis is not None or was for axis, was in zip(axes, batched, strict=True))
    found = _straight.bind(*wide, traced=traced, lanes=total, batched=of_batch)
    if lanes is not None:
        found = [array.reshape(size, lanes, *array.shape[1:]) for array in found]
    return found, [0] * len(found)


_straight = Primitive("straight_line")
_straight.multiple_results = True
_straight.def_abstract_eval(_abstract)
_straight.def_impl(
    lambda *operands, traced, lanes, batched: traced.compiled(lanes, batched)(*operands),
)
ad.primitive_jvps[_straight] = _jvp
ad.primitive_transposes[_straight] = _transpose
batching.primitive_batchers[_straight] = _batch
mlir.register_lowering(_straight, mlir.lower_fun(_on_arrays, multiple_results=True))
mlir.register_lowering(_straight, mlir.lower_fun(_in_kernels, multiple_results=True), platform="cpu")
