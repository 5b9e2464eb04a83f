"""Walk through a function and all that it reads, to compare it and to make it again with other numbers."""

import abc
import builtins
import functools
import sys
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from dis import get_instructions
from enum import Enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linkax.xla.users_line import LIBRARIES

Maker = Callable[[Iterator[Any]], Any]  # makes a value again from an iterator of its numbers


class Undecided(Exception):
    """Raised where values cannot be compared."""


class Same:
    """A value that equals only itself."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(...), range)
# Compared by identity, as JAX does.
_OPAQUE = (np.ufunc, type(np.dot), jnp.ufunc, type(jax.jit(abs)), jax.custom_jvp, jax.custom_vjp, Enum)
_BASES = (object, abc.ABC, typing.Generic, typing.Protocol, types.SimpleNamespace)
# Functions that read by names which are in no code.
_DYNAMIC = {"getattr", "vars", "globals", "locals", "eval", "exec", "__import__", "import_module", "__dict__"}
_DYNAMIC |= {"attrgetter", "methodcaller", "asdict", "astuple", "fields", "copy", "deepcopy", "__getattribute__"}
_UNCALLED = {"__init__", "__new__", "__post_init__", "__init_subclass__", "__setattr__", "__repr__", "__str__"}
_UNCALLED |= {"__eq__", "__hash__"}
_MOST_PARTS = 10_000


def _is_library(value: Any) -> bool:
    """Tell whether a module, class or function is of Python, an installed package or linkax, which no user changes."""
    if isinstance(value, types.FunctionType):
        path = value.__code__.co_filename
    else:
        module = sys.modules.get(value.__module__) if isinstance(value, type) else value
        path = getattr(module, "__file__", None) or ""
        if getattr(module, "__name__", None) in sys.builtin_module_names:
            return True
    return path.startswith((*LIBRARIES, "<frozen"))


def _is_pytree(value: Any) -> bool:
    return not jax.tree_util.all_leaves([value])


def _all_code(code: types.CodeType) -> Iterator[types.CodeType]:
    """Go through code and the code of functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _all_code(constant)


@functools.lru_cache(maxsize=1024)
def _names(code: types.CodeType) -> tuple[set[str], set[str]]:
    """Find the names of globals and attributes in code, and of modules that it imports when it runs."""
    names, imported = set(), set()
    for part in _all_code(code):
        names.update(part.co_names)
        for at in get_instructions(part):
            assigns = at.opname.startswith(("STORE_", "DELETE_"))
            if assigns and (at.opname.endswith("_GLOBAL") or at.argval in part.co_freevars):
                raise Undecided  # it changes variables outside of itself
            if at.opname == "IMPORT_NAME":
                imported.add(at.argval)
    if names & _DYNAMIC:
        raise Undecided
    return names, imported


