"""Walk through a function and all that it reads, to compare it and to make it again with other numbers."""

import abc
import builtins
import copyreg
import dataclasses
import functools
import sys
import types
import typing
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dis import get_instructions
from enum import Enum
from importlib import import_module
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from scalarjit.libraries import LIBRARIES

Maker = Callable[[Iterator[Any]], Any]  # makes a value again from an iterator of its numbers


class NotComparable(ValueError):
    """Raised where values cannot be compared; `names` of variables and attributes lead there."""

    def __init__(self, why: str, names: tuple[str, ...] = ()) -> None:
        super().__init__(f"{'.'.join(names)}, {why}" if names else why)
        self.why, self.names = why, names


class NotMadeAgain(Exception):
    """Raised where a value cannot be made again with other numbers, since it holds itself."""


class Key:
    """What compares itself."""


class Same(Key):
    """A value that equals only itself."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


_ATOMS = (type(None), bool, int, float, complex, str, bytes, type(...), range)
# What keeps results of a function, or what was traced of it.
_KEEPING: tuple[Any, ...] = (type(jax.jit(abs)), type(eqx.filter_jit(abs)), type(functools.cache(abs)))
# Compared by identity, as JAX does, and by the functions that they are made of.
_OPAQUE: tuple[Any, ...] = (*_KEEPING, np.ufunc, type(np.dot), jnp.ufunc, jax.custom_jvp, jax.custom_vjp)
_UNBOUND = (types.WrapperDescriptorType, types.MethodDescriptorType, types.ClassMethodDescriptorType)
_OPAQUE += (*_UNBOUND, types.MemberDescriptorType, types.GetSetDescriptorType)
_BOUND = (types.BuiltinFunctionType, types.MethodWrapperType)
_MADE_OF = ("__wrapped__", "jvp", "fwd", "bwd")
# These change by themselves.
_WEAK = (weakref.WeakKeyDictionary, weakref.WeakValueDictionary, weakref.WeakSet)
_BASES = (object, abc.ABC, typing.Generic, typing.Protocol, types.SimpleNamespace)
# Functions that read by names which are in no code: of what is given to them, and of anything.
_BY_NAME = {"getattr", "hasattr", "vars", "dir", "__dict__", "__getattribute__", "attrgetter", "methodcaller"}
_BY_NAME |= {"getattr_static", "getmembers", "asdict", "astuple", "fields", "copy", "deepcopy", "format", "format_map"}
_ANYTHING = {"globals", "eval", "exec", "__import__", "import_module", "__globals__", "f_globals", "f_locals"}
_FUNCTIONS = (types.FunctionType, *_BOUND, *_UNBOUND, type)
# What makes an object, and names by which code reaches it from another object.
_MAKING = {"__init__", "__new__", "__post_init__", "__check_init__"}
_MADE_ANEW = {"type", "__class__", "replace"}
_ALL = "*"  # in place of names: what is reached is read whole
_HOLDING = (functools.partial, types.MethodType)
_MOST_PARTS = 100_000


def is_library(value: Any) -> bool:
    """Tell whether a module, class or function is in a library, which no user changes."""
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


def all_code(code: types.CodeType) -> Iterator[types.CodeType]:
    """Go through code and the code of functions in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from all_code(constant)


@functools.lru_cache(maxsize=1024)
def _names(code: types.CodeType) -> tuple[set[str], set[str]]:
    """Find the names of globals and attributes that code reads, and of modules that it imports when it runs."""
    names, imported = set(), set()
    for part in all_code(code):
        for at in get_instructions(part):
            if at.argval in part.co_names and not at.opname.startswith(("STORE_", "DELETE_")):
                names.add(at.argval)
            if at.opname == "IMPORT_NAME":
                imported.add(at.argval)
            if at.opname == "MATCH_CLASS":  # of attributes that are among the constants
                texts = {text for constant in part.co_consts if isinstance(constant, tuple) for text in constant}
                names |= {"__match_args__", *(text for text in texts if isinstance(text, str))}
    return names | _read_by(names), imported


def _read_by(names: set[str]) -> set[str]:
    """Find what functions of these names read, besides what code names."""
    if names & _ANYTHING:
        raise NotComparable("by which code can read anything", (min(names & _ANYTHING),))
    return names & _MADE_ANEW | ({_ALL} if names & _BY_NAME else set())


