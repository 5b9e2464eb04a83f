"""From the graph of bodies and joints to a spanning tree and cut joints. Names and indices only."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np

from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.joint import AbstractJoint, JointKind, RelativeMotion
from linkax.model.terms import Term

GROUND_INDEX = -1


class JointGroup(NamedTuple):
    """Joints in the tree that move in the same way, by as many coordinates.

    - `motion`: the type of the joints, or their `motion` where it has one.
    - `bodies`: those that they carry. `coordinates`: where in q the coordinates lie that move each, (n, k).
    """

    motion: type[AbstractJoint] | RelativeMotion
    bodies: tuple[int, ...]
    coordinates: np.ndarray


@dataclasses.dataclass(frozen=True)
class Topology:
    """The static plan of a mechanism; equal plans share their compiled programs.

    Bodies are numbered from ground outwards, joint i < len(bodies) is the tree joint that
    carries body i, and the cut joints follow. Ground has index -1.

    - `predecessor`: the body that carries each body in the tree.
    - `parent`, `child`: bodies of each joint as it was declared.
    - `joint_types`: class of each joint, or what else says the same of it (see `AbstractJoint.kind`).
    - `driven_by`: for each joint whose motion depends on other coordinates than its own, what they are
      coordinates of, its own among them; None for the rest.
    - `rotation_rows`: (cut joint, i, j) of each loop row h₁ⁱ·h₂ʲ, `translation_rows`:
      (cut joint, i) of each loop row h₁ⁱ·s; cut joints and axes counted from 0. Rows that
      vanish identically are left out here, and kept in `immobile_rotation_rows` and
      `immobile_translation_rows`.
    - `constraints`: names of the constraints on coordinates of the tree, a row each, and
      `constraint_terms`: whose coordinates each one relates. `constraint_bodies`: those that it attaches to.

    Rows of the loop constraints: rotation rows, translation rows, a combined row for each cut
    joint whose type has one, and those of `constraints`.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    predecessor: tuple[int, ...]
    parent: tuple[int, ...]
    child: tuple[int, ...]
    joint_types: tuple[type[AbstractJoint] | JointKind, ...]
    driven_by: tuple[tuple[Term, ...] | None, ...]
    rotation_rows: tuple[tuple[int, int, int], ...]
    translation_rows: tuple[tuple[int, int], ...]
    immobile_rotation_rows: tuple[tuple[int, int, int], ...]
    immobile_translation_rows: tuple[tuple[int, int], ...]
    constraints: tuple[str, ...] = ()
    constraint_terms: tuple[tuple[Term, ...], ...] = ()
    constraint_bodies: tuple[tuple[int, ...], ...] = ()

    @property
    def num_bodies(self) -> int:
        return len(self.bodies)

    @cached_property
    def cut_types(self) -> tuple[type[AbstractJoint], ...]:
        """The classes of the cut joints."""
        return cast(tuple[type[AbstractJoint], ...], self.joint_types[self.num_bodies :])

    @property
    def num_cuts(self) -> int:
        return len(self.joints) - len(self.bodies)

    @property
    def num_rows(self) -> int:
        plain = len(self.rotation_rows) + len(self.translation_rows)
        return plain + len(self.combining) + len(self.constraints)

    @property
    def num_immobile_rows(self) -> int:
        """Loop rows that no motion changes."""
        return len(self.immobile_rotation_rows) + len(self.immobile_translation_rows)

    @cached_property
    def combining(self) -> tuple[int, ...]:
        """The cut joints with a combined row, counted from 0."""
        kinds = self.joint_types[self.num_bodies :]
        return tuple(i for i, kind in enumerate(kinds) if kind.combined_rotations or kind.combined_translations)

    @cached_property
    def coordinates(self) -> dict[str, slice]:
        """The coordinates of each tree joint in q."""
        return self._slices(lambda kind: len(kind.speed_units) + kind.has_quaternion)

    @cached_property
    def speeds(self) -> dict[str, slice]:
        """The speeds of each tree joint in v."""
        return self._slices(lambda kind: len(kind.speed_units))

    def _slices(self, count: Callable[[type[AbstractJoint] | JointKind], int]) -> dict[str, slice]:
        slices, start = {}, 0
        for name, kind in zip(self.joints[: self.num_bodies], self.joint_types, strict=False):
            slices[name] = slice(start, start + count(kind))
            start = slices[name].stop
        return slices

    def column(self, term: Term) -> int:
        """Where in v the speed of a term lies, of a joint in the tree."""
        return self.speeds[term.joint].start + (term.index or 0)

    def coordinate_slice(self, term: Term) -> slice:
        """Where in q the coordinates of a term lie, of a joint in the tree."""
        taken = self.coordinates[term.joint]
        if term.index is None:
            return taken
        place = taken.start + term.index + self.joint_types[self.joints.index(term.joint)].has_quaternion
        return slice(place, place + 1)

    def columns(self, body: int) -> np.ndarray:
        """Where in v the speeds lie that move a body on its predecessor."""
        driven_by, taken = self.driven_by[body], self.speeds[self.joints[body]]
        if driven_by is None:
            return np.arange(taken.start, taken.stop)
        return np.array([self.column(term) for term in driven_by], dtype=int)

    @cached_property
    def motions(self) -> np.ndarray:
        """All pairs of a body and a speed that moves it on its predecessor, (n_m, 2), in the order of bodies."""
        pairs = [(body, column) for body in range(self.num_bodies) for column in self.columns(body)]
        return np.array(pairs, dtype=int).reshape(-1, 2)

    @property
    def moved_body(self) -> np.ndarray:
        """The bodies of `motions`, (n_m,)."""
        return self.motions[:, 0]

    @cached_property
    def motion_column(self) -> np.ndarray | None:
        """The speeds of `motions`, (n_m,); None where each speed moves one body, so that they are in order."""
        columns = self.motions[:, 1]
        return None if np.array_equal(columns, np.arange(self.num_speeds)) else columns

    @cached_property
    def num_speeds(self) -> int:
        """n_v."""
        return sum(len(kind.speed_units) for kind in self.joint_types[: self.num_bodies])

    @property
    def num_coordinates(self) -> int:
        """n_q: the speeds, and one more for each quaternion."""
        return self.num_speeds + len(self.quaternions)

    @cached_property
    def quaternions(self) -> np.ndarray:
        """Where in q each quaternion lies, and where in v its angular velocity begins, (n, 2)."""
        kinds = zip(self.joints[: self.num_bodies], self.joint_types, strict=False)
        starts = [
            (self.coordinates[name].start, self.speeds[name].start) for name, kind in kinds if kind.has_quaternion
        ]
        return np.array(starts, dtype=int).reshape(-1, 2)

    @cached_property
    def plain(self) -> np.ndarray:
        """Where in q and in v the coordinates lie whose rates are speeds, (n, 2)."""
        q, v = np.arange(self.num_coordinates), np.arange(self.num_speeds)
        turning = self.quaternions[:, None, :]
        in_q, in_v = turning[..., 0] + np.arange(4), turning[..., 1] + np.arange(3)
        return np.stack([np.setdiff1d(q, in_q), np.setdiff1d(v, in_v)], axis=-1)

    @cached_property
    def joint_groups(self) -> tuple["JointGroup", ...]:
        """The joints in the tree by what their motion is."""
        of_motion = {}
        for body, kind in enumerate(self.joint_types[: self.num_bodies]):
            driven_by = self.driven_by[body]
            alike = (kind, None) if driven_by is None else (kind.motion, len(driven_by))
            of_motion.setdefault(alike, []).append(body)
        return tuple(
            JointGroup(motion, tuple(bodies), self._read_by(bodies)) for (motion, _), bodies in of_motion.items()
        )

    def _read_by(self, bodies: list[int]) -> np.ndarray:
        places = []
        for body in bodies:
            driven_by, own = self.driven_by[body], self.coordinates[self.joints[body]]
            terms = [own] if driven_by is None else map(self.coordinate_slice, driven_by)
            places.append([place for taken in terms for place in range(taken.start, taken.stop)])
        return np.array(places, dtype=int)

    @cached_property
    def slides(self) -> np.ndarray:
        """Which speeds are of lengths [m/s], shape (n_v,)."""
        kinds = self.joint_types[: self.num_bodies]
        return np.array([unit == "m" for kind in kinds for unit in kind.speed_units], dtype=bool)

    def _moving(self, bodies: np.ndarray) -> np.ndarray:
        """The speeds that move some of the bodies on their predecessors, (n_b,) not zero."""
        return np.unique(self.motions[bodies[self.moved_body] != 0.0, 1])

    @cached_property
    def read_by_rows(self) -> tuple[np.ndarray, ...]:
        """The speeds that each loop row can depend on."""
        around = [self._moving(bodies) for bodies in self.loop]
        of_constraints = [
            np.unique([*map(self.column, terms), *(c for body in bodies for c in self._moving(self.path[body]))])
            for terms, bodies in zip(self.constraint_terms, self.constraint_bodies, strict=True)
        ]
        plain = [cut for cut, *_ in (*self.rotation_rows, *self.translation_rows)]
        return (*(around[cut] for cut in (*plain, *self.combining)), *(found.astype(int) for found in of_constraints))

    @cached_property
    def coupled_by_inertia(self) -> tuple[np.ndarray, ...]:
        """Sets of speeds between which the mass matrix has entries: those on the way from ground to each body."""
        return tuple(self._moving(on_path) for on_path in self.path[:-1])

    @cached_property
    def reversed(self) -> np.ndarray:
        """Tree joints that the tree runs through from child to parent, shape (n_b,)."""
        return np.array(self.predecessor) == np.array(self.child[: self.num_bodies])

    @cached_property
    def path(self) -> np.ndarray:
        """path[i, j] = 1 where body j lies on the way from ground to body i, itself included.

        Row -1, a row of zeros, is ground. Shape (n_b + 1, n_b).
        """
        path = np.zeros((self.num_bodies + 1, self.num_bodies))
        for body, carrier in enumerate(self.predecessor):
            path[body] = path[carrier]
            path[body, body] = 1.0
        return path

    @cached_property
    def loop(self) -> np.ndarray:
        """+1 for tree joints from the loop's common ancestor to the cut joint's child, -1 to its parent."""
        cuts = slice(self.num_bodies, None)
        return self.path[list(self.child[cuts])] - self.path[list(self.parent[cuts])]

    @cached_property
    def root(self) -> np.ndarray:
        """The first body on the way from ground to each body, -1 for ground, shape (n_b + 1,)."""
        root = np.full(self.num_bodies + 1, GROUND_INDEX)
        for body, carrier in enumerate(self.predecessor):
            root[body] = body if carrier == GROUND_INDEX else root[carrier]
        return root

    def describe(self) -> str:
        """The spanning tree, the cut joints and the constraints on coordinates, a line for each."""
        lines = []
        for index, name in enumerate(self.joints):
            ends = [
                GROUND_NAME if end == GROUND_INDEX else self.bodies[end]
                for end in (self.parent[index], self.child[index])
            ]
            role = "tree" if index < self.num_bodies else "cut"
            lines.append(f"{role:4} {self.joint_types[index].__name__} {name!r}: {ends[0]} - {ends[1]}")
        for name, terms, bodies in zip(self.constraints, self.constraint_terms, self.constraint_bodies, strict=True):
            ends = [GROUND_NAME if body == GROUND_INDEX else self.bodies[body] for body in bodies]
            lines.append(f"row  {name!r}: {', '.join([*(repr(term.joint) for term in terms), *ends])}")
        return "\n".join(lines)
