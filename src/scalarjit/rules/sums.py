"""Sums, products and the like, along axes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from scalarjit.arrays import (
    LINE,
    MANY,
    Entries,
    Number,
    Stored,
    are_known,
    by_entry,
    every,
    nested,
    ravelled,
    unravelled,
)
from scalarjit.graph import INDEX, Buffer, Graph, Store, as_scalar, constant, constants, number_of
from scalarjit.rules.rule import SMALL, UNROLLED, UNROLLED_OF_MEMORY, has_entries, made, rule, written

PASSES = 8  # of a sum in a loop that are written one by one
TILE = 8  # entries of a row of a product that are added up at once
FEW = 4  # entries of a row that may be nonzero, up to which a product leaves out the others


def folded(graph: Graph, count: int, initial: int, term: Callable[[Number, Any], Any], unrolled: bool) -> Any:
    """What terms add up to: term(number, what was found before it)."""
    if unrolled or count <= PASSES:
        found = initial
        for number in range(count):
            found = term(number, found)
        return found
    (found,) = graph.loop(count, (initial,), lambda index, carried: (term(number_of(graph, index), carried),))
    return found


@rule("reduce_sum", "reduce_prod", "reduce_max", "reduce_min", "reduce_and", "reduce_or", "reduce_xor")
def _reduce(graph, name, out, arrays, *, axes, **params):
    (array, *_) = arrays
    how = {"sum": "add", "prod": "mul"}.get(name[7:], name[7:])
    shape = tuple(array.shape[axis] for axis in axes)
    count = math.prod(shape)
    begin = _neutral(how, out.dtype)
    unknown = int(np.count_nonzero(array.scalars() >= 0)) if has_entries(array) else array.size
    entries = unknown <= UNROLLED and array.size <= MANY

    def element(index):
        def term(number, found):
            inner = iter(unravelled(number, shape))
            outer = iter(index)
            whole = tuple(next(inner) if axis in axes else next(outer) for axis in range(len(array.shape)))
            return graph.map(how, found, array.at(whole))

        return folded(graph, count, begin, term, are_known(index) and entries)

    return made(graph, out.shape, out.dtype, element if entries else by_entry(element), entries=entries)


def _neutral(how, dtype):
    if how in ("add", "or", "xor"):
        return constant(0, dtype)
    if how == "mul":
        return constant(1, dtype)
    if how == "and":
        return constant(True if dtype.kind == "b" else -1, dtype)
    if dtype.kind == "b":
        return constant(how == "min", dtype)
    if dtype.kind == "f":
        return constant(-np.inf if how == "max" else np.inf, dtype)
    return constant(np.iinfo(dtype).min if how == "max" else np.iinfo(dtype).max, dtype)


@rule("argmax", "argmin")
def _argument(graph, name, out, arrays, *, axes, index_dtype):
    (array,) = arrays
    (axis,) = axes
    better = "gt" if name == "argmax" else "lt"

    def element(index):
        at = lambda number: array.at((*index[:axis], number, *index[axis:]))

        def step(number, best, place):
            value = at(number)
            is_better = graph.op(better, value, best)
            if array.dtype.kind == "f":
                is_nan = graph.op("and", graph.op("ne", value, value), graph.op("eq", best, best))
                is_better = graph.op("or", is_better, is_nan)
            return graph.op("select", is_better, value, best), graph.op("select", is_better, as_scalar(number), place)

        best, place = at(0), constant(0)
        count = array.shape[axis]
        if count <= SMALL:
            for number in range(1, count):
                best, place = step(number, best, place)
        else:
            body = lambda scalar, best, place: step(number_of(graph, scalar), best, place)
            best, place = graph.loop(count, (best, place), body)
        return graph.op(("convert", np.dtype(index_dtype)), place)

    return made(graph, out.shape, out.dtype, by_entry(element))


@rule("cumsum", "cumprod", "cummax", "cummin")
def _cumulated(graph, name, out, arrays, *, axis, reverse):
    array = arrays[0].steady()
    how = {"sum": "add", "prod": "mul"}.get(name[3:], name[3:])
    count = out.shape[axis]
    step = lambda number: count - 1 - number if reverse else number
    others = out.shape[:axis] + out.shape[axis + 1 :]
    insert = lambda index, number: (*index[:axis], step(number), *index[axis:])
    begin = _neutral(how, out.dtype)
    if array.size <= UNROLLED:
        ids = np.empty(out.shape, np.int64)
        found: Any = begin
        for number in range(count):
            place = insert(every(others), number)
            ids[place] = found = graph.map(how, found, array.at(place))
        return Entries(graph, ids, out.dtype)

    def write(buffer):
        def line(scalar):
            index = unravelled(number_of(graph, scalar), others)

            def one(scalar, found):
                place = insert(index, number_of(graph, scalar))
                found = graph.op(how, found, array.at(place))
                graph.do(Store(buffer, as_scalar(ravelled(place, out.shape)), found))
                return (found,)

            graph.loop(count, (begin,), one)
            return ()

        graph.loop(math.prod(others), (), line)

    return written(graph, out, write)


@rule("sort")
def _sort(graph, name, out, arrays, *, dimension, num_keys, **params):
    """Each entry goes where it belongs: as far as there are entries before it."""
    arrays = [array.stored() for array in arrays]
    shape = arrays[0].shape
    count = shape[dimension]
    others = shape[:dimension] + shape[dimension + 1 :]
    buffers = [Buffer(array.dtype, array.size) for array in arrays]

    def line(scalar):
        index = unravelled(number_of(graph, scalar), others)
        insert = lambda number: (*index[:dimension], number, *index[dimension:])

        def is_before(one, other):
            """Of two different places, whether the first one's entry comes first; equal ones keep their order."""
            found = graph.op("lt", as_scalar(one), as_scalar(other))
            for array in reversed(arrays[:num_keys]):
                a, b = array.at(insert(one)), array.at(insert(other))
                less, more = graph.op("lt", a, b), graph.op("lt", b, a)
                if array.dtype.kind == "f":
                    of_a, of_b = graph.op("ne", a, a), graph.op("ne", b, b)
                    less = graph.op("or", less, graph.op("and", of_b, graph.op("not", of_a)))
                    more = graph.op("or", more, graph.op("and", of_a, graph.op("not", of_b)))
                found = graph.op("or", less, graph.op("and", graph.op("not", more), found))
            return found

        def one(scalar):
            place = number_of(graph, scalar)
            term = lambda other, found: graph.op("add", found, graph.op(("convert", INDEX), is_before(other, place)))
            rank = number_of(graph, folded(graph, count, constant(0), term, False))
            for array, buffer in zip(arrays, buffers, strict=True):
                graph.do(Store(buffer, as_scalar(ravelled(insert(rank), shape)), array.at(insert(place))))
            return ()

        graph.loop(count, (), one)
        return ()

    graph.loop(math.prod(others), (), line)
    return [Stored(graph, shape, buffer) for buffer in buffers]


