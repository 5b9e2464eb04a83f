"""Scalar operations as one kernel of XLA: a fusion, as XLA makes them itself of what operations it sees together.

XLA compiles a fusion as one stretch of scalar code, and over the lanes as a loop that a processor's vector instructions
take several at a time. It does so in kernels of loops alone, see `linkax.xla.flags`: elsewhere it expects of a fusion
what only its own have, and ends the process. So each is in a loop that runs once.
"""

import math
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


class Kernel:
    """Results of a graph as a function of some of its scalars; both as indices of scalars.

    `checked`: scalars that spoil all results where they are not finite.
    """

    def __init__(self, graph: Graph, given: Container[int], results: Sequence[int], checked: Container[int]) -> None:
        self.graph, self.results, self.checked = graph, list(results), checked
        self.order = graph.needed(self.results, given)
        arguments = [index for index in self.order if index in given]
        # Arguments of one type come in one array, with a row of zeros: XLA can tell that it overlaps with no result.
        self.types = list(dict.fromkeys(graph.dtypes[index] for index in arguments))
        self.columns = [[index for index in arguments if graph.dtypes[index] == dtype] for dtype in self.types]

    def __call__(self, scalars: dict[int, jax.Array], lanes: tuple[int, ...]) -> list[jax.Array]:
        """Compute the results, (lanes) each, from the scalars that are given."""
        count = math.prod(lanes)
        rows = lambda column, dtype: [*(scalars[index] for index in column), jnp.zeros((), dtype)]
        columns = [
            jnp.stack([jnp.broadcast_to(row, lanes) for row in rows(column, dtype)]).reshape(-1, count)
            for column, dtype in zip(self.columns, self.types, strict=True)
        ]
        finite = jnp.ones(count, bool)
        for column, indices, dtype in zip(columns, self.columns, self.types, strict=True):
            if dtype.kind == "f":
                passes = np.array([index not in self.checked for index in indices] + [True])[:, None]
                finite = finite & jnp.all(jnp.isfinite(column) | passes, axis=0)
        # Behind a barrier, so that XLA knows neither that the loop runs once nor what results are beside the fusion.
        spoils = jnp.where(finite, jnp.float32(0.0), jnp.nan)
        begins, spoils = lax.optimization_barrier((jnp.any(finite), spoils))
        types = [self.graph.dtypes[index] for index in self.results]
        nothing = [jnp.full(count, jnp.nan if dtype.kind == "f" else 0, dtype) for dtype in types]

        def compute(carry):
            found = _kernel.bind(spoils, *(column.ravel() for column in columns), kernel=self, lanes=count)
            return jnp.zeros((), bool), found

        _, found = lax.while_loop(lambda carry: carry[0], compute, (begins, nothing))
        return [array.reshape(lanes) for array in found]


def _abstract(spoils, *columns, kernel: Kernel, lanes: int):
    return [_aval(kernel.graph, index, lanes) for index in kernel.results]


def _lower(context, spoils, *columns, kernel: Kernel, lanes: int):
    graph = kernel.graph
    kind = ir.Attribute.parse("#mhlo<fusion_kind kLoop>")
    results = [_tensor(graph, index, lanes) for index in kernel.results]
    operands = spoils, *columns
    fusion = ir.Operation.create("mhlo.fusion", results, operands, {"fusion_kind": kind}, regions=1)
    block = fusion.regions[0].blocks.append(*(operand.type for operand in operands))
    integers = lambda number: ir.DenseI64ArrayAttr.get([number])
    part = lambda column, row: stablehlo.slice(column, *map(integers, (row * lanes, (row + 1) * lanes, 1)))
    with ir.InsertionPoint(block):
        spoils, *columns = block.arguments
        values, uses = {}, spoils
        for column, indices in zip(columns, kernel.columns, strict=True):
            *rows, last = [part(column, row) for row in range(len(indices) + 1)]
            values.update(zip(indices, rows, strict=True))
            uses = stablehlo.add(uses, stablehlo.convert(spoils.type, last))
        _emit(context, kernel, values, lanes)
        # XLA takes it for granted that a fusion uses all of its arguments, which have a last row for that, and
        # that no result is a constant or a whole argument, as some might turn out to be.
        sound, nothing = stablehlo.is_finite(uses), {}
        for index in kernel.results:
            if (dtype := graph.dtypes[index]) not in nothing:
                nothing[dtype] = _nothing(spoils, _tensor(graph, index, lanes), lanes)
            values[index] = stablehlo.select(sound, values[index], nothing[dtype])
        ir.Operation.create("mhlo.return", operands=[values[index] for index in kernel.results])
    return list(fusion.results)


def _nothing(spoils, tensor, lanes):
    """NaN, zero or false, of a type, where `spoils` is NaN."""
    if tensor.element_type == mlir.dtype_to_ir_type(np.dtype(bool)):
        return _compare("gt", np.dtype(np.float32), spoils, mlir.ir_constant(np.ones(lanes, np.float32)))
    return stablehlo.convert(tensor, spoils)


def _tensor(graph, index, lanes):
    return ir.RankedTensorType.get([lanes], mlir.dtype_to_ir_type(graph.dtypes[index]))


def _aval(graph, index, lanes):
    return ShapedArray((lanes,), graph.dtypes[index])


def _emit(context, kernel, values, lanes) -> None:
    """Add to the scalars that are given those that are computed from them."""
    graph = kernel.graph
    for index in kernel.order:
        if index in values:
            continue
        name, operands, _ = graph.operations[index]
        arguments = [values[operand] for operand in operands]
        if name == KNOWN:
            values[index] = mlir.ir_constant(np.full(lanes, graph.values[index], graph.dtypes[index]))
        elif name in DIRECT:
            values[index] = DIRECT[name](*arguments)
        elif name == "select_n":
            which, false, true = arguments
            values[index] = stablehlo.select(which, true, false)
        elif name == "convert_element_type":
            values[index] = stablehlo.convert(_tensor(graph, index, lanes), *arguments)
        elif name in COMPARISONS:
            values[index] = _compare(name, graph.dtypes[operands[0]], *arguments)
        else:
            (values[index],) = _by_jax(context, graph, index, arguments, lanes)


def _compare(name, dtype, left, right):
    kind = {"f": "FLOAT", "i": "SIGNED"}.get(dtype.kind, "UNSIGNED")
    direction = stablehlo.ComparisonDirectionAttr.get(name.upper())
    return stablehlo.compare(left, right, direction, compare_type=stablehlo.ComparisonTypeAttr.get(kind))


def _by_jax(context, graph, index, arguments, lanes):
    """An operation that JAX lowers, by its function of that name in `jax.lax`."""
    name, operands, params = graph.operations[index]
    function = lambda *scalars: getattr(lax, name)(*scalars, **dict(params))
    inner = context.replace(
        avals_in=[_aval(graph, of, lanes) for of in operands], avals_out=[_aval(graph, index, lanes)]
    )
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
