"""Times at which the laws of a mechanism have kinks, or begin and end a pulse: steps of a run end there."""

import functools
import inspect
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.functions import Function
from linkax.xla.arrays import Array


def known_times(mechanism: Any) -> Float[Array, " n"] | None:
    """The `times` of all laws of a mechanism that have some, such as `linkax.PiecewiseLinear`, sorted, (n,) [s].

    A law may be such an object, or a function that reads one. None where there is none.
    """
    found: list[Any] = []
    for node in jax.tree.leaves(mechanism, is_leaf=lambda node: isinstance(node, Function) or _has_times(node)):
        law = node.code.with_numbers(node.numbers) if isinstance(node, Function) else node
        found += _times(law, set())
    return jnp.sort(jnp.concatenate([jnp.asarray(times) for times in found])) if found else None


def _has_times(value):
    return callable(value) and getattr(getattr(value, "times", None), "ndim", 0) == 1


def _times(value, seen) -> Iterator[Any]:
    """The times of a law, and of what it reads."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if _has_times(value):
        yield value.times
    for part in _read_by(value):
        yield from _times(part, seen)


def _read_by(value) -> list[Any]:
    if isinstance(value, types.FunctionType):
        variables = inspect.getclosurevars(value)
        return [*variables.nonlocals.values(), *variables.globals.values()]
    if isinstance(value, types.MethodType):
        return [value.__self__]
    if isinstance(value, functools.partial):
        return [value.func, *value.args, *value.keywords.values()]
    return []
