"""Elements of a machine as data: what is built, from which numbers, and where the file says so."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from linkax.machines.xml import MachineFileError, Where
from linkax.model.bodies import Frame
from linkax.model.names import meant
from linkax.model.numbers import Constant, number

STRUCTURE = ("axis", "second_axis")  # arguments that are numbers, and no parameters


@dataclasses.dataclass(frozen=True)
class Place:
    """A frame on a body: its name or "ground", the origin [m], (3,), and the axes as columns, (3, 3), in body axes."""

    body: str
    offset: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]

    @staticmethod
    def at(body: str, pose: Float[np.ndarray, "4 4"]) -> "Place":
        """Make it from a pose in the body's frame."""
        return Place(body, pose[:3, 3], pose[:3, :3])


@dataclasses.dataclass(frozen=True)
class Part:
    """An element: `kind(**arguments)`, of a class of linkax.

    - `arguments`: by name: numbers, words, a `Place` for a frame, a `Part` for an object that the element holds.
    - `where`: the element of the file that says so.
    - `frozen`: names of arguments that are no parameters.
    """

    kind: type
    arguments: Mapping[str, Any]
    where: Where
    frozen: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """The name of the element."""
        return self.arguments["name"]

    @property
    def params(self) -> dict[str, Any]:
        """Its numbers by the names of the arguments; of a frame the origin [m], (3,)."""
        free = {name: entry for name, entry in self.arguments.items() if name not in self.frozen}
        found = {name: _numbers(entry) for name, entry in free.items() if name not in STRUCTURE}
        return {name: entry for name, entry in found.items() if entry is not None}

    def built(self, params: Mapping[str, Any]) -> Any:
        """Build the element, with other numbers for some of its parameters.

        **Raises:** `MachineFileError` for an argument that it does not have, and a number that it cannot have.
        """
        try:
            return self.kind(**_merged(self.arguments, params, self.where))
        except MachineFileError:
            raise
        except ValueError as error:
            raise self.where.error(str(error)) from error


def _numbers(entry):
    """The parameters in an argument, None where it has none."""
    if isinstance(entry, Place):
        return entry.offset
    if isinstance(entry, Part):
        return entry.params or None
    if isinstance(entry, Mapping):
        found = {key: _numbers(value) for key, value in entry.items() if isinstance(key, str)}
        return {key: value for key, value in found.items() if value is not None} or None
    is_number = isinstance(entry, float | np.ndarray | np.floating | jax.Array)
    return entry if is_number else None


def _merged(arguments, params, where):
    """The arguments as the class takes them, with other numbers."""
    for name in params:
        if name not in arguments:
            raise where.error(f"it has no number {name!r}{meant(name, arguments)}; known: {', '.join(arguments)}")
    return {name: _with(entry, params.get(name), where, name) for name, entry in arguments.items()}


def _with(entry, other, where, name):
    if isinstance(entry, Place):
        offset = entry.offset if other is None else other
        axes = Constant(entry.rotation)
        return Frame(entry.body, number(offset, (3,), f"{where}: {name} [m]"), axes)
    if isinstance(entry, Part):
        return entry.built({} if other is None else other)
    if isinstance(entry, Mapping):
        return _merged(entry, {} if other is None else other, where)
    return entry if other is None else other
