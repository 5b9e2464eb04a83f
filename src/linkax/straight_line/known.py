"""Which entries of arrays are known when a program is compiled: zeros, in matrices ones and minus ones too, as of axes.

Other values are left to the arrays, so that a program serves for all that have these in the same places. A length that
is one by chance stays a number like others.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from linkax.straight_line.program import straighten
from linkax.xla.tracing import concrete

Tree = TypeVar("Tree")
Pattern = tuple[tuple[int, ...], bytes]  # shape, and the values that are known, NaN elsewhere, in double precision


@dataclass(frozen=True)
class KnownEntries:
    """For each array of a pytree its known entries, or None; the same for two trees that have the same ones."""

    patterns: tuple[Pattern | None, ...]

    @staticmethod
    def of(tree: Any) -> "KnownEntries":
        """Those of vectors and matrices of real numbers that no transformation traces."""
        return KnownEntries(tuple(_pattern(concrete(array)) for array in _arrays(tree)))

    def impose(self, tree: Tree) -> Tree:
        """The same pytree, of whose arrays these entries are constants of the program that is traced."""
        dynamic, static = eqx.partition(tree, eqx.is_array)
        arrays, structure = jax.tree.flatten(dynamic)
        found = [_imposed(array, pattern) for array, pattern in zip(arrays, self.patterns, strict=True)]
        return eqx.combine(jax.tree.unflatten(structure, found), static)

    def through(self, function: Callable[[Tree], Any], tree: Tree) -> "KnownEntries":
        """Those of the arrays that a function makes of a pytree with these."""
        dynamic, static = eqx.partition(tree, eqx.is_array)
        arrays, structure = jax.tree.flatten(dynamic)
        of = lambda *arrays: _arrays(function(eqx.combine(jax.tree.unflatten(structure, arrays), static)))
        program = straighten(jax.make_jaxpr(of)(*arrays), [_values(pattern) for pattern in self.patterns], None)
        graph = program.graph

        def known(entries):
            values = [graph.values[index] for index in entries.ravel().tolist()]
            is_real = all(graph.dtypes[index].kind == "f" for index in entries.ravel().tolist())
            numbers = [np.nan if value is None else float(value) for value in values] if is_real else None
            return None if numbers is None else _pattern(np.reshape(numbers, entries.shape), ones=True)

        return KnownEntries(tuple(known(entries) for entries in program.outputs))


def _arrays(tree):
    return jax.tree.leaves(eqx.filter(tree, eqx.is_array))


def _pattern(array, ones=None) -> Pattern | None:
    if array is None or array.ndim == 0 or array.dtype.kind != "f":
        return None
    ones = array.ndim > 1 if ones is None else ones
    known = (array == 0.0) | (ones & (np.abs(array) == 1.0))
    # A zero with a sign is a zero.
    return (array.shape, np.where(known, array + 0.0, np.nan).astype(float).tobytes()) if np.any(known) else None


def _values(pattern: Pattern | None) -> np.ndarray | None:
    return None if pattern is None else np.frombuffer(pattern[1]).reshape(pattern[0])


def _imposed(array, pattern):
    values = _values(pattern)
    if values is None:
        return array
    return jnp.where(np.isnan(values), array, np.nan_to_num(values).astype(array.dtype))
