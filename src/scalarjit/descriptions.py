"""Describe what is static about a program, alike in all processes: what its copy on disk is found by.

Pickles do not serve: of equal objects they differ, by what an object has computed of itself. What another process could
take for something else is not described: objects and functions of a user, which keep their name and change.
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import os
import platform
import re
import sys
import types
from collections.abc import Iterable
from contextlib import suppress
from enum import Enum
from functools import singledispatch
from pathlib import Path
from typing import Any

import jax
import numpy as np

from scalarjit.flat import Structure

# Packages that change with their version alone; linkax with its sources.
PACKAGES = (
    "linkax",
    "scalarjit",
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "lineax",
    "optimistix",
    "optax",
    "numpy",
    "scipy",
)
STANDARD = ("builtins", "functools", "operator", "math", "cmath", "collections", "typing", "types", "abc", "enum")
# Names in users' functions by which these may read what is outside of them.
_OUTSIDE = re.compile(
    "open.*|input|load.*|from(file|regex)|genfromtxt|memmap|DataSource|rand.*|debug|.*callback.*|id|hash"
)
_HEAP = 1 << 9  # of a class that Python code has made
_MISSING = object()


class Undescribed(Exception):
    """Raised for what could mean something else in another process."""


@singledispatch
def description(value: Any) -> Any:
    """Nested tuples of strings, the same for what programs take for the same.

    **Raises:** `Undescribed`.
    """
    if isinstance(value, Enum):
        return named(type(value)), value.name
    if dataclasses.is_dataclass(value) and not isinstance(value, type):  # such as modules of Equinox
        fields = [(field.name, getattr(value, field.name, _MISSING)) for field in dataclasses.fields(value)]
        return named(type(value)), of_each(entry for field in fields if field[1] is not _MISSING for entry in field)
    if isinstance(value, jax.Array):
        return "array of JAX", value.weak_type, description(np.asarray(value))
    if hasattr(value, "__qualname__") and not isinstance(value, np.ufunc):
        return named(value)
    # One that a library has once, such as its sign for what is missing.
    around = sys.modules.get(type(value).__module__)
    for name, entry in vars(around).items() if around else ():
        if entry is value:
            return named(type(value)), name
    raise Undescribed(value)


def of_each(values: Iterable[Any]) -> tuple[Any, ...]:
    """Descriptions of several values."""
    return tuple(map(description, values))


def named(value: Any) -> tuple[str, str, str]:
    """A class or function of a library by its name.

    **Raises:** `Undescribed` for one of a user, or that its name does not lead to.
    """
    module, name = value.__module__, value.__qualname__
    found = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    of_python = isinstance(value, type) and not value.__flags__ & _HEAP  # which does not name all of its classes
    if str(module).partition(".")[0] not in (*PACKAGES, *STANDARD) or not (found is value or of_python):
        raise Undescribed(value)
    return type(value).__name__, module, name


@description.register
def _(value: bool | int | float | complex | str | bytes | types.EllipsisType | np.dtype | None) -> Any:
    return named(type(value)), repr(value)  # tells 0.0 from -0.0, and 1 from 1.0


@description.register
def _(value: range | slice) -> Any:
    return named(type(value)), of_each((value.start, value.stop, value.step))


@description.register
def _(value: np.ndarray | np.generic) -> Any:
    if value.dtype.hasobject:
        raise Undescribed(value)
    return named(type(value)), repr(value.dtype), value.shape, value.tobytes()


@description.register
def _(structure: Structure) -> Any:
    return "structure", *of_each((structure.others, structure.treedef, structure.noted))


@description.register
def _(value: tuple | list) -> Any:
    return named(type(value)), *of_each(value)


@description.register
def _(value: dict) -> Any:
    return named(type(value)), of_each(value), of_each(value.values())


@description.register
def _(value: set | frozenset) -> Any:
    return named(type(value)), *sorted(of_each(value), key=repr)


@description.register
def _(value: functools.partial) -> Any:
    return named(type(value)), *of_each((value.func, value.args, value.keywords))


@description.register
def _(value: types.MethodType) -> Any:
    return "method", description(value.__func__), description(value.__self__)


@description.register
def _(value: types.ModuleType) -> Any:
    if value.__name__.partition(".")[0] not in (*PACKAGES, *STANDARD):
        raise Undescribed(value)
    return "module", value.__name__


@description.register(jax.tree_util.PyTreeDef)
def _(value: Any) -> Any:
    node = value.node_data()
    if node is None:
        return "leaf" if value.num_leaves else "none"
    return description(node[0]), description(node[1]), *map(description, value.children())


@description.register
def _(value: types.FunctionType) -> Any:
    try:
        return named(value)
    except Undescribed:
        if str(value.__module__).partition(".")[0] not in PACKAGES:
            raise
    # One without a name of its own: by its code, and what it closes over.
    cells = [cell.cell_contents for cell in value.__closure__ or ()]
    return "function", value.__module__, *of_each((value.__code__, cells, value.__defaults__, value.__kwdefaults__))


@description.register
def _(value: types.CodeType) -> Any:
    names = value.co_name, value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars
    if any(map(_OUTSIDE.fullmatch, value.co_names)):
        raise Undescribed(value)
    counts = value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags
    return "code", value.co_code, value.co_exceptiontable, names, counts, of_each(value.co_consts)


@functools.cache
def of_libraries() -> tuple[Any, ...]:
    """The versions of Python and all libraries, and the sources of linkax."""
    versions = [(name, _version(name)) for name in PACKAGES[2:]]
    root = Path(__file__).parents[1]
    sources = [(path.relative_to(root).as_posix(), path.read_bytes()) for path in sorted(root.rglob("*.py"))]
    return sys.version, tuple(versions), hashlib.sha256(repr(sources).encode()).hexdigest()


def _version(name):
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)


@functools.cache
def of_processor() -> tuple[str, ...]:
    """What the processor can do, as far as the system tells."""
    of_linux = Path("/proc/cpuinfo")
    if not of_linux.exists():  # other systems tell too little, so it is this machine
        return platform.machine(), platform.processor(), platform.node()
    told = ("model name", "flags", "Features", "CPU part")
    lines = of_linux.read_text().splitlines()
    return platform.machine(), *sorted({line for line in lines if line.startswith(told)})


_NAMES = [
    name for name in sorted(jax.config.values) if not re.match("jax_(compilation|persistent)_cache|jax_log", name)
]


def settings() -> tuple[Any, ...]:
    """The settings of JAX in this thread."""
    return tuple(getattr(jax.config, name, None) for name in _NAMES)


def of_settings(given: tuple[Any, ...]) -> tuple[Any, ...]:
    """Those settings, the ones of XLA and Equinox, and the devices."""
    environment = [os.environ.get(name) for name in ("XLA_FLAGS", "EQX_ON_ERROR")]
    devices = [(device.platform, device.device_kind) for device in jax.devices()]
    return _NAMES, tuple(map(repr, given)), environment, devices
