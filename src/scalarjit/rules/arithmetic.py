"""Arithmetic, entry by entry."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from scalarjit.arrays import MANY, Array, Delayed, Entries, Updated, by_entry, every, known_of
from scalarjit.graph import Graph, constant, is_one, is_zero
from scalarjit.rules.rule import SMALL, UNROLLED, UNROLLED_OF_MEMORY, has_entries, made, rule

SAME = [
    "add",
    "sub",
    "mul",
    "div",
    "rem",
    "and",
    "or",
    "xor",
    "neg",
    "not",
    "abs",
    "max",
    "min",
    "eq",
    "ne",
    "lt",
    "le",
    "gt",
    "ge",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "atan2",
    "sinh",
    "cosh",
    "tanh",
    "asinh",
    "acosh",
    "atanh",
    "exp",
    "exp2",
    "log",
    "log1p",
    "expm1",
    "cbrt",
    "sqrt",
    "floor",
    "ceil",
    "is_finite",
    "shift_left",
    "shift_right_arithmetic",
    "shift_right_logical",
    "nextafter",
    "erf",
    "erfc",
    "lgamma",
]


def elementwise(graph: Graph, shape: tuple[int, ...], dtype: np.dtype, function: Callable, *arrays: Array) -> Array:
    """An array whose entries are a function of scalars, for those of arrays; scalars serve all entries."""

    def element(index):
        return function(*(array.at(_own_place(array, index)) for array in arrays))

    size = math.prod(shape)
    if size <= SMALL:
        return Entries(graph, np.broadcast_to(element(every(shape)), shape), dtype)
    if size <= MANY and _few_remain(shape, arrays):
        columns = [np.broadcast_to(array.steady().scalars(), shape) for array in arrays]
        if _different(np.stack([column.ravel() for column in columns])) <= UNROLLED:
            return Entries(graph, np.broadcast_to(function(*columns), shape), dtype)
    return Delayed(graph, shape, dtype, element)


def _few_remain(shape, arrays):
    """Whether operations on entries may be few, before those of arrays in memory are looked at.

    An operation with a zero or one is none, or is one operand's; where all operands are read, equal ones are one.
    """
    if all(map(has_entries, arrays)):
        return True
    known = [ids for array in arrays if array.size > 1 and (ids := known_of(array)) is not None]
    counts = [np.count_nonzero(np.broadcast_to(_is_simple(ids), shape)) for ids in known if ids.size <= MANY]
    return math.prod(shape) - max(counts, default=0) <= UNROLLED_OF_MEMORY


def _is_simple(ids):
    """Whether scalars are zeros or ones."""
    different, places = np.unique(ids, return_inverse=True)
    simple = [is_zero(scalar) or is_one(scalar) for scalar in different.tolist()]
    return np.array(simple, bool)[places].reshape(ids.shape)


def _different(columns) -> int:
    """How many operations on entries there are, of those that are not all constants."""
    unknown = np.any(columns >= 0, axis=0)
    columns = columns[:, unknown]
    if columns.shape[1] <= SMALL:
        return columns.shape[1]
    mixed = columns[0].astype(np.uint64)
    for column in columns[1:]:
        mixed = mixed * np.uint64(0x9E3779B97F4A7C15) + column.astype(np.uint64)
    return len(np.unique(mixed))


def _own_place(array, index):
    """The place in an array, whose axes of one entry, or that is one number, serve all of those of the result."""
    if not array.shape:
        return ()
    return tuple(number if size != 1 else 0 for number, size in zip(index, array.shape, strict=True))


@rule(*SAME)
def _same(graph, name, out, arrays, **params):
    return elementwise(graph, out.shape, out.dtype, partial(graph.map, name), *arrays)


@rule("lt_to", "le_to", "eq_to")
def _in_total_order(graph, name, out, arrays):
    """By which JAX sorts and searches: −0 before 0, and numbers between what is none with and without a sign."""
    if arrays[0].dtype.kind != "f":
        return _same(graph, name.removesuffix("_to"), out, arrays)
    one, zero = constant(1, arrays[0].dtype), constant(0, arrays[0].dtype)

    def before(x, y):
        signs = [graph.map("copysign", one, number) for number in (x, y)]
        ends = [
            graph.map("select", graph.map("eq", number, number), zero, sign)
            for number, sign in zip((x, y), signs, strict=True)
        ]
        of_zeros = graph.map("and", graph.map("eq", x, y), graph.map("lt", *signs))
        of_numbers = graph.map("or", graph.map("lt", x, y), of_zeros)
        among = graph.map("and", graph.map("eq", *ends), of_numbers)
        return graph.map("or", graph.map("lt", *ends), among)

    def compared(x, y):
        if name == "lt_to":
            return before(x, y)
        at_most = graph.map("not", before(y, x))
        return at_most if name == "le_to" else graph.map("and", at_most, graph.map("not", before(x, y)))

    return elementwise(graph, out.shape, out.dtype, compared, *arrays)


@rule("add_any")
def _add_any(graph, name, out, arrays):
    return _same(graph, "add", out, arrays)


@rule("pow")
def _pow(graph, name, out, arrays, **params):
    power = lambda base, exponent: graph.map("pow", base, graph.map(("convert", out.dtype), exponent))
    return elementwise(graph, out.shape, out.dtype, power, *arrays)


@rule("integer_pow")
def _integer_pow(graph, name, out, arrays, *, y):
    one = constant(1, out.dtype)

    def power(base):
        product = None
        exponent = abs(y)
        while exponent:
            if exponent & 1:
                product = base if product is None else graph.map("mul", product, base)
            exponent >>= 1
            if exponent:
                base = graph.map("mul", base, base)
        product = one if product is None else product
        return graph.map("div", one, product) if y < 0 else product

    return elementwise(graph, out.shape, out.dtype, power, *arrays)


@rule("square")
def _square(graph, name, out, arrays):
    return elementwise(graph, out.shape, out.dtype, lambda x: graph.map("mul", x, x), *arrays)


@rule("rsqrt")
def _rsqrt(graph, name, out, arrays, **params):
    inverse = lambda x: graph.map("div", constant(1, out.dtype), graph.map("sqrt", x))
    return elementwise(graph, out.shape, out.dtype, inverse, *arrays)


@rule("logistic")
def _logistic(graph, name, out, arrays, **params):
    one = constant(1, out.dtype)
    function = lambda x: graph.map("div", one, graph.map("add", one, graph.map("exp", graph.map("neg", x))))
    return elementwise(graph, out.shape, out.dtype, function, *arrays)


@rule("sign")
def _sign(graph, name, out, arrays):
    zero, one = constant(0, out.dtype), constant(1, out.dtype)

    def sign(x):
        if out.dtype.kind == "u":
            return graph.map("select", graph.map("gt", x, zero), one, zero)
        below = graph.map("select", graph.map("lt", x, zero), graph.op("neg", one), x)
        return graph.map("select", graph.map("gt", x, zero), one, below)

    return elementwise(graph, out.shape, out.dtype, sign, *arrays)


@rule("round")
def _round(graph, name, out, arrays, *, rounding_method):
    how = "round" if int(rounding_method) == 1 else "round_away"
    return elementwise(graph, out.shape, out.dtype, partial(graph.map, how), *arrays)


@rule("clamp")
def _clamp(graph, name, out, arrays):
    function = lambda low, x, high: graph.map("min", graph.map("max", x, low), high)
    return elementwise(graph, out.shape, out.dtype, function, *arrays)


@rule("convert_element_type")
def _convert(graph, name, out, arrays, **params):
    if arrays[0].dtype == out.dtype:
        return arrays[0]
    return elementwise(graph, out.shape, out.dtype, partial(graph.map, ("convert", out.dtype)), *arrays)


@rule("copy", "copy_p", "optimization_barrier", "stop_gradient", "reduce_precision", "pvary")
def _copy(graph, name, out, arrays, **params):
    return list(arrays) if isinstance(out, list) else arrays[0]


@rule("select_n")
def _select(graph, name, out, arrays):
    which, *cases = arrays
    for updated, base in (cases[::-1], cases) if len(cases) == 2 else ():
        if isinstance(updated, Updated) and updated.base is base:
            window = _of_window(updated, which, updated is cases[1])
            return Updated(base, updated.start, window)

    def select(which, *cases):
        if len(cases) == 2:
            return graph.map("select", graph.map(("convert", np.dtype(bool)), which), cases[1], cases[0])
        found = cases[-1]
        for number in reversed(range(len(cases) - 1)):
            is_case = graph.map("eq", which, constant(number, arrays[0].dtype))
            found = graph.map("select", is_case, cases[number], found)
        return found

    return elementwise(graph, out.shape, out.dtype, select, *arrays)


def _of_window(updated, which, if_true):
    """A window of what it is where a condition holds, and else of what was there."""
    graph = updated.graph

    def element(inner):
        index = tuple(start + number for start, number in zip(updated.start, inner, strict=True))
        condition = which.at(_own_place(which, index))
        pair = updated.window.at(inner), updated.base.at(index)
        return graph.map("select", condition, *(pair if if_true else pair[::-1]))

    return made(graph, updated.window.shape, updated.dtype, by_entry(element))


@rule("platform_index")
def _platform(graph, name, out, arrays, *, platforms):
    number = next(number for number, of in enumerate(platforms) if of is None or "cpu" in of)
    return Entries(graph, constant(number, out.dtype), out.dtype)
