"""Errors for calls that do not fit, and attributes that are not there, which say what to write instead."""

import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any, cast

import equinox as eqx

from linkax.model.names import meant


def explain_slips(public: Mapping[str, Any]) -> dict[str, Callable[..., Any]]:
    """Have functions, and the `__init__` of classes, explain calls that do not fit, and objects what they have not.

    **Returns:** the functions that do, by name, which are those of their modules from now on.
    """
    functions = {}
    for name, entry in public.items():
        if inspect.isfunction(entry):
            functions[name] = _explaining(entry, entry.__name__, 0)
            setattr(sys.modules[entry.__module__], entry.__name__, functions[name])
        elif inspect.isclass(entry):
            kind, is_module = cast(Any, entry), issubclass(entry, eqx.Module)
            if inspect.isfunction(vars(kind).get("__init__")):
                kind.__init__ = _explaining(kind.__init__, kind.__name__, 1)
            if is_module:
                kind.__getattr__ = _lacking
    return functions


def _lacking(owner, name):
    """What Python calls for an attribute that is not there, or that raises an `AttributeError` itself."""
    kind = type(owner)
    if name.startswith("_") or hasattr(kind, name):
        return object.__getattribute__(owner, name)
    known = [each for each in dir(owner) if not each.startswith("_")]
    elsewhere = getattr(kind, "_elsewhere", "")
    told = f"{kind.__name__} has no {name!r}{meant(name, known)}; known: {_listed(known)}{elsewhere}"
    raise AttributeError(told, name=name, obj=owner)


def _explaining(function, name, skipped):
    """A function that explains calls which do not fit; the first arguments are `skipped`, as `self` is."""

    @functools.wraps(function)
    def explaining(*args, **options):
        try:
            return function(*args, **options)
        except TypeError as error:
            if (told := _misfit(inspect.signature(function), args, options, skipped)) is None:
                raise
            raise TypeError(f"{_called(name, args) if skipped else name} {told}") from error

    return explaining


def _called(name, args):
    """The class of what is made, and the name that it is given, if any."""
    kind = type(args[0]).__name__ if args else name
    return kind + "".join(f" {first!r}" for first in args[1:2] if isinstance(first, str))


def _misfit(signature, args, options, skipped) -> str | None:
    """What does not fit in a call, and what to write; None where all does."""
    try:
        signature.bind(*args, **options)
    except TypeError as error:
        told = str(error)
    else:
        return None
    parameters = list(signature.parameters.values())[skipped:]
    args = args[skipped:]
    named = [each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)]
    places = [each.name for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    for name, value in options.items():
        if name not in named:
            hint = _home(name, value, parameters) or meant(name, named)
            return f"has no argument {name!r}{hint}; known: {_listed(named)}"
    if len(args) > len(places):
        others = [name for name in named if name not in places and name not in options]
        written = ", ".join(f"{name}={value!r:.60}" for name, value in zip(others, args[len(places) :], strict=False))
        return f"takes {_listed(places)} by position, and all else by name" + (f": give {written}" if written else "")
    given = {*places[: len(args)], *options}
    if lacking := [each.name for each in parameters if each.default is each.empty and each.name in {*named} - given]:
        return f"needs {_listed(lacking)}; give {', '.join(f'{name}=...' for name in lacking)}"
    return told


def _home(name, value, parameters):
    """Another argument that has this as a field, in words for after the wrong one."""
    for each in parameters:
        of = each.default
        if dataclasses.is_dataclass(of) and name in {field.name for field in dataclasses.fields(of)}:
            return f", which is in {each.name}: give {each.name}=linkax.{type(of).__name__}({name}={value!r})"
    return ""


def _listed(names):
    return ", ".join(names) or "nothing"
