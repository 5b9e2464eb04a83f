"""A machine from a file as a scene: what the command line simulates."""

import dataclasses
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from linkax.machines.machine import Machine, Start
from linkax.machines.parts import Part
from linkax.model.constraints.constraint import Drive
from linkax.model.mechanism import Mechanism
from linkax.model.names import meant
from linkax.scenes.scene import Scene, Variant
from linkax.simulation.start.assembly import assemble
from linkax.simulation.start.state import State

DRAWN = "drawn"  # the start at coordinates of zero
T1 = 1.0  # end time [s]
MOST_POINTS = 8  # bodies whose places are told


def machine_scene(machine: Machine, start: str | None = None, hold: Mapping[str, float] | None = None) -> Scene:
    """Make a scene of a machine; its parameters are the numbers of the file by dotted names.

    **Arguments:** `start`: one of `machine.starts`, by default as drawn; `hold`: {joint: coordinate that a motor keeps,
    [rad or m]}.

    **Raises:** `ValueError` for an unknown start or joint.
    """
    hold = {} if hold is None else hold
    joints = [part.name for part in machine.joints]
    for joint in hold:
        if joint not in joints:
            raise ValueError(f"{machine.path.name} has no joint {joint!r} to hold{meant(joint, joints)}")
    starts = {DRAWN: Start({}, {}), **machine.starts}
    begin = starts.get(DRAWN if start is None else start, starts[DRAWN])  # an unknown one is refused with the variants
    held = dataclasses.replace(machine, constraints=(*machine.constraints, *_motors(machine, hold)))
    drawn = {name: float(array[at]) for path, array in _arrays(machine.params) for name, at in _entries(path, array)}

    @lru_cache(maxsize=1)
    def made(*changed: tuple[str, float]) -> Mechanism:
        return held.mechanism(_nested(machine.params, dict(changed)))

    def mechanism(parameters: Mapping[str, Any]) -> Mechanism:
        return made(*(pair for pair in parameters.items() if pair not in drawn.items()))

    return Scene(
        name=machine.path.stem,
        summary=f"machine {machine.name!r} from {machine.path.name}",
        parameters=drawn,
        meanings={name: "" for name in drawn},
        variants={name: Variant(f"at {name}") for name in starts},
        default_variant=DRAWN,
        t1=T1,
        mechanism=mechanism,
        initial=lambda mechanism, parameters: _initial(mechanism, begin, hold),
        points=lambda parameters: {name: (name, None) for name in _ends(mechanism(parameters))},
    )


def _motors(machine: Machine, hold: Mapping[str, float]) -> Iterator[Part]:
    """Drives of the joints that are held."""
    for joint in machine.joints:
        if joint.name in hold:
            arguments = {"name": f"hold {joint.name}", "joint": joint.name, "speed": 0.0, "start": hold[joint.name]}
            yield Part(Drive, arguments, joint.where, frozenset(arguments))


def _initial(mechanism: Mechanism, start: Start, hold: Mapping[str, float]) -> State:
    return assemble(mechanism, hold, start.speeds, guess=start.positions)


def _arrays(params: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """All numbers as arrays, each with the names that lead to it."""
    if not isinstance(params, Mapping):
        yield path, np.array(params, dtype=float)
        return
    for name, entry in params.items():
        yield from _arrays(entry, (*path, name))


def _entries(path: tuple[str, ...], array: np.ndarray) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The dotted name of each entry, with [i] in an array, and its index."""
    for index in np.ndindex(array.shape):
        yield ".".join(path) + "".join(f"[{i}]" for i in index), index


def _nested(params: Any, changed: Mapping[str, float]) -> dict[str, Any]:
    """What `Machine.mechanism` takes, of numbers that have changed."""
    found = {}
    for path, array in _arrays(params):
        own = {index: changed[name] for name, index in _entries(path, array) if name in changed}
        if not own:
            continue
        for index, number in own.items():
            array[index] = number
        *groups, last = path
        inner = found
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = array
    return found


def _ends(mechanism: Mechanism) -> list[str]:
    """The bodies that carry no others in the tree, such as hands and feet."""
    topology = mechanism.topology
    ends = [name for index, name in enumerate(topology.bodies) if index not in topology.predecessor]
    return ends[-MOST_POINTS:]
