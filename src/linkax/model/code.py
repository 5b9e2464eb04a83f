"""Compare users' functions by their code and all that it reads.

JAX compares functions by identity. A function made anew, such as a `lambda` in a function that builds a mechanism,
is a new one to JAX, which compiles all programs again. Here two functions are equal where their code, their defaults,
and the values that they close over and read as globals are equal. JAX arrays that they close over are numbers, which
are taken out. A function that cannot be compared equals itself alone.
"""

import sys
import types
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from linkax.model.code_walk import Maker, Same, Undecided, Walk
from linkax.xla.descriptions import Undescribed, description


class Code:
    """A function without its numbers. Functions that compute the same from the same numbers have equal code."""

    function: Callable[..., Any]
    _key: Any
    _hash: int
    _made: Maker
    _arrays: list[weakref.ref | None]

    @staticmethod
    def of(function: Callable[..., Any]) -> "tuple[Code, tuple[jax.Array, ...]]":
        """Split a function into its code and its numbers.

        Numbers are JAX arrays; in pytrees such as `jax.tree_util.Partial` and `equinox.Module` they are NumPy arrays
        and floats too.
        """
        code, walk = Code(), Walk(())
        try:
            # Code that is reached may name further attributes of what is read; again, until there are none.
            while True:
                names, walk = walk.names, Walk(walk.names)
                key, code._made = walk.part(function, not isinstance(function, types.FunctionType))
                if walk.names == names:
                    break
        except (Undecided, RecursionError):
            walk, key, code._made = Walk(()), Same(function), lambda _: function
        code.function, code._key, code._hash = function, key, hash(key)
        code._arrays = [weakref.ref(array) if isinstance(array, jax.Array) else None for array in walk.numbers]
        # Copies of NumPy's arrays, as the caller may change them.
        return code, tuple(array if isinstance(array, jax.Array) else jnp.array(array) for array in walk.numbers)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Code) and self._hash == other._hash and self._key == other._key)

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> tuple:
        return _code_of, (self.function,)

    def with_numbers(self, numbers: Sequence[Any]) -> Callable[..., Any]:
        """Return the function with these numbers in place of its own."""
        return self._made(iter(numbers)) if self._arrays else self.function

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of variables that the function closes over and of globals and attributes that it reads."""
        code = getattr(self.function, "__code__", None)
        return () if code is None else (*code.co_freevars, *code.co_names)

    def has_changed(self) -> bool:
        """Tell whether what the function reads has changed, as far as that can be found out."""
        if isinstance(self._key, Same):
            return False
        now, numbers = Code.of(self.function)
        held = zip(self._arrays, numbers, strict=False)
        return now != self or any(ref is not None and ref() is not number for ref, number in held)


@description.register
def _(code: Code) -> Any:
    return "code of a function", description(code._key)


@description.register
def _(same: Same) -> Any:
    value = same.value
    if not isinstance(value, dict):
        return description(value)
    module = sys.modules.get(value.get("__name__", ""))
    if module is None or vars(module) is not value:
        raise Undescribed(same)
    return "globals", module.__name__  # of which what the function reads is described apart


def _code_of(function: Callable[..., Any]) -> Code:
    return Code.of(function)[0]
