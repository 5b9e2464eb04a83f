"""What is computed of a pytree once, and kept while it lives."""

import weakref
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

Result = TypeVar("Result")


def is_constant(leaf: Any) -> bool:
    """Whether this is neither traced by JAX nor an array of NumPy's that can be written to."""
    return not isinstance(leaf, Tracer) and not (isinstance(leaf, np.ndarray) and leaf.flags.writeable)


def kept_while_alive(
    function: Callable[[Any], Result] | None = None, *, if_all: Callable[[Any], bool] = is_constant
) -> Any:
    """A function of a pytree, of which each result is kept while the tree lives; a decorator.

    **Arguments:** `if_all`: of what is not kept, some leaf makes this false.
    """
    if function is None:
        return partial(kept_while_alive, if_all=if_all)
    results: dict[int, Result] = {}  # by identity, as comparing takes as long as computing

    @wraps(function)
    def kept(tree: Any) -> Result:
        if id(tree) in results:
            return results[id(tree)]
        result = function(tree)
        if all(map(if_all, jax.tree.leaves(tree))):
            results[id(tree)] = result
            weakref.finalize(tree, results.pop, id(tree))
        return result

    return kept
