"""What is computed of a pytree once, and kept while it lives."""

import weakref
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

Result = TypeVar("Result")


def kept_while_alive(function: Callable[[Any], Result]) -> Callable[[Any], Result]:
    """A function of a pytree; what it returns is kept for each one whose numbers cannot change."""
    results: dict[int, Result] = {}  # by identity, as comparing takes as long as computing

    @wraps(function)
    def kept(tree: Any) -> Result:
        if id(tree) in results:
            return results[id(tree)]
        result = function(tree)
        if all(map(_is_constant, jax.tree.leaves(tree))):
            results[id(tree)] = result
            weakref.finalize(tree, results.pop, id(tree))
        return result

    return kept


def _is_constant(leaf):
    return not isinstance(leaf, Tracer) and not (isinstance(leaf, np.ndarray) and leaf.flags.writeable)
