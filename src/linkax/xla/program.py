"""Functions as programs of their own, compiled once for each kind of arguments, and kept on disk if asked."""

from collections.abc import Callable
from functools import cache, partial, update_wrapper
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.stages import Lowered
from jaxtyping import PyTree

from linkax.xla.flags import quickest_to_compile
from linkax.xla.flat import Flat
from linkax.xla.kept_programs import KeptProgram, are_kept, kept_program
from linkax.xla.tracing import all_concrete, evaluate_now, jit_inline

Output = TypeVar("Output")


class Program(Generic[Output]):
    """A function as a program of its own.

    - `runs_often`: compiled to run fast. By default it is compiled in less than half of the time, and runs slower, as
      most programs run no more than once on the same kind of arguments.
    """

    def __init__(self, function: Callable[..., Output], *, runs_often: bool = False) -> None:
        update_wrapper(self, function)
        self._name, self._inline = function.__name__, jit_inline(function)
        # XLA is asked for its options when the program runs.
        self._options = cache(lambda: None if runs_often else quickest_to_compile())
        self._jitted = cache(
            lambda: eqx.filter_jit(self._inline, compiler_options=self._options())  # pyright: ignore[reportCallIssue]
        )

    @property
    def lower(self) -> Callable[..., Any]:
        """Trace the program, to compile it before it is called, as `jax.jit(...).lower` does."""
        return self._kept_or_lowered if are_kept() else self._jitted().lower

    def blank_result(self, *args: Any) -> PyTree:
        """Zeros in place of what it returns: what the next program is traced with."""
        if kept := self._kept(Flat.of((args, {}))):
            return kept.blank
        zeros = lambda leaf: np.zeros(leaf.shape, leaf.dtype) if isinstance(leaf, jax.ShapeDtypeStruct) else leaf
        return jax.tree.map(zeros, eqx.filter_eval_shape(self._inline, *args))

    def __call__(self, *args: Any, **options: Any) -> Output:
        """Compute it as a program of its own where all arguments are concrete, else within the one that is traced."""
        if not all_concrete((args, options)):
            return self._inline(*args, **options)
        return evaluate_now(self._of_concrete, *args, **options)

    def _of_concrete(self, *args, **options):
        if are_kept() and (kept := self._kept(given := Flat.of((args, options)))):
            return kept.compile()(given).tree
        return self._jitted()(*args, **options)

    def _kept_or_lowered(self, *args):
        return self._kept(Flat.of((args, {}))) or self._jitted().lower(*args)

    def _kept(self, given) -> KeptProgram | None:
        program = self.__module__, self._name, tuple((self._options() or {}).items())
        return kept_program(program, given, self._named) if are_kept() else None

    def _named(self, given, name) -> Lowered:
        """Trace it under another name."""

        def flat(given):
            args, options = given.tree
            return Flat.of(self._inline(*args, **options))

        flat.__name__ = f"{self._name}_{name}"
        return jax.jit(flat, compiler_options=self._options()).lower(given)


runs_often = partial(Program, runs_often=True)
