"""A machine as a file describes it: data, parameters by name, and the mechanism that they make."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

from linkax.machines.parts import Part
from linkax.machines.xml import Where
from linkax.model.mechanism import Mechanism
from linkax.model.names import meant
from linkax.model.shapes import Shape
from linkax.tables import Rows, Table, count, printed_as

GROUPS = ("bodies", "joints", "forces", "constraints")


class LeftOut(NamedTuple):
    """What a file asks for and a machine does not have.

    - `where`: the element of the file. `kind`: the word for it in `ignore` of `linkax.load`.
    - `reason`: why it is left out.
    """

    where: Where
    kind: str
    reason: str

    def __str__(self) -> str:
        return f"{self.where}: {self.reason}"


class Start(NamedTuple):
    """Where a motion may begin, as `linkax.assemble` takes it: `positions` and `speeds`, {joint: coordinates}."""

    positions: dict[str, Any]
    speeds: dict[str, Any]


def _table(machine: "Machine") -> Table:
    kinds = lambda parts: ", ".join(
        f"{number} {kind}" for kind, number in Counter(part.kind.__name__ for part in parts).items()
    )
    rows = [(group, str(len(parts)), kinds(parts)) for group in GROUPS if (parts := getattr(machine, group))]
    left_out = [(f"{where.path.name}:{where.line}", kind, why) for where, kind, why in machine.left_out]
    parts = [Rows(("", "", ""), rows, "groups")]
    parts += [Rows(("left out", "kind", "why"), left_out, "things")] if left_out else []
    starts = f"; starts: {', '.join(machine.starts)}" if machine.starts else ""
    title = f"Machine {machine.name!r} from {machine.path.name}, {count(len(machine.left_out), 'thing')} left out"
    return Table(title + starts, parts)


@printed_as(_table)
@dataclasses.dataclass(frozen=True)
class Machine:
    """What a file says of a machine, made by `linkax.load`.

    - `name`, `path`: of the machine and its file.
    - `bodies`, `joints`, `forces`, `constraints`: its elements as data, each with the line of the file; a part's
      `arguments` are those of the class of linkax that it becomes.
    - `starts`: states that the file names, {name: `positions` and `speeds` for `linkax.assemble`}.
    - `left_out`: what the file asks for and the machine does not have, with line and reason.

    Its bodies know what they are drawn as, `shapes`, and so do the mechanisms that it makes, and their views.
    Coordinates are zero where the machine stands as the file draws it. A frame on a body is that of the file.
    """

    name: str
    path: Path
    bodies: tuple[Part, ...]
    joints: tuple[Part, ...]
    forces: tuple[Part, ...]
    constraints: tuple[Part, ...]
    starts: Mapping[str, Start] = dataclasses.field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()

    @property
    def params(self) -> dict[str, Any]:
        """Its numbers by name: {"bodies": {"pelvis": {"mass": 10.33, ...}, ...}, "joints": ..., "forces": ...}.

        Bodies have `mass` [kg], `center_of_mass` [m] and `inertia` [kg m²] in their frame; joints have `parent` and
        `child`, where they attach to both bodies [m]; others what their class takes. Directions are structure.
        """
        found = {group: {part.name: part.params for part in getattr(self, group)} for group in GROUPS}
        found = {group: {name: numbers for name, numbers in of.items() if numbers} for group, of in found.items()}
        return {group: of for group, of in found.items() if of}

    @property
    def shapes(self) -> dict[str, tuple[Shape, ...]]:
        """What its bodies are drawn as, {body: shapes}, without those of which the file says nothing."""
        return {part.name: part.arguments["shape"] for part in self.bodies if "shape" in part.arguments}

    def mechanism(self, params: Mapping[str, Any] | None = None) -> Mechanism:
        """Make the mechanism, a pure function of parameters.

        **Arguments:** `params`: as `Machine.params`, or a part of it; what it leaves out has the numbers of the file.

        **Raises:** `ValueError` for a name that the machine does not have, and a number that an element cannot have.
        """
        params = {} if params is None else params
        for group, of in params.items():
            if group not in GROUPS:
                raise ValueError(f"params has {group!r}{meant(group, GROUPS)}; known: {', '.join(GROUPS)}")
            names = {part.name for part in getattr(self, group)}
            for name in of:
                if name not in names:
                    raise ValueError(
                        f"params[{group!r}] has {name!r}{meant(name, names)}, which {self.path.name} has not"
                    )
        built = [
            [part.built(params.get(group, {}).get(part.name, {})) for part in getattr(self, group)] for group in GROUPS
        ]
        return Mechanism(*built)

    def freeze(self, *patterns: str) -> "Machine":
        """Return the same machine with fewer parameters.

        **Arguments:** `patterns`: of dotted names with "*", such as "bodies.*.inertia"; numbers that fit one of them
        keep the values of the file.

        **Raises:** `ValueError` for a pattern that fits no parameter.
        """
        taken = set[str]()

        def frozen(group, part):
            names = {f"{group}.{part.name}.{name}": name for name in part.params}
            fits = {full for full in names for pattern in patterns if fnmatchcase(full, pattern)}
            taken.update(pattern for pattern in patterns if any(fnmatchcase(full, pattern) for full in names))
            return dataclasses.replace(part, frozen=part.frozen | {names[full] for full in fits})

        groups = {group: tuple(frozen(group, part) for part in getattr(self, group)) for group in GROUPS}
        self._check_taken(patterns, taken, "parameter, such as 'bodies.*.inertia'")
        return dataclasses.replace(self, **groups)

    def without(self, *patterns: str) -> "Machine":
        """Return the same machine without some of its joints, forces and constraints.

        **Arguments:** `patterns`: of names with "*", such as "left-*" or "*.limit". Forces along a joint and
        constraints that relate it go with it.

        **Raises:** `ValueError` for a pattern that fits no name.
        """
        groups = {group: getattr(self, group) for group in GROUPS[1:]}
        fits = lambda name: any(fnmatchcase(name, pattern) for pattern in patterns)
        taken = {p for p in patterns for of in groups.values() for part in of if fnmatchcase(part.name, p)}
        self._check_taken(patterns, taken, "joint, force or constraint")
        joints = {part.name for part in self.joints if fits(part.name)}
        stays = lambda part: not fits(part.name) and not joints & set(acts_along(part))
        kept = {group: tuple(filter(stays, of)) for group, of in groups.items()}
        return dataclasses.replace(self, **kept)

    def _check_taken(self, patterns, taken, what):
        for pattern in patterns:
            if pattern not in taken:
                raise ValueError(f"pattern {pattern!r} fits no {what} of {self.path.name}")


def acts_along(part: Part) -> Iterable[str]:
    """Names of the joints that a force acts along, or a constraint relates."""
    for name in ("joint", "transmission", "coefficients", "of"):
        entry = part.arguments.get(name)
        if isinstance(entry, Mapping):
            yield from (key if isinstance(key, str) else key[0] for key in entry)
        elif entry is not None and not hasattr(entry, "shape"):
            yield entry if isinstance(entry, str) else entry[0]
