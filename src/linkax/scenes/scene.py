"""What a ready-made scene is: a mechanism as a function of named parameters, and where it starts."""

import dataclasses
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from linkax.model.mechanism import Mechanism
from linkax.simulation.start.state import State
from linkax.xla.tracing import concrete

Parameters = Mapping[str, Any]  # numbers, some of them traced


@dataclasses.dataclass(frozen=True)
class Variant:
    """A named choice of a scene's parameters.

    - `summary`: what it is, one line.
    - `parameters`: those that differ from the scene's defaults.
    - `t1`: end time [s], where it differs from the scene's.
    """

    summary: str
    parameters: Mapping[str, float | int] = dataclasses.field(default_factory=dict)
    t1: float | None = None


@dataclasses.dataclass(frozen=True)
class Scene:
    """A mechanism with named parameters, its start, and the points to look at.

    - `parameters`: default of each parameter, SI units; initial conditions are among them. A
      default that is an integer marks a count, which is structure: an integer, one or more.
    - `meanings`: what each parameter is, with its unit.
    - `variants`, `default_variant`: named choices of parameters.
    - `t1`: end time [s].
    - `mechanism`: parameters -> `Mechanism`, a pure function; all but counts may be traced.
    - `initial`: (mechanism, parameters) -> `State`.
    - `points`: parameters -> {name: (body, frame of the body or None for its centre of mass)}.
    - `exact`: (parameters, times [s]) -> {name of a point: positions (n_t, 3) [m]}, in closed form, or None where
      there is none for these parameters; or None.

    ```python
    parameters = scene.settings("SC2", {"speed": 3.0})
    mechanism = scene.mechanism(parameters)
    state = scene.initial(mechanism, parameters)
    ```
    """

    name: str
    summary: str
    parameters: Mapping[str, float | int]
    meanings: Mapping[str, str]
    variants: Mapping[str, Variant]
    default_variant: str
    t1: float
    mechanism: Callable[[Parameters], Mechanism]
    initial: Callable[[Mechanism, Parameters], State]
    points: Callable[[Parameters], dict[str, tuple[str, str | None]]]
    exact: Callable[[Parameters, np.ndarray], dict[str, np.ndarray] | None] | None = None

    def variant(self, name: str | None = None) -> Variant:
        """The variant of that name, or the default one.

        **Raises:** `ValueError` naming the known ones.
        """
        name = self.default_variant if name is None else name
        if name not in self.variants:
            raise ValueError(f"scene {self.name!r} has no variant {name!r}; known: {', '.join(self.variants)}")
        return self.variants[name]

    def settings(self, variant: str | None = None, changes: Parameters | None = None) -> dict[str, Any]:
        """All parameters: defaults, those of a variant over them, and `changes` over both.

        `changes` may hold numbers, traced numbers, or text to be read as numbers.

        **Raises:** `ValueError` for an unknown name, and for a value that is not a finite number,
        or not an integer of at least one where a count is expected.
        """
        checked = {name: self._checked(name, entry) for name, entry in (changes or {}).items()}
        return {**self.parameters, **self.variant(variant).parameters, **checked}

    def duration(self, variant: str | None = None) -> float:
        """End time of a variant [s]."""
        t1 = self.variant(variant).t1
        return self.t1 if t1 is None else t1

    def _checked(self, name: str, entry: Any) -> Any:
        if name not in self.parameters:
            raise ValueError(f"scene {self.name!r} has no parameter {name!r}; known: {', '.join(self.parameters)}")
        read = _count if isinstance(self.parameters[name], int) else _finite
        try:
            return read(entry)
        except (TypeError, ValueError) as error:
            kind = "an integer of at least 1" if read is _count else "a finite number"
            message = f"parameter {name!r} of scene {self.name!r} is {entry!r}; it must be {kind}"
            raise ValueError(message) from error


def _count(entry: Any) -> int:
    count = int(entry) if isinstance(entry, str) else operator.index(entry)
    if isinstance(entry, bool) or count < 1:
        raise ValueError
    return count


def _finite(entry: Any) -> Any:
    if isinstance(entry, bool):
        raise ValueError
    if concrete(entry) is None or hasattr(entry, "dtype"):
        return entry
    if not math.isfinite(number := float(entry)):
        raise ValueError
    return number
