"""What JAX traces, and into which program.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked `jit_inline` JAX keeps what it has traced for each kind of arguments. XLA
compiles it in place, so that it runs as fast as without the mark.
"""

from collections.abc import Callable, Hashable
from functools import cache, lru_cache, update_wrapper
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer, eval_context
from jaxtyping import PyTree

from linkax.xla.flags import quickest_to_compile

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


class Program(Generic[Output]):
    """A function as a program of its own, which seldom runs more than once on the same kind of arguments.

    - `quick`: compiled in less than half of the time, and slower than `optimised`.
    """

    def __init__(self, function: Callable[..., Output]) -> None:
        update_wrapper(self, function)
        self.optimised = optimised = jit_inline(function)
        # XLA is asked for its options when the program runs.
        self.quick = cache(
            lambda: eqx.filter_jit(optimised, compiler_options=quickest_to_compile())  # pyright: ignore[reportCallIssue]
        )

    @property
    def lower(self) -> Callable[..., Any]:
        """Trace the quick program, to compile it before it is called, as `jax.jit(...).lower` does."""
        return self.quick().lower

    def __call__(self, *args: Any, **options: Any) -> Output:
        """Compute it as the quick program of concrete arguments, also while a transformation is tracing."""
        if all_concrete((args, options)):
            return evaluate_now(self.quick(), *args, **options)
        return self.optimised(*args, **options)


def blank_result(program: Any, *args: Any) -> PyTree:
    """Zeros in place of what a `Program`, or a function of `jit_inline`, returns: what the next is traced with."""
    inner = program.optimised if isinstance(program, Program) else program
    zeros = lambda leaf: np.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf
    return jax.tree.map(zeros, eqx.filter_eval_shape(inner, *args))


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