@rule("dot_general")
def _dot(graph, name, out, arrays, *, dimension_numbers, **params):
    (left_axes, right_axes), (left_batch, right_batch) = dimension_numbers
    left, right = arrays
    left_free = [axis for axis in range(len(left.shape)) if axis not in (*left_axes, *left_batch)]
    right_free = [axis for axis in range(len(right.shape)) if axis not in (*right_axes, *right_batch)]
    inner = tuple(left.shape[axis] for axis in left_axes)
    count = math.prod(inner)
    products = math.prod(out.shape) * count
    entries = products <= UNROLLED_OF_MEMORY
    if (
        not entries
        and max(left.size, right.size, math.prod(out.shape)) <= MANY
        and has_entries(left)
        and has_entries(right)
    ):
        is_left, is_right = (_may_be_nonzero(array).astype(np.int64) for array in arrays)
        in_order = is_left.transpose([*left_batch, *left_free, *left_axes]).reshape(
            math.prod(left.shape[axis] for axis in left_batch), -1, count
        )
        other = is_right.transpose([*right_batch, *right_axes, *right_free]).reshape(len(in_order), count, -1)
        entries = int(np.sum(in_order @ other)) <= UNROLLED
    few = None if entries else _least(_few_nonzero(left, left_axes), _few_nonzero(right, right_axes))
    if not entries:
        left, right = left.steady(), right.steady()
    num_batch = len(left_batch)
    num_left = len(left_free)

    def rows(index):
        """Indices of both operands, but for those along which products are added up."""
        batch = index[:num_batch]
        of_left = index[num_batch : num_batch + num_left]
        of_right = index[num_batch + num_left :]
        return [
            dict(zip(axes, batch, strict=True)) | dict(zip(free, of_free, strict=True))
            for axes, free, of_free in ((left_batch, left_free, of_left), (right_batch, right_free, of_right))
        ]

    def added(found, index, along):
        factors = []
        for array, row, axes in zip((left, right), rows(index), (left_axes, right_axes), strict=True):
            places = row | dict(zip(axes, along, strict=True))
            factor = array.at(tuple(places[axis] for axis in range(len(array.shape))))
            factors.append(graph.map(("convert", out.dtype), factor))
        return graph.map("add", found, graph.map("mul", *factors))

    def element(index):
        def term(number, found):
            if few is not None:
                of, places = few
                row = rows(index)[of]
                number = number_of(
                    graph, Entries(graph, constants(places), INDEX).at((*(row[axis] for axis in sorted(row)), number))
                )
            return added(found, index, unravelled(number, inner))

        terms = count if few is None else few[1].shape[-1]
        return folded(graph, terms, constant(0, out.dtype), term, entries and are_known(index))

    # Short rows of short sums are computed where they are read: loops find known entries of innermost axes then.
    is_short = count <= PASSES and bool(out.shape) and out.shape[-1] <= LINE
    if entries or few is not None or math.prod(out.shape) <= SMALL or is_short:
        return made(graph, out.shape, out.dtype, element if entries else by_entry(element), entries=entries)
    return written(graph, out, lambda buffer: _in_tiles(graph, out, inner, added, buffer))


