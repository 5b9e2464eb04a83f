"""Places that may be found as the program runs."""

import math
from functools import partial
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode

from scalarjit.arrays import (
    MANY,
    Array,
    Entries,
    Number,
    Updated,
    are_known,
    by_entry,
    chosen,
    chosen_scalars,
    every,
    numbers_of,
    ravelled,
    unravelled,
)
from scalarjit.graph import INDEX, Index, Store, as_scalar, constant, number_of
from scalarjit.rules.moves import sliced
from scalarjit.rules.rule import has_entries, made, rule, written


def _starts(graph, arrays, sizes, shape):
    """Where a window begins: JAX moves one that would reach beyond the array."""
    found = []
    for array, size, whole in zip(arrays, sizes, shape, strict=True):
        scalar = graph.op(("convert", INDEX), int(array.at(())))
        scalar = graph.op("max", graph.op("min", scalar, constant(whole - size)), constant(0))
        found.append(number_of(graph, scalar))
    return tuple(found)


@rule("dynamic_slice")
def _dynamic_slice(graph, name, out, arrays, *, slice_sizes, **params):
    array, *starts = arrays
    begin = _starts(graph, starts, slice_sizes, array.shape)
    if are_known(begin):
        limits = [start + size for start, size in zip(begin, slice_sizes, strict=True)]
        return sliced(graph, name, out, [array], start_indices=begin, limit_indices=limits, strides=None)
    array = array.stored() if isinstance(array, Entries) else array
    element = by_entry(
        lambda index: array.at(tuple(start + number for start, number in zip(begin, index, strict=True)))
    )
    return made(graph, out.shape, out.dtype, element, is_steady=array.is_steady)


@rule("dynamic_update_slice")
def _dynamic_update_slice(graph, name, out, arrays):
    array, window, *starts = arrays
    begin = _starts(graph, starts, window.shape, array.shape)
    return _updated(array, begin, window)


def _updated(array, begin, window) -> Array:
    if are_known(begin) and has_entries(array) and window.size <= MANY:
        ids = array.scalars().copy()
        ids[tuple(slice(start, start + size) for start, size in zip(begin, window.shape, strict=True))] = (
            window.scalars()
        )
        return Entries(array.graph, ids, array.dtype)
    return Updated(array, begin, window)


@rule("gather")
def _gather(graph, name, out, arrays, *, dimension_numbers, slice_sizes, mode, fill_value, **params):
    array, indices = arrays
    numbers = dimension_numbers
    rank = len(out.shape)
    of_batch = [axis for axis in range(rank) if axis not in numbers.offset_dims]
    hidden = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    window = [axis for axis in range(len(array.shape)) if axis not in hidden]
    fills = mode == GatherScatterMode.FILL_OR_DROP
    filler = _filler(fill_value, out.dtype) if fills else None
    is_known = bool(np.all(indices.scalars() < 0)) if indices.size <= MANY else False
    if not is_known and isinstance(array, Entries) and array.size > 1:
        array = array.stored()
    # Each place is looked up, also those that are filled: products may not be computed for them again.
    array = array.steady()

    def element(index):
        batch = tuple(index[axis] for axis in of_batch)
        places: list[Number] = [0] * len(array.shape)
        for axis, of_indices in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            places[axis] = batch[of_indices]
        for axis, of_out in zip(window, numbers.offset_dims, strict=True):
            places[axis] = index[of_out]
        inside: Any = True
        for number, axis in enumerate(numbers.start_index_map):
            start = numbers_of(graph, indices.at((*batch, number)))
            most = array.shape[axis] - slice_sizes[axis]
            if fills:
                within = (start >= 0) & (start <= most)
                inside = within if inside is True else inside & within
                start = chosen(graph, within, start, 0)
            else:
                start = _clipped(graph, start, most)
            places[axis] = places[axis] + start
        if not fills:
            return array.at(tuple(places))
        return chosen_scalars(graph, inside, lambda: array.at(tuple(places)), lambda: filler)

    entries = is_known and has_entries(array) and math.prod(out.shape) <= MANY
    return made(
        graph,
        out.shape,
        out.dtype,
        element if is_known and entries else by_entry(element),
        entries=entries,
        is_steady=indices.is_steady,
    )


