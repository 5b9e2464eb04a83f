"""Entries of arguments that a program takes for granted: zeros, and in matrices ones and minus ones, as of axes.

Other values are left to the arrays, so that a program serves for all that have these in the same places. A length that
is one by chance stays a number like others.
"""

from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from scalarjit.alive import kept_while_alive
from scalarjit.flat import Flat, is_array

Tree = TypeVar("Tree")


@dataclass(frozen=True)
class Pattern:
    """The known entries of an array, NaN for the others; as bytes, which are compared quickly."""

    shape: tuple[int, ...]
    text: bytes

    @property
    def values(self) -> np.ndarray:
        return np.frombuffer(self.text).reshape(self.shape)


@kept_while_alive
def with_known_entries(tree: Tree) -> Flat[Tree]:
    """A tree whose zeros, where they are not traced, are taken for granted by programs of which it is an argument."""
    return Flat.of(tree, _patterns([*filter(is_array, jax.tree.leaves(tree))]))


def known_of(given: Any) -> list[Pattern | None]:
    """Of each array of a pytree what is known, or None."""
    found = []
    for node in jax.tree.leaves(given, is_leaf=lambda node: isinstance(node, Flat)):
        count = sum(map(is_array, jax.tree.leaves(node)))
        found += node.noted if isinstance(node, Flat) and node.noted is not None else [None] * count
    return found


def _patterns(arrays) -> tuple[Pattern | None, ...]:
    """Of each array; all at once, as a call of NumPy takes longer than their few numbers."""
    read = [
        (place, np.asarray(array))
        for place, array in enumerate(arrays)
        if not isinstance(array, Tracer) and array.ndim > 0 and array.dtype.kind == "f"
    ]
    ends = np.cumsum([0, *(array.size for _, array in read)])
    is_matrix = np.repeat([array.ndim > 1 for _, array in read], np.diff(ends)).astype(bool)
    numbers = np.concatenate([np.zeros(0), *(array.ravel() for _, array in read)])
    known = (numbers == 0.0) | (is_matrix & (np.abs(numbers) == 1.0))
    values = np.where(known, numbers + 0.0, np.nan)  # a zero with a sign is a zero
    found: list[Pattern | None] = [None] * len(arrays)
    for (place, array), first, last in zip(read, ends, ends[1:], strict=False):
        if known[first:last].any():
            found[place] = Pattern(array.shape, values[first:last].tobytes())
    return tuple(found)
