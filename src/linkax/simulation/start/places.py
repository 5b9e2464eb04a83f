"""What users give for bodies and points in the world, as numbers for joints that only measure.

A `Free` joint that is cut constrains nothing, and its coordinates and speeds are those of a body in the world.
"""

import copy
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from linkax.model.beams import Beam
from linkax.model.bodies import GROUND, GROUND_NAME, Frame
from linkax.model.joints.free import Free
from linkax.model.mechanism import Mechanism
from linkax.model.names import meant
from linkax.model.numbers import number, require_type, rotation_matrix, value
from linkax.model.poses import Pose, Velocity
from linkax.model.terms import Term
from linkax.spatial.quaternions import from_rotation_matrix
from linkax.xla.arrays import Array
from linkax.xla.tracing import concrete, evaluate_now

SUFFIX = " in the world"  # of the name of a joint that measures
TURNS, MOVES = (0, 1, 2), (3, 4, 5)  # indices of the speeds of a `Free`


def called(joint: str) -> str:
    """What messages call a joint, or the place that it measures."""
    return f"{joint.removesuffix(SUFFIX)!r}{SUFFIX}" if joint.endswith(SUFFIX) else f"joint {joint!r}"


class Places:
    """Mappings that users give, with bodies and points replaced by joints that measure them.

    - `measures`: these joints by name.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism, self.measures = mechanism, dict[str, Free]()

    def positions(self, given: Mapping[Any, Any] | None, what: str) -> Mapping[Any, Any] | None:
        """Replace `Pose` and positions of points."""
        return self._replaced(given, what, Pose)

    def speeds(self, given: Mapping[Any, Any] | None, what: str) -> Mapping[Any, Any] | None:
        """Replace `Velocity` and velocities of points."""
        return self._replaced(given, what, Velocity)

    def measured(self) -> Mechanism:
        """The mechanism with the joints that measure, which change neither its tree nor its rows."""
        if not self.measures:
            return self.mechanism
        found = copy.copy(self.mechanism)
        object.__setattr__(found, "joints", (*found.joints, *self.measures.values()))
        object.__setattr__(found, "topology", found.topology.with_measures([*self.measures.values()]))
        return found

    def _replaced(self, given, what, kind):
        given = require_type({} if given is None else given, Mapping, what, "give {joint: number, ...}")
        for key, entry in given.items():
            if isinstance(key, str) and key not in self.mechanism.topology.joints and not self._is_place(key, entry):
                raise ValueError(self._unknown(key, what))
        if not any(map(self._is_place, given, given.values())):
            return given
        found = {}
        for key, entry in given.items():
            terms = self._terms(key, entry, what, kind) if self._is_place(key, entry) else [(key, entry)]
            for term, numbers in terms:
                if term in found:
                    raise ValueError(f"{what} of {key!r} is given twice; give it once")
                found[term] = numbers
        return found

    def _is_place(self, key, entry) -> bool:
        return isinstance(entry, Pose | Velocity) or (
            isinstance(key, str)
            and key not in self.mechanism.topology.joints
            and any(name in self.mechanism.topology.bodies for name, _ in _parts(key))
        )

    def _terms(self, key, entry, what, kind) -> Iterator[tuple[Term, Any]]:
        """Terms of the joint that measures a place, and their numbers."""
        frame, name = self._frame(key, what), f"{key}{SUFFIX}"
        if isinstance(entry, Pose | Velocity) and not isinstance(entry, kind):
            raise ValueError(f"{what} of {key!r} is {entry!r}; give a lx.{kind.__name__}")
        anchor = _anchor(self.mechanism, frame.body)
        self.measures[name] = Free(name, GROUND.at(anchor), frame, cut=True)
        if kind is Velocity:
            entry = entry if isinstance(entry, Velocity) else Velocity(entry)
            for part, unit, indices in ((entry.angular, "rad/s", TURNS), (entry.linear, "m/s", MOVES)):
                if part is not None:
                    yield from _of_indices(name, number(part, (3,), f"{what} of {key!r} [{unit}]"), indices)
            return
        entry = entry if isinstance(entry, Pose) else Pose(entry)
        position = number(entry.position, (3,), f"{what} of {key!r} [m]") - anchor
        if entry.orientation is None:
            yield from _of_indices(name, position, MOVES)
            return
        quaternion = quaternion_of(value(rotation_matrix(entry.orientation, f"orientation of {key!r}")))
        xp = np if concrete(position) is not None and concrete(quaternion) is not None else jax.numpy
        yield Term(name, None), xp.concatenate([quaternion, position])

    def _frame(self, key, what) -> Frame:
        bodies = (*self.mechanism.topology.bodies, *(beam.name for beam in self.mechanism.beams))
        for name, label in _parts(key) if isinstance(key, str) else ():
            if name not in bodies:
                continue
            body = self.mechanism.body(name)
            if isinstance(body, Beam):
                raise ValueError(
                    f"{what} of {key!r}, which is a beam and bends; give one of its sections, such as "
                    f"{body.sections[0]!r}"
                )
            return body.reference if label is None else body.at(label)
        raise ValueError(self._unknown(key, what))

    def _unknown(self, key, what) -> str:
        joints, bodies = self.mechanism.topology.joints, self.mechanism.bodies
        places = [name for body in bodies for name in (body.name, *(f"{body.name}.{label}" for label in body.frames))]
        listed = lambda names: ", ".join(map(repr, names))
        return (
            f"{what} of unknown joint or body {key!r}{meant(key, [*joints, *places])}; known joints: {listed(joints)}; "
            f"known bodies, and frames on them: {listed(places)}"
        )


def _parts(key: str) -> Iterator[tuple[str, str | None]]:
    """The ways to read a key: a body, or a body and a frame on it."""
    yield key, None
    for place, letter in enumerate(key):
        if letter == ".":
            yield key[:place], key[place + 1 :]


def _of_indices(name, numbers, indices) -> Iterator[tuple[Term, Array]]:
    for index, entry in zip(indices, numbers, strict=True):
        yield Term(name, index), entry


def _anchor(mechanism: Mechanism, body: str) -> Float[Array, "3"]:
    """Where the tree that carries a body begins: far from the world's origin, places count from there."""
    topology = mechanism.topology
    joint = mechanism.joints[topology.root[topology.bodies.index(body)]]
    return (joint.parent if joint.parent.body == GROUND_NAME else joint.child).offset


def quaternion_of(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Quaternion of a rotation matrix, of NumPy where it is known."""
    if concrete(rotation) is None:
        return from_rotation_matrix(rotation)
    return np.asarray(evaluate_now(_quaternion, rotation))


_quaternion = jax.jit(from_rotation_matrix)
