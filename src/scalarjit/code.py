"""Compare users' functions by their code and all that it reads.

JAX compares functions by identity. A function made anew, such as a `lambda` in a function that builds a mechanism,
is a new one to JAX, which compiles all programs again. Here two functions are equal where their code, their defaults,
and the values that they close over and read as globals are equal. JAX arrays that they close over are numbers, which
are taken out. One that reads what cannot be compared is refused: that it has changed would not be seen.
"""

import functools
import sys
import types
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from scalarjit.code_walk import Key, Maker, NotComparable, NotMadeAgain, Same, Walk, is_library
from scalarjit.descriptions import Undescribed, description

Tree = TypeVar("Tree")


class Code(Key):
    """A function without its numbers. Functions that compute the same from the same numbers have equal code."""

    function: Any
    variables: tuple[str, ...]
    _names: tuple[str, ...]
    _key: Any
    _hash: int
    _made: Maker
    _arrays: list[weakref.ref | None]

    @staticmethod
    def of(function: Any, names: Iterable[str] = ()) -> "tuple[Code, tuple[jax.Array, ...]]":
        """Split a function into its code and its numbers.

        Numbers are JAX arrays; in pytrees such as `jax.tree_util.Partial` and `equinox.Module` they are NumPy arrays
        and floats too.

        **Arguments:** `names`: of attributes that are read, besides those that code names.

        **Raises:** `NotComparable`, a `ValueError`, where it reads what cannot be compared.
        """
        code, numbers, keeping = Code._walked(function, names)
        for kept in keeping:
            _renew(kept)
        # Copies of NumPy's arrays, as the caller may change them.
        return code, tuple(array if isinstance(array, jax.Array) else jnp.array(array) for array in numbers)

    @staticmethod
    def _walked(function, names, has_numbers=True):
        code, walk = Code(), Walk(names)
        code.function, code._names = function, tuple(names)
        try:
            # Code that is reached may name further attributes of what is read; again, until there are none.
            while True:
                known, walk = walk.names, Walk(walk.names)
                try:
                    if not has_numbers:
                        raise NotMadeAgain
                    code._key, code._made = walk.part(function, not isinstance(function, types.FunctionType))
                except NotMadeAgain:  # with its numbers in the key
                    walk = Walk(known)
                    code._key, code._made = walk.key(function), lambda _: function
                if walk.names == known:
                    break
        except RecursionError as error:
            raise NotComparable("values nested too deeply") from error
        code.variables, code._hash = tuple(walk.variables), hash(code._key)
        code._arrays = [weakref.ref(array) if isinstance(array, jax.Array) else None for array in walk.numbers]
        return code, walk.numbers, walk.keeping

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Code) and self._hash == other._hash and self._key == other._key)

    def __hash__(self) -> int:
        return self._hash

    def __reduce__(self) -> tuple:
        return _code_of, (self.function, self._names)

    def with_numbers(self, numbers: Sequence[Any]) -> Callable[..., Any]:
        """Return the function with these numbers in place of its own."""
        return self._made(iter(numbers)) if self._arrays else self.function

    def has_changed(self) -> bool:
        """Tell whether what the function reads has changed."""
        try:
            now, numbers, _ = Code._walked(self.function, self._names)
        except NotComparable:
            return True
        held = zip(self._arrays, numbers, strict=False)
        return now != self or any(ref is not None and ref() is not number for ref, number in held)


class ByValue:
    """A function compared by its code and by all that it reads, numbers included, where JAX compares by identity.

    One that reads what cannot be compared equals itself alone, and so is traced anew wherever this is made anew.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function, updated=())
        self._function = function
        try:
            self._code, _, keeping = Code._walked(function, (), has_numbers=False)
        except NotComparable:
            self._code, keeping = object(), []
        for kept in keeping:
            _renew(kept)

    @staticmethod
    def each(tree: Tree) -> Tree:
        """All functions among the leaves of a pytree as such; a function itself is a leaf."""
        is_function = lambda leaf: callable(leaf) and not isinstance(leaf, type)
        return jax.tree.map(lambda leaf: ByValue(leaf) if is_function(leaf) else leaf, tree)

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self._function(*args, **options)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByValue) and self._code == other._code

    def __hash__(self) -> int:
        return hash(self._code)

    def __reduce__(self) -> tuple:
        return ByValue, (self._function,)


_first: weakref.WeakKeyDictionary[Any, Code] = weakref.WeakKeyDictionary()


def _renew(keeping: Any) -> None:
    """Have caches be cleared that a function of `jax.jit` or `functools.cache` has, where what it reads has changed."""
    if keeping in _first and _first[keeping].has_changed():
        getattr(keeping, "cache_clear", jax.clear_caches)()
        del _first[keeping]
    if keeping not in _first:
        _first[keeping], *_ = Code._walked(keeping.__wrapped__, ())


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


def _code_of(function: Any, names: tuple[str, ...]) -> Code:
    return Code.of(function, names)[0]


OwnClasses = tuple[tuple[str, Code], ...]  # classes of a user by their names, each with all that its methods read


def codes_of_classes(tree: Any) -> OwnClasses:
    """The code of a user's classes among the nodes of a pytree, by their names: all methods, and what is no leaf.

    **Raises:** `NotComparable`.
    """
    nodes: dict[type, list[Any]] = {}

    def visit(structure):
        node = structure.node_data()
        if node is not None and not is_library(node[0]):
            # Without numbers.
            nodes.setdefault(node[0], []).append(structure.unflatten([None] * structure.num_leaves))
        for child in structure.children():
            visit(child)

    visit(jax.tree.structure(tree))
    found = []
    for kind, of_kind in nodes.items():
        try:
            found.append((kind.__name__, Code.of(tuple(of_kind), _methods(kind))[0]))
        except NotComparable as error:
            raise NotComparable(error.why, (kind.__name__, *error.names)) from error
    return tuple(found)


def _methods(kind):
    of_user = [base for base in kind.__mro__ if not is_library(base)]
    return sorted({name for base in of_user for name in vars(base) if not name.startswith(("__", "_abc_"))})
