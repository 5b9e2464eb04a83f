"""Which entries of arrays are known when a program is compiled: zeros, in matrices ones and minus ones too, as of axes.

Other values are left to the arrays, so that a program serves for all that have these in the same places. A length that
is one by chance stays a number like others. What is known of an array that a transformation traces, says who makes it
(`remember`): it is the same array only as long as nothing is computed with it.
"""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import numpy as np

from linkax.straight_line.program import Pattern, straighten
from linkax.xla.arrays import Array
from linkax.xla.flat import Flat
from linkax.xla.kept import kept_while_alive
from linkax.xla.tracing import concrete

MOST_KEPT = 256  # of what functions make of known entries


@dataclass(frozen=True)
class KnownEntries:
    """For each array of a pytree its known entries, or None; the same for two trees that have the same ones."""

    patterns: tuple[Pattern | None, ...]

    @staticmethod
    def of(tree: Any) -> "KnownEntries":
        """Those of vectors and matrices of real numbers that are not traced, or are remembered."""
        return KnownEntries(_patterns([known_values(array) for array in _arrays(tree)]))

    def through(self, function: Callable[..., Any], tree: Any, *details: Any) -> "KnownEntries":
        """Those of the arrays that `function(tree, *details)` makes of a pytree with these; kept for each function."""
        dynamic, static = eqx.partition(tree, eqx.is_array)
        arrays, structure = jax.tree.flatten(dynamic)
        fixed, of_fixed = jax.tree.flatten(static)
        shapes = tuple((array.shape, array.dtype) for array in arrays)
        return _through(function, details, structure, shapes, of_fixed, tuple(fixed), self)


@lru_cache(maxsize=MOST_KEPT)
def _through(function, details, structure, shapes, of_fixed, fixed, known):
    static = jax.tree.unflatten(of_fixed, fixed)

    def of(*arrays):
        return _arrays(function(eqx.combine(jax.tree.unflatten(structure, arrays), static), *details))

    traced = jax.make_jaxpr(of)(*(jax.ShapeDtypeStruct(*shape) for shape in shapes))
    program = straighten(traced, known.patterns, None)
    graph = program.graph

    def values(entries):
        indices = entries.ravel().tolist()
        if any(graph.dtypes[index].kind != "f" for index in indices):
            return None
        found = [np.nan if (value := graph.values[index]) is None else float(value) for index in indices]
        return np.reshape(found, entries.shape)

    return KnownEntries(_patterns([*map(values, program.outputs)], ones=True))


_remembered: dict[int, np.ndarray] = {}  # of traced arrays that are alive, by their identity


def remember(array: Array, values: np.ndarray) -> Array:
    """Note which entries of an array that may be traced are known, those that are not NaN in `values`; return it."""
    if concrete(array) is None and not np.all(np.isnan(values)):
        _remembered[id(array)] = np.broadcast_to(values, array.shape)
        weakref.finalize(array, _remembered.pop, id(array))
    return array


def known_values(array: Any) -> np.ndarray | None:
    """The values of an array, NaN where they are not known; None where none is."""
    known = concrete(array)
    return _remembered.get(id(array)) if known is None else known


@kept_while_alive
def flat_with_known(tree: Any) -> Flat:
    """A tree whose `noted` is what is known of its arrays."""
    return Flat.of(tree, KnownEntries.of(tree))


class KnowsEntries(eqx.Module):
    """A pytree of arrays, some entries of which straight lines may know: what `known` says, or none."""

    known: KnownEntries | None = eqx.field(static=True)


def patterns_of(tree: Any) -> list[Pattern | None]:
    """For each array of a pytree what a `KnowsEntries` in it knows, or None."""
    knows = lambda node: isinstance(node, KnowsEntries)
    found = []
    for node in jax.tree.leaves(tree, is_leaf=knows):
        count = len(_arrays(node))
        found += node.known.patterns if knows(node) and node.known is not None else [None] * count
    return found


def _arrays(tree):
    return [*filter(eqx.is_array, jax.tree.leaves(tree))]


def _patterns(arrays, ones=None) -> tuple[Pattern | None, ...]:
    """Of each array; all at once, as a call of NumPy takes longer than their few numbers."""
    read = [array for array in arrays if array is not None and array.ndim > 0 and array.dtype.kind == "f"]
    ends = np.cumsum([0, *(array.size for array in read)])
    may_be_one = np.repeat([array.ndim > 1 if ones is None else ones for array in read], np.diff(ends))
    numbers = np.concatenate([np.zeros(0), *map(np.ravel, read)])
    known = (numbers == 0.0) | (may_be_one.astype(bool) & (np.abs(numbers) == 1.0))
    # A zero with a sign is a zero.
    values, counts = np.where(known, numbers + 0.0, np.nan), np.cumsum(np.concatenate([[0], known]))[ends]
    found = {
        id(array): (array.shape, values[first:last].tobytes())
        for array, first, last, less, more in zip(read, ends, ends[1:], counts, counts[1:], strict=False)
        if more > less
    }
    return tuple(found.get(id(array)) for array in arrays)
