"""Times at which the laws of a mechanism have kinks, or begin and end a pulse: steps of a run end there."""

import functools
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.functions import Function
from linkax.xla.arrays import Array
from scalarjit.code_walk import all_code, is_library


def known_times(mechanism: Any) -> Float[Array, " n"] | None:
    """The `times` of all laws of a mechanism that have some, such as `linkax.PiecewiseLinear`, sorted, (n,) [s].

    A law may be such an object, or what reads one: a function, an element or object of a user's own class. None where
    there is none.
    """
    seen: set[int] = set()
    is_law = lambda node: isinstance(node, Function) or _has_times(node) or _is_users(node)
    found = [times for node in jax.tree.leaves(mechanism, is_leaf=is_law) for times in _times(node, seen)]
    return jnp.sort(jnp.concatenate([jnp.asarray(times) for times in found])) if found else None


def _has_times(value):
    return callable(value) and getattr(getattr(value, "times", None), "ndim", 0) == 1


def _is_users(value):
    """Whether an object is of a user's own class."""
    return not isinstance(value, type) and not is_library(type(value))


def _times(value, seen) -> Iterator[Any]:
    """The times of a law, and of what it reads."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, Function):
        value = value.code.with_numbers(value.numbers)
    if _has_times(value):
        yield value.times
    for part in _read_by(value):
        yield from _times(part, seen)


def _read_by(value) -> list[Any]:
    if isinstance(value, types.FunctionType):
        return [] if is_library(value) else _read_by_function(value)
    if isinstance(value, types.MethodType):
        return [value.__self__, value.__func__]
    if isinstance(value, functools.partial):
        return [value.func, *value.args, *value.keywords.values()]
    if isinstance(value, property):
        return [value.fget]
    if isinstance(value, dict):
        return [*value.values()]
    if isinstance(value, list | tuple | set | frozenset):
        return [*value]
    if _is_users(value):
        of_user = [base for base in type(value).__mro__ if not is_library(base)]
        return [*getattr(value, "__dict__", {}).values(), *(part for base in of_user for part in vars(base).values())]
    return []


def _read_by_function(function):
    cells = [cell.cell_contents for cell in function.__closure__ or () if cell != types.CellType()]
    names = {name for code in all_code(function.__code__) for name in code.co_names}
    read = [function.__globals__[name] for name in names & function.__globals__.keys()]
    modules = [value for value in read if isinstance(value, types.ModuleType) and not is_library(value)]
    of_modules = [vars(module)[name] for module in modules for name in names & vars(module).keys()]
    defaults = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    return [*cells, *read, *of_modules, *defaults]
