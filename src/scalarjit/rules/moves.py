"""The same entries in another order."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from scalarjit.arrays import (
    MANY,
    Array,
    Delayed,
    Entries,
    Number,
    Stored,
    by_entry,
    chosen,
    chosen_scalars,
    known_of,
    ravelled,
    unravelled,
)
from scalarjit.graph import as_scalar, constant, constants
from scalarjit.rules.rule import UNROLLED, has_entries, made, rule


def _moved(graph, out, array, place: Callable[[tuple[Number, ...]], tuple[Number, ...]]) -> Array:
    entries = has_entries(array) and math.prod(out.shape) <= MANY
    source = array if array.is_steady or out.shape == array.shape else array.steady()
    element = lambda index: source.at(place(index))
    return made(graph, out.shape, out.dtype, element, entries=entries, is_steady=source.is_steady)


@rule("reshape", "squeeze", "expand_dims")
def reshaped(graph, name, out, arrays, **params):
    (array,) = arrays
    if isinstance(array, Entries):
        return Entries(graph, array.ids.reshape(out.shape), out.dtype)
    if isinstance(array, Stored):
        known = None if array.known is None else array.known.reshape(out.shape)
        return Stored(graph, out.shape, array.buffer, known)
    same_sizes = [size for size in out.shape if size != 1] == [size for size in array.shape if size != 1]
    place = _past_unit_axes if same_sizes else _before_reshape
    return made(
        graph,
        out.shape,
        out.dtype,
        lambda index: array.at(place(index, out.shape, array.shape)),
        is_steady=array.is_steady,
        entries=has_entries(array),
    )


def _past_unit_axes(index, out, shape):
    left = (number for number, size in zip(index, out, strict=True) if size != 1)
    return tuple(next(left) if size != 1 else 0 for size in shape)


def _before_reshape(index, out, shape):
    """Numbers along innermost axes stay as they are where these axes do: entries that are known are found by them."""
    inner = 0
    while inner < min(len(out), len(shape)) and out[-1 - inner] == shape[-1 - inner]:
        inner += 1
    of_out = out[: len(out) - inner]
    of_shape = shape[: len(shape) - inner]
    outer = unravelled(ravelled(index[: len(of_out)], of_out), of_shape)
    return (*outer, *index[len(of_out) :])


@rule("transpose")
def _transpose(graph, name, out, arrays, *, permutation):
    if isinstance(arrays[0], Entries):
        return Entries(graph, arrays[0].ids.transpose(permutation), out.dtype)
    back = np.argsort(permutation)
    return _moved(graph, out, arrays[0], lambda index: tuple(index[axis] for axis in back))


@rule("broadcast_in_dim")
def _broadcast(graph, name, out, arrays, *, shape, broadcast_dimensions, **params):
    (array, *_) = arrays
    if math.prod(shape) == array.size:  # axes of length 1 alone are new; what is in memory stays there
        return reshaped(graph, name, out, arrays)
    if isinstance(array, Entries) and math.prod(shape) <= MANY:
        aligned = [1] * len(shape)
        for axis, size in zip(broadcast_dimensions, array.shape, strict=True):
            aligned[axis] = size
        order = np.argsort(broadcast_dimensions, kind="stable") if array.shape else ()
        return Entries(graph, np.broadcast_to(array.ids.transpose(order).reshape(aligned), shape), out.dtype)

    def place(index):
        return tuple(
            index[axis] if size != 1 else 0 for axis, size in zip(broadcast_dimensions, array.shape, strict=True)
        )

    return _moved(graph, out, array, place)


@rule("tile")
def _tile(graph, name, out, arrays, *, reps):
    (array,) = arrays
    if isinstance(array, Entries):
        return Entries(graph, np.tile(array.ids, reps), out.dtype)
    return _moved(
        graph, out, array, lambda index: tuple(number % size for number, size in zip(index, array.shape, strict=True))
    )


@rule("slice")
def sliced(graph, name, out, arrays, *, start_indices, limit_indices, strides):
    strides = strides or (1,) * len(start_indices)
    if isinstance(arrays[0], Entries):
        window = tuple(map(slice, start_indices, limit_indices, strides))
        return Entries(graph, arrays[0].ids[window], out.dtype)

    def place(index):
        return tuple(
            start + stride * number for start, stride, number in zip(start_indices, strides, index, strict=True)
        )

    return _moved(graph, out, arrays[0], place)


@rule("rev")
def _rev(graph, name, out, arrays, *, dimensions):
    if isinstance(arrays[0], Entries):
        return Entries(graph, np.flip(arrays[0].ids, dimensions), out.dtype)

    def place(index):
        return tuple(
            out.shape[axis] - 1 - number if axis in dimensions else number for axis, number in enumerate(index)
        )

    return _moved(graph, out, arrays[0], place)


@rule("concatenate")
def _concatenate(graph, name, out, arrays, *, dimension):
    others = sum(array.size for array in arrays if not has_entries(array))
    if math.prod(out.shape) <= MANY and others <= (UNROLLED if any(map(_mostly_constant, arrays)) else 0):
        return Entries(graph, np.concatenate([array.steady().scalars() for array in arrays], dimension), out.dtype)
    arrays = [array.steady() for array in arrays]  # each entry is chosen among entries of all
    begins = np.cumsum([0, *(array.shape[dimension] for array in arrays)])

    def element(index):
        number = index[dimension]
        found: Any = None
        for array, begin in reversed(list(zip(arrays, begins, strict=False))):
            if array.shape[dimension] == 0:
                continue
            own = lambda array=array, begin=begin: array.at(
                (
                    *index[:dimension],
                    chosen(graph, (number >= begin) & (number < begin + array.shape[dimension]), number - begin, 0),
                    *index[dimension + 1 :],
                )
            )
            later = found
            found = (
                own
                if later is None
                else partial(chosen_scalars, graph, number < begin + array.shape[dimension], own, later)
            )
        return found()

    return Delayed(graph, out.shape, out.dtype, element, is_steady=True)


@rule("stack")
def _stack(graph, name, out, arrays, *, axis):
    shape = (*out.shape[:axis], 1, *out.shape[axis + 1 :])
    row = jax.ShapeDtypeStruct(shape, out.dtype)
    return _concatenate(graph, name, out, [reshaped(graph, name, row, [array]) for array in arrays], dimension=axis)


@rule("unstack")
def _unstack(graph, name, out, arrays, *, axis):
    parts = [jax.ShapeDtypeStruct((*part.shape[:axis], 1, *part.shape[axis:]), part.dtype) for part in out]
    rows = _split(graph, name, parts, arrays, sizes=[1] * len(parts), axis=axis)
    return [reshaped(graph, name, part, [row]) for part, row in zip(out, rows, strict=True)]


@rule("split")
def _split(graph, name, out, arrays, *, sizes, axis):
    (array,) = arrays
    found = []
    begin = 0
    for part, size in zip(out, sizes, strict=True):
        limits = list(array.shape)
        starts = [0] * len(limits)
        starts[axis] = begin
        limits[axis] = begin = begin + size
        found.append(sliced(graph, name, part, arrays, start_indices=starts, limit_indices=limits, strides=None))
    return found


@rule("pad")
def _pad(graph, name, out, arrays, *, padding_config):
    array, value = arrays
    filler = value.at(())
    if array.size == 0:
        return made(
            graph, out.shape, out.dtype, lambda index: filler, is_steady=True, entries=math.prod(out.shape) <= MANY
        )
    if has_entries(array) and math.prod(out.shape) <= MANY:
        spaced = array.scalars()
        for axis, (_, _, between) in enumerate(padding_config):
            if between and spaced.shape[axis] > 1:
                places = np.arange(spaced.shape[axis]) * (between + 1)
                wider = np.full((*spaced.shape[:axis], places[-1] + 1, *spaced.shape[axis + 1 :]), filler)
                wider[(*[slice(None)] * axis, places)] = spaced
                spaced = wider
        for axis, (low, high, _) in enumerate(padding_config):
            spaced = spaced[(*[slice(None)] * axis, slice(max(-low, 0), spaced.shape[axis] - max(-high, 0)))]
        widths = [(max(low, 0), max(high, 0)) for low, high, _ in padding_config]
        return Entries(graph, np.pad(spaced, widths, constant_values=filler), out.dtype)
    array = array.steady()

    def element(index):
        inside: Any = True
        places = []
        for number, size, (low, _, between) in zip(index, array.shape, padding_config, strict=True):
            shifted = number - low
            place = shifted // (between + 1) if between else shifted
            within = (shifted >= 0) & (place < size)
            if between:
                rest = shifted - place * (between + 1)
                within = within & (rest <= 0)
            inside = within if inside is True else inside & within
            places.append(chosen(graph, within, place, 0))
        return chosen_scalars(graph, inside, lambda: array.at(tuple(places)), lambda: filler)

    return Delayed(graph, out.shape, out.dtype, element, is_steady=True)


@rule("empty", "empty2")
def _empty(graph, name, out, arrays, **params):
    zero = constant(0, out.dtype)
    if math.prod(out.shape) <= MANY:
        return Entries(graph, np.full(out.shape, zero), out.dtype)
    return Delayed(graph, out.shape, out.dtype, lambda index: zero, is_steady=True)


@rule("iota")
def _iota(graph, name, out, arrays, *, dimension, **params):
    size = out.shape[dimension]
    if math.prod(out.shape) <= MANY:
        line = constants(np.arange(size).astype(out.dtype))
        aligned = [size if axis == dimension else 1 for axis in range(len(out.shape))]
        return Entries(graph, np.broadcast_to(line.reshape(aligned), out.shape), out.dtype)
    element = by_entry(lambda index: graph.op(("convert", out.dtype), as_scalar(index[dimension])))
    return Delayed(graph, out.shape, out.dtype, element, is_steady=True)


def _mostly_constant(array):
    known = known_of(array)
    return known is not None and array.size > 1 and 2 * np.count_nonzero(known < 0) >= array.size
