"""Rules for what reads and writes arrays at indices; one that is not known selects from all that it can be."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from linkax.straight_line.entries import Entries, NotStraight, each, is_known, values_of, where
from linkax.straight_line.graph import Graph

MOST_CHOICES = 64  # from which an index that is not known selects


class _Axes(NamedTuple):
    """How windows lie in an array, as in XLA's gather and scatter.

    - `window`: size along each axis. `start_map`: the axis of each component of an index.
    - `collapsed`, `batching`: axes that the window lacks; `index_batching`: those of indices that go with the latter.
    - `offset_axes`: axes along windows of what is read or written. `clip`: whether windows outside are moved inside.
    """

    shape: tuple[int, ...]
    window: Sequence[int]
    start_map: Sequence[int]
    collapsed: Sequence[int]
    batching: Sequence[int]
    index_batching: Sequence[int]
    offset_axes: Sequence[int]
    clip: bool


def _places(indices, axes):
    """Flat places in an array that windows at known indices read or write, −1 for those outside."""
    shape, window, start_map, collapsed, batching, index_batching, offset_axes, clip = axes
    batch = indices.shape[:-1]
    offsets = [axis for axis in range(len(shape)) if axis not in collapsed and axis not in batching]
    inside = [window[axis] for axis in offsets]
    place, valid = np.zeros((*batch, *inside), dtype=int), np.ones((*batch, *inside), dtype=bool)
    along = lambda array: array.reshape(array.shape + (1,) * len(inside))
    for axis, size in enumerate(shape):
        at = np.zeros((*batch, *inside), dtype=int)
        if axis in start_map:
            start = indices[..., list(start_map).index(axis)]
            start = np.clip(start, 0, size - window[axis]) if clip else start
            at = at + along(start)
        if axis in batching:
            of = index_batching[list(batching).index(axis)]
            spread = [1] * (len(batch) + len(inside))
            spread[of] = batch[of]
            at = at + np.arange(size).reshape(spread)
        if axis in offsets:
            spread = [1] * (len(batch) + len(inside))
            spread[len(batch) + offsets.index(axis)] = window[axis]
            at = at + np.arange(window[axis]).reshape(spread)
        valid = valid & (at >= 0) & (at < size)
        place = place * size + at
    if not clip:
        # XLA leaves out a window of which a part is outside.
        inner = tuple(range(len(batch), place.ndim))
        valid = np.broadcast_to(np.all(valid, axis=inner, keepdims=True), valid.shape)
    place = np.where(valid, place, -1)
    return np.moveaxis(place, range(len(batch), place.ndim), offset_axes) if inside else place


def gather(graph: Graph, params, arrays, results) -> list[Entries]:
    """Rule for reading windows."""
    array, indices = arrays
    numbers, dtype = params["dimension_numbers"], results[0].dtype
    clip, fill = "FILL" not in str(params["mode"]), params["fill_value"]
    axes = _Axes(
        array.shape,
        params["slice_sizes"],
        numbers.start_index_map,
        numbers.collapsed_slice_dims,
        numbers.operand_batching_dims,
        numbers.start_indices_batching_dims,
        numbers.offset_dims,
        clip,
    )
    if fill is None:
        fill = np.nan if dtype.kind == "f" else True if dtype.kind == "b" else np.iinfo(dtype).min
    flat = np.append(array.ravel(), 0 if clip else graph.known(fill, dtype))
    # What is read at the first of all places is left where no other one is chosen, but for what fills.
    found = None if clip else np.full(results[0].shape, flat[-1], dtype=int)
    for known, condition in _choices(graph, indices, axes):
        entries = np.asarray(flat[_places(known, axes)])
        if condition is None or found is None:
            found = entries
            continue
        found = each(graph.select, _along_windows(condition, entries.shape, axes), found, entries)
    assert found is not None
    return [found]


def _choices(graph, indices, axes):
    """Known indices; where one component is not known, all that it can be, with what selects each.

    **Yields:** indices, and for each window the index of a scalar that is true for them; None for all.
    """
    rows = indices.reshape(math.prod(indices.shape[:-1]), indices.shape[-1])
    unknown = [c for c in range(rows.shape[1]) if not is_known(graph, rows[:, c])]
    if not unknown:
        yield values_of(graph, indices), None
        return
    (component, *more), axis = unknown, axes.start_map[unknown[0]]
    last = axes.shape[axis] - axes.window[axis]
    if more or last >= MOST_CHOICES:
        raise NotStraight
    for choice in range(last + 1):
        known = np.zeros(indices.shape, dtype=int)
        for c in range(rows.shape[1]):
            known[..., c] = choice if c == component else values_of(graph, indices[..., c])
        yield known, each(lambda index, at=choice: _is_at(graph, index, at, last, axes.clip), indices[..., component])


def _is_at(graph, index, place, last, clip=True):
    """Whether an index that is not known is at a place from 0 to `last`, or clipped to it."""
    dtype = graph.dtypes[index]
    if clip and last == 0:
        return graph.known(True, np.dtype(bool))
    name = "le" if clip and place == 0 else "ge" if clip and place == last else "eq"
    return graph.compare(name, index, graph.known(place, dtype))


def scatter(combine: Callable[[Graph, int, int], int]) -> Callable[..., list[Entries]]:
    """Rule for writing windows; `combine`: (graph, what is there, what is written) ↦ what is there then."""

    def rule(graph, params, arrays, results):
        array, indices, updates = arrays
        numbers = params["dimension_numbers"]
        without = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        sizes = iter(updates.shape[axis] for axis in numbers.update_window_dims)
        axes = _Axes(
            array.shape,
            [1 if axis in without else next(sizes) for axis in range(array.ndim)],
            numbers.scatter_dims_to_operand_dims,
            numbers.inserted_window_dims,
            numbers.operand_batching_dims,
            numbers.scatter_indices_batching_dims,
            numbers.update_window_dims,
            "CLIP" in str(params["mode"]),
        )
        found, entries = array.ravel().tolist(), updates.ravel().tolist()
        for known, condition in _choices(graph, indices, axes):
            if condition is None:
                conditions = itertools.repeat(graph.known(True, np.dtype(bool)), len(entries))
            else:
                conditions = _along_windows(condition, updates.shape, axes).ravel().tolist()
            for place, entry, is_it in zip(_places(known, axes).ravel().tolist(), entries, conditions, strict=True):
                if place >= 0:
                    found[place] = graph.select(is_it, found[place], combine(graph, found[place], entry))
        return [np.array(found, dtype=int).reshape(array.shape)]

    return rule


def _along_windows(condition, shape, axes):
    """What selects each window, for each of its entries."""
    spread = [1 if axis in axes.offset_axes else size for axis, size in enumerate(shape)]
    return np.broadcast_to(condition.reshape(spread), shape)


def _starts(graph, starts, shape, window):
    """Known starts of a slice; where some are not known, all that they can be, with what selects them."""
    each_axis = []
    for start, size, length in zip(starts, shape, window, strict=True):
        index, last = start.item(), size - length
        value = graph.values[index]
        if value is not None:
            each_axis.append([(min(max(int(value), 0), last), None)])
            continue
        if last >= MOST_CHOICES:
            raise NotStraight
        choices = [(at, None if last == 0 else _is_at(graph, index, at, last)) for at in range(last + 1)]
        each_axis.append(choices)
    chosen = []
    for combination in itertools.product(*each_axis):
        conditions = [condition for _, condition in combination if condition is not None]
        chosen.append(([at for at, _ in combination], graph.reduce(graph.logical_and, conditions)))
    return chosen


def dynamic_slice(graph: Graph, params, arrays, results) -> list[Entries]:
    """Rule for reading a slice."""
    array, *starts = arrays
    window = params["slice_sizes"]
    found: Any = None
    for at, condition in _starts(graph, starts, array.shape, window):
        part = array[tuple(slice(first, first + length) for first, length in zip(at, window, strict=True))]
        found = part if found is None or condition is None else where(graph, condition, part, found)
    return [found]


def dynamic_update_slice(graph: Graph, params, arrays, results) -> list[Entries]:
    """Rule for writing a slice."""
    array, update, *starts = arrays
    found = array
    for at, condition in _starts(graph, starts, array.shape, update.shape):
        window = tuple(slice(first, first + length) for first, length in zip(at, update.shape, strict=True))
        written = found.copy()
        written[window] = update if condition is None else where(graph, condition, update, found[window])
        found = written
    return [found]
