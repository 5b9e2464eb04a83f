"""What rules share: how they are found, and whether entries are computed one by one or in loops over memory."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from scalarjit.arrays import MANY, Array, Delayed, Entries, Stored, every
from scalarjit.graph import Buffer, Graph

SMALL = 16  # entries of an array that are always computed one by one
UNROLLED = 400  # operations of one primitive that are written one by one, where entries of its arrays are known
# The same where all that is known of them is in memory. A crane on beams starts in 26 s with it, in 40 with 400, and a
# row of 20 four-bars runs as fast; with 100 for both it takes 10 ms in place of 6, as zeros are known no longer.
UNROLLED_OF_MEMORY = 100

Rule = Callable[..., Any]
RULES: dict[str, Rule] = {}


class Unsupported(Exception):
    """A primitive that has no rule."""


def rule(*names: str) -> Callable[[Rule], Rule]:
    def keep(function):
        RULES.update({name: function for name in names})
        return function

    return keep


def has_entries(array: Array) -> bool:
    """Whether entries of an array are to be computed one by one: it is small, or some of them are constants."""
    if array.size <= SMALL:
        return True
    return array.size <= MANY and (
        isinstance(array, Entries) or (isinstance(array, Stored) and array.known is not None)
    )


def made(graph, shape, dtype, element, *, entries=False, is_steady=False) -> Array:
    """An array by its element: entry by entry where it is small, or where that is wanted."""
    if entries or math.prod(shape) <= SMALL:
        return Entries(graph, np.broadcast_to(element(every(shape)), shape), dtype)
    return Delayed(graph, shape, dtype, element, is_steady=is_steady)


def written(graph: Graph, out: Any, write: Callable[[Buffer], None]) -> Stored:
    """An array in memory that a function writes."""
    buffer = Buffer(np.dtype(out.dtype), math.prod(out.shape))
    write(buffer)
    return Stored(graph, out.shape, buffer)
