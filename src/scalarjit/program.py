"""The decorator: a function as a program of its own, compiled by LLVM once for each kind of arguments."""

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax.core import Tracer, eval_context

from scalarjit.flat import Flat
from scalarjit.garbage import collected_later
from scalarjit.kept_programs import KeptProgram, are_kept, kept_program
from scalarjit.known import known_of
from scalarjit.transform import compiled_by_llvm

Output = TypeVar("Output")


class Scalarised(Generic[Output]):
    """A function of pytrees, compiled by LLVM.

    It computes what `jax.jit(function)` does, under JAX's transformations too. Leaves that are no arrays are static.
    What it consists of is unrolled where that is short: constants fold, entries that are zero cost nothing, and equal
    ones are computed once. What `with_known_entries` knows of an argument is taken for granted.
    """

    def __init__(self, function: Callable[..., Output]) -> None:
        update_wrapper(self, function)
        self._function = function
        self._name = getattr(function, "__name__", type(function).__name__)
        self._compute, self._jitted = self._named(self._name)

    def _named(self, name):
        """The function of a flat argument, under a name that programs have, and the same as a program."""

        def flat(given):
            args, options = given.tree
            return Flat.of(self._function(*args, **options))

        flat.__name__ = flat.__qualname__ = name
        compute = compiled_by_llvm(flat, lambda given: known_of(given.tree))
        return compute, jax.jit(compute)

    def lower(self, *args: Any) -> Any:
        """Trace the program, to compile it before it is called, as `jax.jit(...).lower` does."""
        given = Flat.of((args, {}))
        with collected_later():
            return self._kept(given) or self._jitted.lower(given)

    def blank_result(self, *args: Any) -> Output:
        """Zeros in place of what it returns: what the next program is traced with."""
        given = Flat.of((args, {}))
        if kept := self._kept(given):
            return kept.blank
        found = jax.eval_shape(self._compute, given)
        return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), found).tree

    def __call__(self, *args: Any, **options: Any) -> Output:
        """Compute it as a program of its own where all arguments are concrete, else within the one that is traced."""
        if _runs_operation_by_operation():
            return self._function(*args, **options)
        given = Flat.of((args, options))
        if any(isinstance(array, Tracer) for array in given.arrays):
            with collected_later():
                return self._compute(given).tree
        # Not `jax.ensure_compile_time_eval`: with it JAX compiles each operation on constants by itself.
        with eval_context(), collected_later():
            kept = self._kept(given)
            return (kept.compile() if kept else self._jitted)(given).tree

    def _kept(self, given) -> KeptProgram | None:
        """The program on disk, if programs are kept there."""
        if not are_kept():
            return None
        lower = lambda given, place: self._named(f"{self._name}_{place}")[1].lower(given)
        return kept_program(f"{self.__module__}.{self._name}", given, lower)


def _runs_operation_by_operation() -> bool:
    """Whether JAX compiles nothing, as for debugging."""
    config: Any = jax.config
    return config.jax_disable_jit


def scalarised(function: Callable[..., Output]) -> Scalarised[Output]:
    """Decorate a function of pytrees: compile it by LLVM, see `Scalarised`."""
    return Scalarised(function)
