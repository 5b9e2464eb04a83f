"""What JAX traces, and into which program.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked `jit_inline` JAX keeps what it has traced for each kind of arguments. XLA
compiles it in place, so that it runs as fast as without the mark.
"""

from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer, eval_context
from jaxtyping import PyTree

Output = TypeVar("Output")

jit_inline = eqx.filter_jit
KINDS = 256  # of programs that are known to have been compiled


def concrete(number: Any) -> np.ndarray | None:
    """Return a number as a NumPy array, or None while a transformation traces it."""
    return None if isinstance(number, Tracer) else np.asarray(number)


def all_concrete(tree: PyTree) -> bool:
    """Whether no array in a tree is traced by a transformation."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def without_derivatives(tree: PyTree) -> PyTree:
    """The same numbers, constant for derivatives: concrete where they are differentiated outside of `jit`."""
    # Arrays again: JAX differentiates a number of Python's as one.
    return jax.tree.map(lambda leaf: jnp.asarray(lax.stop_gradient(leaf)) if isinstance(leaf, Tracer) else leaf, tree)


def is_first(*kind: Hashable) -> bool:
    """Whether this is the first call with these arguments."""
    came = _came(kind)
    first = not came
    came[:] = [True]
    return first


@lru_cache(maxsize=KINDS)
def _came(_kind):
    return []


def evaluate_now(function: Callable[..., Output], *args: Any, **options: Any) -> Output:
    """Compute function(*args) of concrete arguments at once, also while a transformation is tracing."""
    # Not `jax.ensure_compile_time_eval`: with it JAX compiles each operation on constants by itself.
    with eval_context():
        return function(*args, **options)
