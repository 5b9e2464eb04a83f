"""Arrays by their entries: the indices of scalars in a `Graph`."""

from collections.abc import Callable
from typing import Any

import numpy as np

from linkax.straight_line.graph import Graph

Entries = np.ndarray  # of indices of scalars


class NotStraight(Exception):
    """An operation that has no straight line."""


def each(function: Callable[..., int], *arrays: Entries) -> Entries:
    """Apply a function of scalars to each entry of arrays of one shape, or of scalars beside them."""
    made: dict[tuple[int, ...], int] = {}
    if len({array.shape for array in arrays}) > 1:
        arrays = np.broadcast_arrays(*arrays)  # which takes its time
    found = np.empty(arrays[0].size, dtype=int)
    for place, operands in enumerate(zip(*(array.ravel().tolist() for array in arrays), strict=True)):
        entry = made.get(operands)
        if entry is None:
            entry = made[operands] = function(*operands)
        found[place] = entry
    return found.reshape(arrays[0].shape)


def known_entries(graph: Graph, array: Any) -> Entries:
    """The entries of an array that is known."""
    array = np.asarray(array)
    entries = [graph.known(value, array.dtype) for value in array.ravel()]
    return np.array(entries, dtype=int).reshape(array.shape)


def values_of(graph: Graph, entries: Entries) -> np.ndarray:
    """The values of entries that have to be known."""
    values = [graph.values[index] for index in entries.ravel().tolist()]
    if any(value is None for value in values):
        raise NotStraight
    return np.array(values).reshape(entries.shape)


def is_known(graph: Graph, entries: Entries) -> bool:
    """Whether all entries are known."""
    return all(graph.values[index] is not None for index in entries.ravel().tolist())


def where(graph: Graph, condition: int, true: Entries, false: Entries) -> Entries:
    """Select whole arrays by a scalar."""
    return each(lambda t, f: graph.select(condition, f, t), true, false)