class Walk:
    """A walk through a function and all that it reads.

    Each part gives a key, which compares it, and a `Maker`.

    - `names`: names in all code met so far, and a user's classes that it reads, of which it may make objects.
    - `variables`: of a user's that functions close over or read as globals.
    - `numbers`: numbers met so far. `keeping`: functions of `jax.jit` and `functools.cache`.
    """

    def __init__(self, names: Iterable[Any]) -> None:
        self.names, self.numbers, self.variables, self.keeping = set(names), [], {}, []
        self._attributes, self._around, self._count, self._is_traced = frozenset(names), [], 0, True
        self._classes, self._is_kept = set(), False

    def part(self, value: Any, is_explicit: bool = False) -> tuple[Any, Maker]:
        """Find the key and the maker of a value; where `is_explicit`, its floats and NumPy arrays are numbers too.

        **Raises:** `NotComparable`, `NotMadeAgain`.
        """
        self._count += 1
        if self._count > _MOST_PARTS:
            raise NotComparable(f"more than {_MOST_PARTS} values, where an array would be one")
        is_number = isinstance(value, jax.Array) or (is_explicit and isinstance(value, float | np.ndarray | np.generic))
        if is_number and self._is_traced:
            self.numbers.append(value)
            return "number", next
        if isinstance(value, _FUNCTIONS):
            self.names |= _read_by({value.__name__})
        if (key := self._atom(value)) is not None:
            return key, lambda _: value
        if isinstance(value, type) and self._is_read(value):
            self.names.add(value)
        for place, around in enumerate(self._around):
            if around is value:
                if self._is_traced:
                    raise NotMadeAgain
                return ("again", place), lambda _: value
        self._around.append(value)
        try:
            return self._compound(value, is_explicit)
        finally:
            self._around.pop()

    def key(self, value: Any) -> Any:
        """Find the key of a value that is read and not made again, so that its arrays are no numbers."""
        traced, self._is_traced = self._is_traced, False
        try:
            return self.part(value)[0]
        finally:
            self._is_traced = traced

    def _is_read(self, kind: type) -> bool:
        """Tell whether code reads a class by a name, not as the class of an instance or the one that `super` reads."""
        around = self._around[-1] if self._around else None
        return type(around) is not kind and not (type(around) is dict and around.get("__class__") is kind)

    def _atom(self, value: Any) -> Any:
        if isinstance(value, Key):
            return value
        if type(value) in _ATOMS or isinstance(value, np.dtype):
            return type(value), repr(value)  # tells 0.0 from -0.0, and 1 from 1.0
        if (isinstance(value, np.generic) and is_library(type(value))) or type(value) is np.ndarray:
            return None if value.dtype.hasobject else (type(value), repr(value.dtype), value.shape, value.tobytes())
        if isinstance(value, jax.Array):
            return Same(value)
        # A function that a library has made, such as by `jax.grad`, closes over what it was made of.
        is_open = isinstance(value, types.FunctionType) and self._around and not value.__closure__
        return Same(value) if (isinstance(value, type) or is_open) and is_library(value) else None

    def _compound(self, value: Any, is_explicit: bool) -> tuple[Any, Maker]:
        kind = type(value)
        if kind is types.FunctionType:
            return self._function(value)
        if kind is types.MethodType:
            explicit = (False, is_explicit and _is_pytree(value.__self__))
            return self._parts(kind, (value.__func__, value.__self__), lambda parts: kind(*parts), explicit)
        if kind in (functools.partial, jax.tree_util.Partial):
            is_explicit = kind is jax.tree_util.Partial
            parts = (value.func, value.args, value.keywords)
            return self._parts(kind, parts, lambda parts: kind(parts[0], *parts[1], **parts[2]), [is_explicit] * 3)
        if kind in (list, tuple):
            return self._parts(kind, value, kind, [is_explicit] * len(value))
        if kind is dict:
            keys = tuple(map(self.key, value))
            made = lambda parts: dict(zip(value, parts, strict=True))
            return self._parts((kind, keys), list(value.values()), made, [is_explicit] * len(keys), list(value))
        if isinstance(value, (type, *_OPAQUE)) or not _is_pytree(value):
            return self._read_only(value), lambda _: value
        leaves, structure = jax.tree.flatten(value, is_leaf=lambda node: node is not value)
        key = tuple(map(self.key, structure.node_data()))  # its class, and what is no leaf
        return self._parts(key, leaves, structure.unflatten, [is_explicit] * len(leaves))

    def _read_only(self, value: Any) -> Any:
        """Find the key of what is never made again."""
        kind = type(value)
        if isinstance(value, _OPAQUE):
            return self._opaque(value)
        if kind in _BOUND:
            return kind, value.__name__, self.key(value.__self__)
        if kind in (staticmethod, classmethod):
            return kind, self.key(value.__func__)
        if kind is property:
            return kind, self.key([value.fget, value.fset])
        if kind is functools.cached_property:
            return kind, self.key(value.func)
        if kind is types.MappingProxyType:
            return kind, self.key(dict(value))
        if isinstance(value, types.ModuleType):
            return Same(value), self._settings(value) if is_library(value) else self._read(value)
        if not isinstance(value, type):
            return self._instance(value)
        if value in self._classes:  # of many instances
            return Same(value)
        members = value.__members__.values() if issubclass(value, Enum) else ()  # reached without their names
        read = self._read(value), self.key(list(members))
        self._classes.add(value)
        return Same(value), read

    def _parts(
        self,
        kind: Any,
        values: Iterable[Any],
        made: Callable[[list[Any]], Any],
        explicit: Sequence[bool],
        names: Sequence[Any] | None = None,
    ) -> tuple[Any, Maker]:
        found = []
        for place, (value, is_explicit) in enumerate(zip(values, explicit, strict=True)):
            try:
                found.append(self.part(value, is_explicit))
            except NotComparable as error:
                if names is None or not isinstance(names[place], str):
                    raise
                raise NotComparable(error.why, (names[place], *error.names)) from error
        makers = [maker for _, maker in found]
        return (kind, *(key for key, _ in found)), lambda numbers: made([maker(numbers) for maker in makers])

    def _function(self, function: types.FunctionType) -> tuple[Any, Maker]:
        code = function.__code__
        of_user = not is_library(function)
        names, imported = _names(code) if of_user else (set(), set())
        self.names |= names
        cells = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        closed_over = {name: cell.cell_contents for name, cell in cells.items() if cell != types.CellType()}
        if len(closed_over) < len(cells) and self._is_traced:
            raise NotMadeAgain  # of what is defined later
        for name in imported:
            with suppress(ImportError):
                import_module(name)
        modules = {name: sys.modules[name] for name in imported if name in sys.modules}
        read = [
            {name: space[name] for name in sorted(names) if name in space}
            for space in (vars(builtins), function.__globals__, modules)
        ]
        if of_user:
            own = (name for space in (closed_over, read[1]) for name in space if not _is_fixed(space[name]))
            self.variables |= dict.fromkeys(name for name in own if name != "__class__")
        key, maker = self.part((closed_over, function.__defaults__, function.__kwdefaults__))
        others = {name: value for name, value in vars(function).items() if name != "__wrapped__"}

        def made(numbers: Iterator[Any]) -> types.FunctionType:
            closed_over, defaults, keywords = maker(numbers)
            cells = tuple(map(types.CellType, closed_over.values()))
            again = types.FunctionType(code, function.__globals__, function.__name__, defaults, cells)
            again.__kwdefaults__ = keywords
            vars(again).update(vars(function))
            return again

        return (code, Same(function.__globals__), key, self.key(read), self.key(others)), made

    def _opaque(self, value: Any) -> Any:
        parts = [getattr(value, name, None) for name in _MADE_OF]
        if isinstance(value, _KEEPING) and self._atom(parts[0]) is None:
            self.keeping.append(value)
        return Same(value), *map(self.key, parts)

    def _instance(self, value: Any) -> Any:
        kind = type(value)
        if kind is object or (isinstance(value, Enum) and is_library(kind)):
            return Same(value)
        if isinstance(value, Enum):
            return Same(value), self.key(kind), self.key(value._value_), self._read(value)
        if (key := _compared(value)) is not None:
            return key
        if not is_library(kind):
            of_library = any(is_library(base) for base in kind.__mro__ if base not in _BASES)
            return self.key(kind), self._read(value), self._reduced(value) if of_library else None
        if self._is_kept or not self._is_of_library():
            return self._reduced(value)
        self._is_kept = True
        try:
            return self._reduced(value)
        except NotComparable:
            return Same(value)
        finally:
            self._is_kept = False

    def _is_of_library(self) -> bool:
        """Tell whether a function of a library holds what is walked through now, so that no user changes it."""
        holders = (each for each in reversed(self._around[:-1]) if not (_is_pytree(each) or type(each) in _HOLDING))
        holder = next(holders, None)
        return isinstance(holder, types.FunctionType) and is_library(holder)

    def _reduced(self, value: Any) -> Any:
        """Find the key of all that a copy of an object would be made of."""
        kind = type(value)
        told = f"a {kind.__module__}.{kind.__qualname__}, which cannot be compared"
        if isinstance(value, _WEAK):
            raise NotComparable(told)
        reduce = copyreg.dispatch_table.get(kind, lambda value: value.__reduce_ex__(4))
        try:
            reduced = reduce(value)
        except Exception as error:
            raise NotComparable(told) from error
        if isinstance(reduced, str):  # there is one
            return Same(value)
        parts: list[Any] = [list(part) if isinstance(part, Iterator) else part for part in reduced]
        if not is_library(kind):  # which no code reads here
            parts[:2] = [Same(kind) if each is kind else each for each in (parts[0], *parts[1])]
        return self.key(parts)

    def _settings(self, library: types.ModuleType) -> Any:
        """Find the key of what code names in a library that is no function, such as `os.environ`."""
        found = {}
        for name in sorted(self._attributes & vars(library).keys()):
            value = vars(library)[name]
            if name[:2] != "__" and not (callable(value) or isinstance(value, types.ModuleType)):
                with suppress(NotComparable):
                    found[name] = self.key(value)
        return tuple(found.items())

    def _read(self, space: Any) -> Any:
        """Find the key of attributes of a module, class or instance that code names, or calls as operators."""
        is_class = isinstance(space, type)
        bases = (*(space if is_class else type(space)).__mro__, *type(space).__mro__)
        classes = [base for base in bases if not is_library(base)]
        spaces = [(each, vars(each)) for each in classes] if is_class else [(type(space), _held(space))]
        has_getattr = any("__getattr__" in entries for entries in (*map(vars, classes), *(held for _, held in spaces)))
        reads_all = has_getattr or _ALL in self._attributes
        makes = is_class and not self._attributes.isdisjoint({space, *_MADE_ANEW})
        found = []
        for owner, entries in spaces:
            of_making = {*_MAKING, "__call__"} if issubclass(owner, type) else _MAKING
            found.append({})
            for name, value in sorted(entries.items()):
                is_special = name[:2] == "__" == name[-2:]
                is_operator = is_special and (makes or name not in of_making) and _is_called(value)
                is_read = name in self._attributes or (reads_all and not is_special and name != "_abc_impl")
                if is_operator or is_read:
                    found[-1][name] = value
                if is_read and isinstance(value, classmethod):  # which is given the class
                    self.names.add(space)
        if is_class and "__match_args__" in self._attributes:
            self.names.update(getattr(space, "__match_args__", ()))
        if makes and dataclasses.is_dataclass(space):
            found.append([dict(field.metadata) for field in dataclasses.fields(space)])  # where Equinox has converters
        return self.key(found)


