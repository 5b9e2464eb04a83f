"""Scalar operations as one kernel of XLA: the computation of a reduction that reduces nothing.

XLA compiles the computation of a reduction as one stretch of scalar code, and over the other axis, the lanes, as a
loop that a processor's vector instructions take several at a time. Here each result of the reduction is computed anew
from the next entries alone, so the last ones decide. The axis has two entries, which are the same: a reduction over
one entry XLA takes for a reshape, whatever it computes.
"""

from collections.abc import Callable, Container, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.extend.mlir import ir
from jax.extend.mlir.dialects import stablehlo
from jax.interpreters import mlir

from linkax.straight_line.graph import KNOWN, Graph

TWICE = 2


class Kernel:
    """Results of a graph as a function of some of its scalars; both as indices of scalars."""

    def __init__(self, graph: Graph, given: Container[int], results: Sequence[int]) -> None:
        self.graph, self.results = graph, list(results)
        self.order = graph.needed(self.results, given)
        self.given = [index for index in self.order if index in given]
        # Arguments of one type come in one array: XLA can tell that it does not overlap with a result.
        self.types = list(dict.fromkeys(graph.dtypes[index] for index in self.given))
        self.columns = [[index for index in self.given if graph.dtypes[index] == dtype] for dtype in self.types]

    def __call__(self, scalars: dict[int, jax.Array], lanes: tuple[int, ...]) -> list[jax.Array]:
        """Compute the results, (lanes) each, from the scalars that are given; not a number where one is not finite."""
        columns = [jnp.stack([jnp.broadcast_to(scalars[index], lanes) for index in column]) for column in self.columns]
        real = [column for column in columns if jnp.issubdtype(column.dtype, jnp.inexact)]
        finite = jnp.ones(lanes, bool)
        for column in real:
            finite = finite & jnp.all(jnp.isfinite(column), axis=0)
        nothing = [_undefined(self.graph.dtypes[index], lanes) for index in self.results]

        def compute(carry):
            found = _kernel.bind(*lax.optimization_barrier(columns), kernel=self, lanes=lanes)
            return jnp.zeros((), bool), found

        # A loop that runs once: what is in it XLA neither computes again for each reader, nor merges with these.
        _, found = lax.while_loop(lambda carry: carry[0], compute, (jnp.any(finite), nothing))
        if not lanes:
            return found
        return [jnp.where(finite, array, other) for array, other in zip(found, nothing, strict=True)]


def _undefined(dtype, lanes):
    return jnp.full(lanes, np.nan if dtype.kind == "f" else 0, dtype)


def _abstract(*columns, kernel: Kernel, lanes):
    return [ShapedArray(lanes, kernel.graph.dtypes[index]) for index in kernel.results]


def _tensor(dtype, shape=()):
    return ir.RankedTensorType.get(list(shape), mlir.dtype_to_ir_type(np.dtype(dtype)))


def _constant(value, dtype):
    array: Any = np.asarray(value, dtype)
    bits: Any = np.packbits(array.reshape(1), bitorder="little") if array.dtype.kind == "b" else array
    return stablehlo.constant(ir.DenseElementsAttr.get(bits, type=mlir.dtype_to_ir_type(array.dtype), shape=[]))


def _integers(values):
    return ir.DenseI64ArrayAttr.get(list(values))


def _operands(kernel, columns, lanes):
    """What a reduction reads, and which of the results has the same place: triples of both, or None, and the type."""
    graph, rank = kernel.graph, len(lanes)
    free: dict[np.dtype, list[int]] = {}
    for place, index in enumerate(kernel.results):
        free.setdefault(graph.dtypes[index], []).append(place)
    for column, indices, dtype in zip(columns, kernel.columns, kernel.types, strict=True):
        for row, index in enumerate(indices):
            bounds = [row, *(0 for _ in lanes)], [row + 1, *lanes], [1] * (rank + 1)
            part = stablehlo.slice(column, *map(_integers, bounds))
            part = stablehlo.reshape(_tensor(dtype, lanes), part)
            twice = stablehlo.broadcast_in_dim(_tensor(dtype, (TWICE, *lanes)), part, _integers(range(1, rank + 1)))
            places = free.get(dtype)
            yield twice, index, places.pop(0) if places else None, dtype
    for dtype, places in free.items():
        for place in places:
            shape = _tensor(dtype, (TWICE, *lanes))
            yield stablehlo.broadcast_in_dim(shape, _constant(0, dtype), _integers([])), None, place, dtype


