"""Scenes: mechanisms as functions of named parameters, with their initial states.

What describes a scene is in `scenes.toml`, which the command line lists without waiting for JAX.
"""

import dataclasses
import math
import operator
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from linkax.model.mechanism import Mechanism
from linkax.model.names import meant
from linkax.model.numbers import number_in
from linkax.simulation.start.state import State
from linkax.xla.tracing import concrete

MOST_NAMES = 30  # of parameters that a message lists
Parameters = Mapping[str, Any]  # numbers, some of them traced
_DESCRIBED = tomllib.loads((Path(__file__).parent / "scenes.toml").read_text(encoding="utf-8"))


@dataclasses.dataclass(frozen=True)
class Variant:
    """A named choice of a scene's parameters.

    - `summary`: a description in one line.
    - `parameters`: those with other values than the scene's defaults.
    - `t1`: end time [s], where it differs from the scene's.
    """

    summary: str
    parameters: Mapping[str, float | int] = dataclasses.field(default_factory=dict)
    t1: float | None = None


@dataclasses.dataclass(frozen=True)
class Scene:
    """A mechanism with named parameters, its initial state, and points of interest.

    - `parameters`: the default of each parameter, in SI units; initial conditions are among them. A parameter with
      an integer default is a count, which is structure: an integer of at least one.
    - `meanings`: the meaning of each parameter, with its unit.
    - `variants`, `default_variant`: named choices of parameters.
    - `t1`: end time [s].
    - `mechanism`: parameters ↦ `Mechanism`, a pure function; all but counts may be traced.
    - `initial`: (mechanism, parameters) ↦ `State`.
    - `points`: parameters ↦ {name: (body, frame of the body or None for its centre of mass)}.
    - `exact`: (parameters, times [s]) ↦ {name of a point: positions (n_t, 3) [m]} in closed form, or None for
      parameters without one; None for a scene without one.

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
    exact: Callable[[Parameters, np.ndarray], dict[str, np.ndarray] | Any] | Any = None

    def variant(self, name: str | None = None) -> Variant:
        """Return the variant of that name, by default the default one.

        **Raises:** `ValueError` for an unknown name, with the known ones.
        """
        name = self.default_variant if name is None else name
        if name not in self.variants:
            known = ", ".join(self.variants)
            raise ValueError(f"scene {self.name!r} has no variant {name!r}{meant(name, self.variants)}; known: {known}")
        return self.variants[name]

    def settings(self, variant: str | None = None, changes: Parameters | None = None) -> dict[str, Any]:
        """Return all parameters: defaults, replaced by those of a variant, replaced by `changes`.

        `changes` holds numbers, traced or not, or text that is read as a number.

        **Raises:** `ValueError` for an unknown name, for a value that is not a finite number, and for a count that
        is not an integer of at least one.
        """
        checked = {name: self._checked(name, entry) for name, entry in (changes or {}).items()}
        return {**self.parameters, **self.variant(variant).parameters, **checked}

    def duration(self, variant: str | None = None) -> float:
        """Return the end time of a variant [s]."""
        t1 = self.variant(variant).t1
        return self.t1 if t1 is None else t1

    def _checked(self, name: str, entry: Any) -> Any:
        if name not in self.parameters:
            known = [*self.parameters]
            shown = ", ".join(known[:MOST_NAMES]) + (", ..." if len(known) > MOST_NAMES else "")
            raise ValueError(f"scene {self.name!r} has no parameter {name!r}{meant(name, known)}; known: {shown}")
        read = _count if isinstance(self.parameters[name], int) else _finite
        try:
            return read(entry)
        except (TypeError, ValueError) as error:
            kind = "an integer of at least 1" if read is _count else "a finite number"
            message = f"parameter {name!r} of scene {self.name!r} is {entry!r}; it must be {kind}"
            raise ValueError(message) from error


def described(name: str, **functions: Any) -> Scene:
    """The scene of that name in `scenes.toml`, with its functions: `mechanism`, `initial`, `points`, `exact`."""
    entry = _DESCRIBED[name]
    variants = {name: Variant(**variant) for name, variant in entry["variants"].items()}
    return Scene(
        name=name,
        summary=entry["summary"],
        parameters={name: default for name, (default, _) in entry["parameters"].items()},
        meanings={name: meaning for name, (_, meaning) in entry["parameters"].items()},
        variants=variants,
        default_variant=next(iter(variants)),
        t1=entry["t1"],
        **functions,
    )


def _count(entry: Any) -> int:
    count = int(number_in(entry, int)) if isinstance(entry, str) else operator.index(entry)
    if isinstance(entry, bool) or count < 1:
        raise ValueError
    return count


def _finite(entry: Any) -> Any:
    if isinstance(entry, bool):
        raise ValueError
    if concrete(entry) is None or hasattr(entry, "dtype"):
        return entry
    if not math.isfinite(number := number_in(entry) if isinstance(entry, str) else float(entry)):
        raise ValueError
    return number