def _compared(value: Any) -> Any:
    """The key of code, and of an object of an installed package that is equal by value; None of others.

    Of Python's own, sets and weak references are equal by what they hold, which changes.
    """
    kind = type(value)
    is_equal_by_value = kind.__hash__ not in (None, object.__hash__) and kind.__eq__ is not object.__eq__
    of_python = kind.__module__.partition(".")[0] in sys.stdlib_module_names
    of_package = is_library(kind) and not (of_python or callable(value))
    if kind is types.CodeType or (is_equal_by_value and of_package):
        with suppress(TypeError):
            return kind, hash(value), value
    return None


def _is_called(value: Any) -> bool:
    """Tell whether Python calls this where it is an attribute of a class."""
    return callable(value) or hasattr(type(value), "__get__")


def _held(value: Any) -> dict[str, Any]:
    """Attributes that a module or an instance has itself, those in slots too."""
    held = dict(vars(value)) if hasattr(value, "__dict__") else {}
    for base in type(value).__mro__:
        for name, member in () if is_library(base) else vars(base).items():
            if isinstance(member, types.MemberDescriptorType):
                with suppress(AttributeError):  # it has no value
                    held[name] = member.__get__(value)
    return held


def _is_fixed(value: Any) -> bool:
    """Tell whether this is of a library."""
    return isinstance(value, type | types.ModuleType | types.FunctionType) and is_library(value)