def _clipped(graph, number, most):
    if isinstance(number, Index):
        return number_of(graph, graph.op("max", graph.op("min", number.scalar, constant(most)), constant(0)))
    return np.clip(number, 0, most)


def _filler(value, dtype):
    if value is not None:
        return constant(value, dtype)
    if dtype.kind == "f":
        return constant(np.nan, dtype)
    if dtype.kind == "b":
        return constant(True, dtype)
    return constant(np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max, dtype)


@rule(
    "scatter",
    "scatter-add",
    "scatter_add",
    "scatter-mul",
    "scatter_mul",
    "scatter-min",
    "scatter_min",
    "scatter-max",
    "scatter_max",
)
def _scatter(graph, name, out, arrays, *, dimension_numbers, mode, **params):
    array, indices, updates = arrays
    numbers = dimension_numbers
    how = name[8:]
    combine = (lambda old, new: new) if not how else partial(graph.map, how)
    of_batch = [axis for axis in range(len(updates.shape)) if axis not in numbers.update_window_dims]
    hidden = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
    window = [axis for axis in range(len(array.shape)) if axis not in hidden]
    sizes = [1] * len(array.shape)
    for axis, of_updates in zip(window, numbers.update_window_dims, strict=True):
        sizes[axis] = updates.shape[of_updates]
    drops = mode != GatherScatterMode.CLIP

    def begin(batch):
        """Where the window of an update begins, and whether it lies inside."""
        places: list[Number] = [0] * len(array.shape)
        inside: Any = True
        for axis, of_indices in zip(numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True):
            places[axis] = batch[of_indices]
        for number, axis in enumerate(numbers.scatter_dims_to_operand_dims):
            start = numbers_of(graph, indices.at((*batch, number)))
            most = array.shape[axis] - sizes[axis]
            if drops:
                within = (start >= 0) & (start <= most)
                inside = within if inside is True else inside & within
            places[axis] = _clipped(graph, start, most)
        return tuple(places), inside

    def of_update(batch, inner):
        """An index of the updates, from those of a window and along the others."""
        along = dict(zip(of_batch, batch, strict=True))
        along |= {of_updates: inner[axis] for axis, of_updates in zip(window, numbers.update_window_dims, strict=True)}
        return tuple(along[axis] for axis in range(len(updates.shape)))

    batch_shape = [updates.shape[axis] for axis in of_batch]
    is_known = indices.size <= MANY and bool(np.all(indices.scalars() < 0))
    if is_known and has_entries(array) and updates.size <= MANY:
        ids = array.scalars().copy()
        for batch in np.ndindex(*batch_shape):
            start, inside = begin(batch)
            if inside:
                inner = every(tuple(sizes))
                place = tuple(number + part for number, part in zip(start, inner, strict=True))
                ids[place] = combine(ids[place], updates.at(of_update(batch, inner)))
        return Entries(graph, ids, out.dtype)
    if math.prod(batch_shape) == 1:
        batch = (0,) * len(batch_shape)
        start, inside = begin(batch)

        def element(inner):
            new = updates.at(of_update(batch, inner))
            if not how and inside is True:
                return new
            old = array.at(tuple(number + part for number, part in zip(start, inner, strict=True)))
            return chosen_scalars(graph, inside, lambda: combine(old, new), lambda: old)

        return _updated(array, start, made(graph, tuple(sizes), out.dtype, by_entry(element)))
    updates = updates.steady()

    def write(buffer):
        array.write(buffer)

        def one(scalar):
            index = unravelled(number_of(graph, scalar), updates.shape)
            batch = tuple(index[axis] for axis in of_batch)
            start, inside = begin(batch)
            inner: list[Number] = [0] * len(array.shape)
            for axis, of_updates in zip(window, numbers.update_window_dims, strict=True):
                inner[axis] = index[of_updates]
            place = as_scalar(ravelled(tuple(a + b for a, b in zip(start, inner, strict=True)), array.shape))
            # Memory that changes: no load of before may serve.
            old = graph.new(("load", buffer), (place,), buffer.dtype)
            new = combine(old, updates.at(index))
            graph.do(Store(buffer, place, chosen_scalars(graph, inside, lambda: new, lambda: old)))
            return ()

        graph.loop(updates.size, (), one)

    return written(graph, out, write)
