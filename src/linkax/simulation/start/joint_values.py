"""Numbers for joints, coordinates or speeds, beside what the joints have; joints of one type at once."""

from collections.abc import Callable, Sequence
from itertools import count
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import Configuration, wrapped
from linkax.equations.motion import Motion
from linkax.model.joints.joint import AbstractJoint, JointKind
from linkax.model.numbers import namespace
from linkax.model.terms import Term
from linkax.model.topology import Topology
from linkax.spatial.quaternions import conjugate, multiply, normalised, rotation_vector
from linkax.xla.arrays import Array


class TermsAlike(NamedTuple):
    """Terms of joints of one type, all of the tree or all cut, and all with the same index."""

    terms: tuple[Term, ...]
    kind: type[AbstractJoint] | JointKind
    index: int | None
    in_tree: bool

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the speeds of each term."""
        return self.kind.speed_units if self.index is None else (self.kind.speed_units[self.index],)

    @property
    def names(self) -> list[str]:
        """The joints."""
        return [along.joint for along in self.terms]

    def in_q(self, topology: Topology) -> Int[np.ndarray, "k n"]:
        """Where their coordinates lie, of joints of the tree."""
        return np.stack([np.arange(topology.num_coordinates)[topology.coordinate_slice(along)] for along in self.terms])

    def coordinates(self, configuration: Configuration) -> Float[Array, "k n"]:
        """Read their coordinates."""
        if self.in_tree:
            return configuration.q[self.in_q(configuration.system.topology)]
        found = configuration.cut_coordinates(self.names)
        return found if self.index is None else found[:, self.index + self.kind.has_quaternion, None]

    def speeds(self, motion: Motion) -> Float[Array, "k n"]:
        """Read their speeds."""
        topology = motion.system.topology
        if self.in_tree:
            found = motion.v[np.stack([np.arange(topology.num_speeds)[topology.speeds[name]] for name in self.names])]
        else:
            found = motion.cut_speeds(self.names)
        return found if self.index is None else found[:, self.index, None]

    def apart(self, configuration: Configuration, ends: Float[Array, "k n"]) -> Float[Array, "k n_speeds"]:
        """Changes that lead from coordinates `ends` to their own, one number for each speed."""
        found, is_angle = self.coordinates(configuration), np.array(self.kind.speed_units) == "rad"
        if self.index is not None:
            is_angle = is_angle[self.index, None]
        elif self.kind.has_quaternion:
            turned = rotation_vector(multiply(found[:, :4], conjugate(normalised(ends[:, :4]))))
            return jnp.concatenate([turned, self._moved(found[:, 4:] - ends[:, 4:], is_angle[3:])], axis=1)
        return self._moved(found - ends, is_angle)

    def _moved(self, change, is_angle):
        return change if self.in_tree else wrapped(change, is_angle)


class JointValues(eqx.Module):
    """Numbers for joints: one for a term with an index, else all of the joint's.

    - `groups`: whose they are. `values`: a row for each term, for each group.
    """

    groups: tuple[TermsAlike, ...] = eqx.field(static=True)
    values: tuple[Float[Array, "_ _"], ...]

    @staticmethod
    def of(topology: Topology, pairs: Sequence[tuple[Term, Float[Array, " _"]]]) -> "JointValues":
        """Those of terms."""
        alike = {}
        for along, entry in pairs:
            kind = topology.joint_types[topology.joints.index(along.joint)]
            alike.setdefault((kind, along.index, along.joint in topology.speeds), []).append((along, entry))
        groups = tuple(TermsAlike(tuple(along for along, _ in own), *common) for common, own in alike.items())
        rows = [[entry for _, entry in own] for own in alike.values()]
        return JointValues(groups, tuple(namespace(*entries).stack(entries) for entries in rows))

    def by_term(self) -> list[tuple[Term, Float[Array, " _"]]]:
        """Terms with their numbers."""
        of_groups = zip(self.groups, self.values, strict=True)
        return [pair for alike, rows in of_groups for pair in zip(alike.terms, rows, strict=True)]

    def of_cuts(self) -> "JointValues":
        """Those of cut joints."""
        kept = [index for index, alike in enumerate(self.groups) if not alike.in_tree]
        return JointValues(tuple(self.groups[index] for index in kept), tuple(self.values[index] for index in kept))

    def slides(self) -> Bool[np.ndarray, " _"]:
        """Which changes, of those that `apart` gives, are lengths, in the order of `flat`."""
        lengths = [unit == "m" for alike in self.groups for _ in alike.terms for unit in alike.units]
        return np.array(lengths, dtype=bool)

    def flat(self) -> Float[Array, " _"]:
        """All numbers."""
        return jnp.concatenate([*map(jnp.ravel, self.values)] or [jnp.zeros(0)])

    def filled(self, numbers: Float[Array, " _"]) -> "JointValues":
        """Other numbers for the same terms, in the order of `flat`."""
        parts = jnp.split(numbers, np.cumsum([rows.size for rows in self.values])[:-1])
        return JointValues(
            self.groups, tuple(part.reshape(rows.shape) for part, rows in zip(parts, self.values, strict=False))
        )

    def apart(self, configuration: Configuration) -> "JointValues":
        """Changes of the joints from these coordinates to their own, one number for each speed."""
        of_groups = zip(self.groups, self.values, strict=True)
        return JointValues(self.groups, tuple(alike.apart(configuration, ends) for alike, ends in of_groups))

    def speeds(self, motion: Motion) -> "JointValues":
        """Speeds of the same joints."""
        return JointValues(self.groups, tuple(alike.speeds(motion) for alike in self.groups))

    def slopes(
        self, function: Callable[[Float[Array, " n_v"]], "JointValues"], topology: Topology, dtype: np.dtype
    ) -> Float[Array, "_ n_v"]:
        """Derivatives at zero of all numbers that a function of changes, or speeds, finds for these joints.

        Speeds that change no joint's numbers together are one direction (Curtis, Powell, Reid, Journal of the
        Institute of Mathematics and its Applications 13, 1974).
        """
        read = [[topology.read_by_joint(name) for name in alike.names] for alike in self.groups]
        directions = _directions([columns for group in read for columns in group], topology.num_speeds)
        first = jnp.zeros(np.max(directions, initial=0) + 1, dtype)
        slopes, found = jax.jacfwd(lambda along: function(along[directions]).values)(first), []
        for rows, columns in zip(slopes, read, strict=True):
            reads = np.stack([np.isin(np.arange(topology.num_speeds), of_joint) for of_joint in columns])
            found.append(jnp.where(reads[:, None, :], rows[:, :, directions], 0.0).reshape(-1, topology.num_speeds))
        return jnp.concatenate([jnp.zeros((0, topology.num_speeds), dtype), *found])


def _directions(read, size):
    """Number columns, (size,), so that those read together have different numbers, of which there are few."""
    together, numbers = [set(columns.tolist()) for columns in read], []
    for column in range(size):
        beside = set().union(*(columns for columns in together if column in columns))
        taken = {numbers[other] for other in beside if other < column}
        numbers.append(next(number for number in count() if number not in taken))
    return np.array(numbers)
