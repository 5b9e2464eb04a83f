"""Scalar operations as one kernel of XLA: a fusion, as XLA makes them itself of what operations it sees together.

XLA compiles a fusion as one stretch of scalar code, and over the lanes as a loop that a processor's vector instructions
take several at a time. It does so in kernels of loops alone, see `linkax.xla.flags`: elsewhere it expects of a fusion
what only its own have, and ends the process. So each is in a loop that runs once.
"""

import math
from collections.abc import Callable, Container, Iterable, Sequence
from itertools import chain
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
from linkax.straight_line.program import Program

SPARSE = 4  # rows of an array for each one that is read, with more of which those that are read are gathered


class Layout:
    """Where the scalars of a graph stand that are computed: in rows of arrays, which have `sizes`."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.sizes: list[int] = []
        self.places: dict[int, tuple[int, int]] = {}  # array and row

    def __contains__(self, index: int) -> bool:
        return index in self.places

    def add(self, indices: Sequence[int]) -> None:
        """Note an array with these scalars as its rows, but for what is known, or stands somewhere already."""
        for row, index in enumerate(indices):
            if self.graph.values[index] is None:
                self.places.setdefault(index, (len(self.sizes), row))
        self.sizes.append(len(indices))

    def find(self, indices: Iterable[int]) -> tuple[list[tuple[int, np.ndarray | None]], dict[int, int], int]:
        """How to make one array that has these scalars: of which arrays, and which of their rows, None for all.

        Also the row of each scalar in it, and how many rows it has.
        """
        wanted: dict[int, list[tuple[int, int]]] = {}
        for index in indices:
            source, row = self.places[index]
            wanted.setdefault(source, []).append((row, index))
        parts, rows, first = [], {}, 0
        for source, read in wanted.items():
            size, chosen = self.sizes[source], None
            if size > SPARSE * len(read):
                size, chosen = len(read), np.array([row for row, _ in read])
                read = list(enumerate(index for _, index in read))
            parts.append((source, chosen))
            rows.update((index, first + row) for row, index in read)
            first += size
        return parts, rows, first


class Scalars(Layout):
    """The same with the arrays, (rows) or (rows, lanes)."""

    def __init__(self, graph: Graph, lanes: tuple[int, ...]) -> None:
        super().__init__(graph)
        self.lanes = lanes
        self.arrays: list[jax.Array] = []

    def keep(self, indices: Sequence[int], array: jax.Array) -> None:
        """Add an array with these scalars as its rows."""
        self.add(indices)
        self.arrays.append(array)

    def read(self, parts: Iterable[tuple[int, np.ndarray | None]]) -> list[jax.Array]:
        """Parts that `find` names, (rows, lanes) each, of one array of scalars of one type."""
        whole = lambda source, chosen: self.arrays[source] if chosen is None else self.arrays[source][chosen]
        return [self._in_lanes(whole(*part)) for part in parts]

    def dense(self, entries: np.ndarray, dtype: np.dtype) -> jax.Array:
        """An array (lanes, ...) of scalars, known ones among them."""
        indices = entries.ravel().tolist()
        values = {index: self.graph.values[index] for index in indices}
        known = [index for index, value in values.items() if value is not None]
        places, rows, first = self.find(index for index, value in values.items() if value is None)
        rows.update(zip(known, range(first, first + len(known)), strict=True))
        parts = self.read(places)
        parts.append(self._in_lanes(jnp.asarray(np.array([values[index] for index in known], dtype))))
        found, read = jnp.concatenate(parts), np.array([rows[index] for index in indices], int)
        if not np.array_equal(read, np.arange(len(found))):
            found = found[read]
        return jnp.moveaxis(found.reshape(*entries.shape, *self.lanes), range(entries.ndim), range(-entries.ndim, 0))

    def _in_lanes(self, array):
        """The same values in all lanes, where an array has none."""
        same = self.lanes and array.ndim == 1
        return jnp.broadcast_to(array[:, None] if same else array, (len(array), *self.lanes))


class Kernel:
    """Results of a graph as a function of scalars that stand somewhere; both as indices of scalars.

    `checked`: scalars that spoil all results where they are not finite. `size`: rows that it reads and writes.
    """

    def __init__(self, layout: Layout, results: Iterable[int], checked: Container[int]) -> None:
        self.graph, self.checked = layout.graph, checked
        # Results of one type come in one array, as do arguments.
        self.results = self._by_type(results)
        self.order = self.graph.needed(list(results), layout)
        self.arguments = self._by_type(index for index in self.order if index in layout)
        found = [layout.find(indices) for indices in self.arguments.values()]
        self.parts, self.rows = [parts for parts, *_ in found], [rows for _, rows, _ in found]
        self.size = sum(size for *_, size in found) + sum(map(len, self.results.values()))

    def _by_type(self, indices):
        columns: dict[np.dtype, list[int]] = {}
        for index in indices:
            columns.setdefault(self.graph.dtypes[index], []).append(index)
        return columns

    def compute(self, scalars: Scalars) -> None:
        """Add the results to scalars with the layout that it was made for."""
        lanes = scalars.lanes
        count = math.prod(lanes)
        columns, finite = [], jnp.ones(count, bool)
        for (dtype, indices), parts, rows in zip(self.arguments.items(), self.parts, self.rows, strict=True):
            # With a row of zeros: XLA can tell that it overlaps with no result.
            column = jnp.concatenate([*scalars.read(parts), jnp.zeros((1, *lanes), dtype)]).reshape(-1, count)
            if dtype.kind == "f":
                passes = np.ones(len(column), bool)
                passes[[rows[index] for index in indices if index in self.checked]] = False
                finite = finite & jnp.all(jnp.isfinite(column) | passes[:, None], axis=0)
            columns.append(column)
        # Behind a barrier, so that XLA knows neither that the loop runs once nor what results are beside the fusion.
        spoils = jnp.where(finite, jnp.float32(0.0), jnp.nan)
        begins, spoils = lax.optimization_barrier((jnp.any(finite), spoils))
        nothing = [
            jnp.full(len(indices) * count, jnp.nan if dtype.kind == "f" else 0, dtype)
            for dtype, indices in self.results.items()
        ]

        def once(carry):
            found = iter(_kernel.bind(spoils, *(column.ravel() for column in columns), kernel=self, lanes=count))
            together = [jnp.concatenate([next(found) for _ in indices]) for indices in self.results.values()]
            return jnp.zeros((), bool), together

        _, found = lax.while_loop(lambda carry: carry[0], once, (begins, nothing))
        for indices, array in zip(self.results.values(), found, strict=True):
            scalars.keep(indices, array.reshape(len(indices), *lanes))


def kernels_of(program: Program) -> list[Kernel | None]:
    """The kernels of a program: for what each part that stays on arrays reads, and for its results; None for nothing.

    In that order they find what they read where `Scalars` keep it.
    """
    graph, layout = program.graph, Layout(program.graph)

    def keep(arrays):
        for entries in arrays:
            layout.add(entries.ravel().tolist())

    keep(program.inputs)
    arguments, kernels = set(layout.places), []
    for reads, returns in [*((part.reads, part.returns) for part in program.between), (program.outputs, [])]:
        wanted = dict.fromkeys(index for entries in reads for index in entries.ravel().tolist())
        wanted = [index for index in wanted if index not in layout and graph.values[index] is None]
        kernel = Kernel(layout, wanted, arguments) if wanted else None
        if kernel is not None:
            for indices in kernel.results.values():
                layout.add(indices)
        kernels.append(kernel)
        keep(returns)
    return kernels


def _abstract(spoils, *columns, kernel: Kernel, lanes: int):
    return [_aval(kernel.graph, index, lanes) for index in chain(*kernel.results.values())]


def _lower(context, spoils, *columns, kernel: Kernel, lanes: int):
    graph = kernel.graph
    kind = ir.Attribute.parse("#mhlo<fusion_kind kLoop>")
    wanted = list(chain(*kernel.results.values()))
    results = [_tensor(graph, index, lanes) for index in wanted]
    operands = spoils, *columns
    fusion = ir.Operation.create("mhlo.fusion", results, operands, {"fusion_kind": kind}, regions=1)
    block = fusion.regions[0].blocks.append(*(operand.type for operand in operands))
    integers = lambda number: ir.DenseI64ArrayAttr.get([number])
    part = lambda column, row: stablehlo.slice(column, *map(integers, (row * lanes, (row + 1) * lanes, 1)))
    with ir.InsertionPoint(block):
        spoils, *columns = block.arguments
        values, uses = {}, spoils
        for column, rows in zip(columns, kernel.rows, strict=True):
            values.update((index, part(column, row)) for index, row in rows.items())
            last = part(column, column.type.shape[0] // lanes - 1)
            uses = stablehlo.add(uses, stablehlo.convert(spoils.type, last))
        _emit(context, kernel, values, lanes)
        # XLA takes it for granted that a fusion uses all of its arguments, which have a last row for that, and
        # that no result is a constant or a whole argument, as some might turn out to be.
        sound, nothing = stablehlo.is_finite(uses), {}
        for index in wanted:
            if (dtype := graph.dtypes[index]) not in nothing:
                nothing[dtype] = _nothing(spoils, _tensor(graph, index, lanes), lanes)
            values[index] = stablehlo.select(sound, values[index], nothing[dtype])
        ir.Operation.create("mhlo.return", operands=[values[index] for index in wanted])
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