class Walk:
    """A walk through a function and all that it reads.

    Each part gives a key, which compares it, and a `Maker`.

    - `names`: names in all code met so far.
    - `numbers`: numbers met so far.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names, self.numbers = set(names), []
        self._attributes, self._around, self._count, self._is_traced = frozenset(names), [], 0, True

    def part(self, value: Any, is_explicit: bool = False) -> tuple[Any, Maker]:
        """Find the key and the maker of a value.

        Where `is_explicit`, its floats and NumPy arrays are numbers too, and parts of it that cannot be compared are
        compared by identity, as JAX does.
        """
        self._count += 1
        if self._count > _MOST_PARTS:
            raise Undecided
        is_number = isinstance(value, jax.Array) or (is_explicit and isinstance(value, float | np.ndarray | np.generic))
        if is_number and self._is_traced:
            self.numbers.append(value)
            return "number", next
        if (key := self._atom(value)) is not None:
            return key, lambda _: value
        for place, around in enumerate(self._around):
            if around is value:
                if self._is_traced:
                    raise Undecided  # made again it would hold itself
                return ("again", place), lambda _: value
        self._around.append(value)
        numbers, around = len(self.numbers), len(self._around)
        try:
            return self._compound(value, is_explicit)
        except Undecided:
            if not is_explicit or around == 1:
                raise
            del self.numbers[numbers:], self._around[around:]
            self._is_traced = True
            return Same(value), lambda _: value
        finally:
            self._around.pop()

    def key(self, value: Any) -> Any:
        """Find the key of a value that is read and not made again, so that its arrays are no numbers."""
        traced, self._is_traced = self._is_traced, False
        key, _ = self.part(value)
        self._is_traced = traced
        return key

    def _atom(self, value: Any) -> Any:
        if type(value) in _ATOMS or isinstance(value, np.dtype):
            return type(value), repr(value)  # tells 0.0 from -0.0, and 1 from 1.0
        if isinstance(value, np.generic) or type(value) is np.ndarray:
            if value.dtype.hasobject:
                raise Undecided
            return type(value), repr(value.dtype), value.shape, value.tobytes()
        if isinstance(value, (jax.Array, *_OPAQUE)):
            return Same(value)
        is_read = isinstance(value, type | types.ModuleType | types.FunctionType) and self._around
        if is_read and _is_library(value):
            return Same(value)
        return None

    def _compound(self, value: Any, is_explicit: bool) -> tuple[Any, Maker]:
        kind = type(value)
        if kind is types.FunctionType:
            return self._function(value)
        if kind is types.MethodType:
            explicit = (False, is_explicit and _is_pytree(value.__self__))
            return self._parts(kind, (value.__func__, value.__self__), lambda parts: kind(*parts), explicit)
        if kind is types.BuiltinFunctionType:
            return (kind, value.__name__, self.key(value.__self__)), lambda _: value
        if kind in (functools.partial, jax.tree_util.Partial):
            is_explicit = kind is jax.tree_util.Partial
            parts = (value.func, value.args, value.keywords)
            return self._parts(kind, parts, lambda parts: kind(parts[0], *parts[1], **parts[2]), [is_explicit] * 3)
        if kind in (list, tuple):
            return self._parts(kind, value, kind, [is_explicit] * len(value))
        if kind is dict:
            keys = tuple(map(self.key, value))
            made = lambda parts: dict(zip(value, parts, strict=True))
            return self._parts((kind, keys), list(value.values()), made, [is_explicit] * len(keys))
        if kind in (staticmethod, classmethod):
            return (kind, self.key(value.__func__)), lambda _: value
        if kind is property:
            return (kind, self.key([value.fget, value.fset])), lambda _: value
        if _is_pytree(value):
            return self._pytree(value, is_explicit)
        if isinstance(value, type | types.ModuleType):
            return (Same(value), self._read(value)), lambda _: value
        return self._instance(value)

    def _parts(
        self, kind: Any, values: Iterable[Any], made: Callable[[list[Any]], Any], explicit: Sequence[bool]
    ) -> tuple[Any, Maker]:
        found = [self.part(value, is_explicit) for value, is_explicit in zip(values, explicit, strict=True)]
        makers = [maker for _, maker in found]
        return (kind, *(key for key, _ in found)), lambda numbers: made([maker(numbers) for maker in makers])

    def _pytree(self, value: Any, is_explicit: bool) -> tuple[Any, Maker]:
        leaves, structure = jax.tree.flatten(value, is_leaf=lambda node: node is not value)
        try:
            hash(structure)
        except TypeError as error:
            raise Undecided from error
        return self._parts(structure, leaves, structure.unflatten, [is_explicit] * len(leaves))

    def _function(self, function: types.FunctionType) -> tuple[Any, Maker]:
        code = function.__code__
        names, imported = _names(code)
        if not sys.modules.keys() >= imported:
            raise Undecided
        self.names |= names
        try:
            closed_over = [cell.cell_contents for cell in function.__closure__ or ()]
        except ValueError as error:
            raise Undecided from error
        captured = (closed_over, function.__defaults__, function.__kwdefaults__)
        key, maker = self.part(captured)
        spaces = (vars(builtins), function.__globals__, {name: sys.modules[name] for name in imported})
        read = self.key([[(name, space[name]) for name in sorted(names) if name in space] for space in spaces])

        def made(numbers: Iterator[Any]) -> types.FunctionType:
            closed_over, defaults, keywords = maker(numbers)
            cells = tuple(map(types.CellType, closed_over))
            again = types.FunctionType(code, function.__globals__, function.__name__, defaults, cells)
            again.__kwdefaults__ = keywords
            vars(again).update(vars(function))
            return again

        return (code, Same(function.__globals__), key, read, self.key(vars(function))), made

    def _instance(self, value: Any) -> tuple[Any, Maker]:
        kind = type(value)
        of_user = [base for base in kind.__mro__ if base not in _BASES]
        if not hasattr(value, "__dict__") or any(map(_is_library, of_user)):
            raise Undecided
        return (Same(kind), self._read(kind), self._read(value)), lambda _: value

    def _read(self, space: Any) -> Any:
        """Find the key of attributes of a module, class or instance that code names, or calls as operators."""
        spaces = [base for base in space.__mro__ if not _is_library(base)] if isinstance(space, type) else [space]
        found = {}
        for entries in map(vars, reversed(spaces)):
            if "__getattr__" in entries:
                raise Undecided
            for name, value in entries.items():
                is_operator = name[:2] == "__" == name[-2:] and name not in _UNCALLED
                if name in self._attributes or (is_operator and isinstance(value, types.FunctionType)):
                    found[name] = value
        return self.key(sorted(found.items(), key=lambda entry: entry[0]))