def _lower(context, *columns, kernel: Kernel, lanes):
    operands = list(_operands(kernel, columns, lanes))
    types = [_tensor(dtype, lanes) for *_, dtype in operands]
    scalars = [_tensor(dtype) for *_, dtype in operands]
    start = [_constant(0, dtype) for *_, dtype in operands]
    reduction = stablehlo.ReduceOp(types, [array for array, *_ in operands], start, _integers([0]))
    block = reduction.regions[0].blocks.append(*scalars, *scalars)
    with ir.InsertionPoint(block):
        entries = block.arguments[len(operands) :]
        given = {index: entry for entry, (_, index, _, _) in zip(entries, operands, strict=True) if index is not None}
        values = _emit(context, kernel, given)
        stablehlo.return_(
            [
                entry if place is None else values[kernel.results[place]]
                for entry, (_, _, place, _) in zip(entries, operands, strict=True)
            ]
        )
    # A result that nobody reads sends a pass of StableHLO through the whole computation, for minutes.
    found = stablehlo.OptimizationBarrierOp(list(reduction.results)).results
    placed = {place: array for array, (_, _, place, _) in zip(found, operands, strict=True) if place is not None}
    return [placed[place] for place in range(len(kernel.results))]


def _emit(context, kernel, given) -> dict[int, Any]:
    """The scalars of a kernel in the body of a reduction."""
    graph, values = kernel.graph, dict(given)
    for index in kernel.order:
        if index in values:
            continue
        name, operands, _ = graph.operations[index]
        arguments = [values[operand] for operand in operands]
        if name == KNOWN:
            values[index] = _constant(graph.values[index], graph.dtypes[index])
        elif name in DIRECT:
            values[index] = DIRECT[name](*arguments)
        elif name == "select_n":
            which, false, true = arguments
            values[index] = stablehlo.select(which, true, false)
        elif name == "convert_element_type":
            values[index] = stablehlo.convert(_tensor(graph.dtypes[index]), *arguments)
        elif name in COMPARISONS:
            kind = _comparison_type(graph.dtypes[operands[0]])
            direction = stablehlo.ComparisonDirectionAttr.get(name.upper())
            left, right = arguments
            values[index] = stablehlo.compare(left, right, direction, compare_type=kind)
        else:
            (values[index],) = _by_jax(context, graph, index, arguments)
    return values


def _comparison_type(dtype):
    kind = {"f": "FLOAT", "i": "SIGNED"}.get(dtype.kind, "UNSIGNED")
    return stablehlo.ComparisonTypeAttr.get(kind)


def _by_jax(context, graph, index, arguments):
    """An operation that JAX lowers, by its function of that name in `jax.lax`."""
    name, operands, params = graph.operations[index]
    function = lambda *scalars: getattr(lax, name)(*scalars, **dict(params))
    scalar = lambda of: ShapedArray((), graph.dtypes[of])
    inner = context.replace(avals_in=[scalar(of) for of in operands], avals_out=[scalar(index)])
    return mlir.lower_fun(function, multiple_results=False)(inner, *arguments)


DIRECT: dict[str, Callable[..., Any]] = {
    "neg": stablehlo.negate,
    "add": stablehlo.add,
    "sub": stablehlo.subtract,
    "mul": stablehlo.multiply,
    "div": stablehlo.divide,
    "max": stablehlo.maximum,
    "min": stablehlo.minimum,
    "and": stablehlo.and_,
    "or": stablehlo.or_,
    "not": stablehlo.not_,
    "sin": stablehlo.sine,
    "cos": stablehlo.cosine,
    "sqrt": stablehlo.sqrt,
    "rsqrt": stablehlo.rsqrt,
    "abs": stablehlo.abs,
    "sign": stablehlo.sign,
    "exp": stablehlo.exponential,
    "log": stablehlo.log,
    "tanh": stablehlo.tanh,
    "floor": stablehlo.floor,
    "ceil": stablehlo.ceil,
    "atan2": stablehlo.atan2,
    "is_finite": stablehlo.is_finite,
}
COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")

_kernel = Primitive("scalar_kernel")
_kernel.multiple_results = True
_kernel.def_abstract_eval(_abstract)
mlir.register_lowering(_kernel, _lower)