def _in_tiles(graph, out, inner, added, buffer):
    """Write products of arrays, several entries of a row at once: a sum waits for its terms, others go on meanwhile."""
    *outer, columns = out.shape
    zero = constant(0, out.dtype)

    def tile(row, begin, width):
        indices = [(*row, begin + number) for number in range(width)]
        sums = nested(
            graph,
            inner,
            [zero] * width,
            lambda along, *sums: [added(each, index, along) for each, index in zip(sums, indices, strict=True)],
        )
        for index, each in zip(indices, sums, strict=True):
            graph.do(Store(buffer, as_scalar(ravelled(index, out.shape)), each))
        return ()

    def line(row):
        whole, rest = divmod(columns, TILE)
        if whole:
            nested(graph, (whole,), (), lambda number: tile(row, number[0] * TILE, TILE))
        if rest:
            tile(row, columns - rest, rest)
        return ()

    nested(graph, tuple(outer), (), line)


def _few_nonzero(array, axes):
    """For each row of an array the places along axes of its entries that may be nonzero, (..., k); None for many."""
    if not has_entries(array):
        return None
    last = range(-len(axes), 0)
    may_be = np.moveaxis(_may_be_nonzero(array), axes, last)
    may_be = may_be.reshape(*may_be.shape[: may_be.ndim - len(axes)], -1)
    most = max(1, np.max(np.sum(may_be, axis=-1), initial=0))
    return np.argsort(~may_be, axis=-1, kind="stable")[..., :most] if most <= FEW else None


def _least(*places):
    """Of two operands that with the fewest entries in a row, and their places; None where all have many."""
    found = [(each.shape[-1], number) for number, each in enumerate(places) if each is not None]
    return (min(found)[1], places[min(found)[1]]) if found else None


def _may_be_nonzero(array):
    ids = array.scalars()
    zero = constant(0, array.dtype)
    return ids != zero
