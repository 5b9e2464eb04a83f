"""Functions of users, compared by what they compute: by their code and all that it reads.

JAX compares functions by identity. One that is made anew, such as a `lambda` in a function that builds a mechanism,
is another one to it, and all programs are compiled anew. Here two functions are the same where their code, defaults,
and the values that they close over and read as globals are; JAX arrays that they close over are numbers, taken out.
Where that cannot be decided, a function is the same as itself alone.
"""

import types
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from linkax.model.code_walk import Maker, Same, Undecided, Walk


class Code:
    """A function without its numbers; equal to that of another function that computes the same of the same numbers."""

    function: Callable[..., Any]
    _key: Any
    _hash: int
    _made: Maker
    _arrays: list[weakref.ref | None]

    @staticmethod
    def of(function: Callable[..., Any]) -> "tuple[Code, tuple[jax.Array, ...]]":
        """The code of a function, and its numbers.

        Numbers are JAX arrays, and in pytrees such as `jax.tree_util.Partial` and `equinox.Module` also
        NumPy's and floats.
        """
        code, walk = Code(), Walk(())
        try:
            # Again, until the attributes of what is read are looked up by the names in all code that is reached.
            while True:
                names, walk = walk.names, Walk(walk.names)
                key, code._made = walk.part(function, not isinstance(function, types.FunctionType))
                if walk.names == names:
                    break
        except (Undecided, RecursionError):
            walk, key, code._made = Walk(()), Same(function), lambda _: function
        code.function, code._key, code._hash = function, key, hash(key)
        code._arrays = [weakref.ref(array) if isinstance(array, jax.Array) else None for array in walk.numbers]
        # Of NumPy's arrays copies, as the caller's may change.
        return code, tuple(array if isinstance(array, jax.Array) else jnp.array(array) for array in walk.numbers)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Code) and self._hash == other._hash and self._key == other._key)

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> tuple:
        return _code_of, (self.function,)

    def with_numbers(self, numbers: Sequence[Any]) -> Callable[..., Any]:
        """The function, with these numbers in place of its own."""
        return self._made(iter(numbers)) if self._arrays else self.function

    @property
    def variables(self) -> tuple[str, ...]:
        """Names of what the function closes over, reads as globals, and of their attributes."""
        code = getattr(self.function, "__code__", None)
        return () if code is None else (*code.co_freevars, *code.co_names)

    def has_changed(self) -> bool:
        """Whether what the function reads is no longer what it was, as far as that can be told."""
        if isinstance(self._key, Same):
            return False
        now, numbers = Code.of(self.function)
        held = zip(self._arrays, numbers, strict=False)
        return now != self or any(ref is not None and ref() is not number for ref, number in held)


def _code_of(function: Callable[..., Any]) -> Code:
    return Code.of(function)[0]
