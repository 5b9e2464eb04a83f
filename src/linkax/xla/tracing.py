"""What JAX traces, and into which program.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked `jit_inline` JAX keeps what it has traced for each kind of arguments. XLA
compiles it in place, so that it runs as fast as without the mark.
"""

from collections.abc import Callable
from functools import cache, partial, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import PyTree

from linkax.xla.flags import quickest_to_compile

Output = TypeVar("Output")

jit_inline = eqx.filter_jit


def concrete(number: Any) -> np.ndarray | None:
    """Return a number as a NumPy array, or None while a transformation traces it."""
    return None if isinstance(number, Tracer) else np.asarray(number)


def all_concrete(tree: PyTree) -> bool:
    """Whether no array in a tree is traced by a transformation."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def zeros_of(shapes: PyTree) -> PyTree:
    """Zeros in place of `jax.ShapeDtypeStruct`: arguments of a program that is to be compiled, and not to run."""
    zeros = lambda leaf: np.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf
    return jax.tree.map(zeros, shapes)


class Program:
    """A function as a program of its own: optimised, or for one run compiled in less than half of the time.

    - `traces`: how many kinds of arguments it has been traced for.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        @wraps(function)
        def traced(*args):
            self.traces += 1
            return function(*args)

        self.traces = 0
        self.optimised = jit_inline(traced)
        # XLA is asked for its options when the program runs.
        self._quick = cache(
            lambda: eqx.filter_jit(traced, compiler_options=quickest_to_compile())  # pyright: ignore[reportCallIssue]
        )

    def __call__(self, *args: Any) -> Any:
        """Compute it as the quick program where that can be."""
        return self.choose(True, *args)(*args)

    def choose(self, quick: bool, *args: Any) -> Callable[..., Any]:
        """Choose what to call with these arguments: the quick program for concrete ones only, if asked for.

        Inside of a transformation that one is compiled by itself all the same.
        """
        return partial(evaluate_now, self._quick()) if quick and all_concrete(args) else self.optimised


def quick_compile(function: Callable[..., Output]) -> Callable[..., Output]:
    """Decorate a function that seldom runs more than once on the same kind of arguments, see `Program`."""
    return wraps(function)(Program(function))


def evaluate_now(function: Callable[..., Output], *args: Any) -> Output:
    """Compute function(*args) of concrete arguments at once, also while a transformation is tracing."""
    # Not `jax.ensure_compile_time_eval`: with it JAX compiles each operation on constants by itself.
    with eval_context():
        return function(*args)
