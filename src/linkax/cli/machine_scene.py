"""A machine from a file as a scene: what the command line simulates."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from linkax.machines.machine import Machine, Start
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
    variants = {name: Variant(f"at {name}") for name in starts}
    begin = starts.get(DRAWN if start is None else start)  # an unknown one is refused with the variants
    parameters = dict(_flat(machine.params))
    return Scene(
        name=machine.path.stem,
        summary=f"machine {machine.name!r} from {machine.path.name}",
        parameters=parameters,
        meanings={name: "" for name in parameters},
        variants=variants,
        default_variant=DRAWN,
        t1=T1,
        mechanism=lambda parameters: _mechanism(machine, parameters, hold),
        initial=lambda mechanism, parameters: _initial(mechanism, begin or starts[DRAWN], hold),
        points=lambda parameters: {name: (name, None) for name in _ends(machine.mechanism())},
    )


def _mechanism(machine: Machine, parameters: Mapping[str, Any], hold: Mapping[str, float]) -> Mechanism:
    drawn = dict(_flat(machine.params))
    changed = {name: entry for name, entry in parameters.items() if entry != drawn[name]}
    made = machine.mechanism(_nested(machine.params, changed))
    drives = [Drive(f"hold {joint}", joint, speed=0.0, start=at) for joint, at in hold.items()]
    return Mechanism(made.bodies, made.joints, made.forces, [*made.constraints, *drives]) if drives else made


def _initial(mechanism: Mechanism, start: Start, hold: Mapping[str, float]) -> State:
    return assemble(mechanism, hold, start.speeds, guess=start.positions)


def _flat(params: Any, prefix: str = "") -> Sequence[tuple[str, float]]:
    """(name, number) of all numbers, with [i] for entries of arrays."""
    if isinstance(params, Mapping):
        dot = prefix and prefix + "."
        return [pair for name, entry in params.items() for pair in _flat(entry, f"{dot}{name}")]
    array = np.asarray(params, dtype=float)
    return [(prefix + "".join(f"[{i}]" for i in index), float(array[index])) for index in np.ndindex(array.shape)]


def _nested(params: Any, changed: Mapping[str, float], prefix: str = "") -> dict[str, Any]:
    """What `Machine.mechanism` takes, of numbers that have changed."""
    found = {}
    for name, entry in params.items():
        full = f"{prefix}.{name}" if prefix else name
        own = {key: value for key, value in changed.items() if re.match(rf"{re.escape(full)}(\.|\[|$)", key)}
        if not own:
            continue
        if isinstance(entry, Mapping):
            found[name] = _nested(entry, own, full)
            continue
        array = np.array(entry, dtype=float)
        for index in np.ndindex(array.shape):
            key = full + "".join(f"[{i}]" for i in index)
            array[index] = own.get(key, array[index])
        found[name] = array
    return found


def _ends(mechanism: Mechanism) -> list[str]:
    """The bodies that carry no others in the tree, such as hands and feet."""
    topology = mechanism.topology
    ends = [name for index, name in enumerate(topology.bodies) if index not in topology.predecessor]
    return ends[-MOST_POINTS:]
