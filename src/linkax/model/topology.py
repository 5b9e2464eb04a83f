"""The plan of a mechanism: its tree, its loops, and where coordinates and rows lie. Names and indices only."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.joint import AbstractJoint, JointKind, RelativeMotion
from linkax.model.joints.table_joint import TableJoint
from linkax.model.names import ByName, find
from linkax.model.terms import Term

GROUND_INDEX = -1


class JointGroup(NamedTuple):
    """Joints in the tree that move in the same way, by equally many coordinates.

    - `motion`: the type of the joints, or its `motion` where it has one.
    - `bodies`: the bodies that they carry.
    - `coordinates`: indices in q of the coordinates that move each, (n, k).
    """

    motion: type[TableJoint] | RelativeMotion
    bodies: tuple[int, ...]
    coordinates: np.ndarray


@dataclasses.dataclass(frozen=True)
class Topology:
    """The static plan of a mechanism. Equal plans share compiled programs.

    Bodies are numbered from ground outwards; ground has index -1. Joint i < len(bodies) carries body i in the
    tree, and the cut joints follow.

    - `predecessor`: the body that carries each body in the tree.
    - `parent`, `child`: the bodies of each joint as declared.
    - `joint_types`: the class of each joint, or its `JointKind` (see `AbstractJoint.kind`).
    - `driven_by`: for each joint that other coordinates than its own move, the terms of all that move it; None for
      other joints.
    - `rotation_rows`: (cut joint, i, j) of each loop row h₁ⁱ·h₂ʲ; cut joints and axes counted from 0.
    - `translation_rows`: (cut joint, i) of each loop row h₁ⁱ·s.
    - `immobile_rotation_rows`, `immobile_translation_rows`: rows that no motion changes, which are left out of these.
    - `constraints`: names of the constraints besides cut joints, `constraint_rows`, how many rows each has, and
      `constraint_slips`, how many of these, the last, are of speeds alone.
    - `constraint_terms`: the terms that each constraint reads.
    - `constraint_bodies`: the bodies that each constraint attaches to.

    The loop constraints have rotation rows, translation rows, a combined row for each cut joint whose type has
    one, and the rows of `constraints`, in this order.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    predecessor: tuple[int, ...]
    parent: tuple[int, ...]
    child: tuple[int, ...]
    joint_types: tuple[type[TableJoint] | JointKind, ...]
    driven_by: tuple[tuple[Term, ...] | None, ...]
    rotation_rows: tuple[tuple[int, int, int], ...]
    translation_rows: tuple[tuple[int, int], ...]
    immobile_rotation_rows: tuple[tuple[int, int, int], ...]
    immobile_translation_rows: tuple[tuple[int, int], ...]
    constraints: tuple[str, ...] = ()
    constraint_rows: tuple[int, ...] = ()
    constraint_slips: tuple[int, ...] = ()
    constraint_terms: tuple[tuple[Term, ...], ...] = ()
    constraint_bodies: tuple[tuple[int, ...], ...] = ()

    @cached_property
    def _hash(self):
        return hash(tuple(self.__getstate__().values()))

    # Each program that is handed a state asks for it.
    def __hash__(self) -> int:
        return self._hash

    # What is cached, hashes of strings among it, belongs to one process.
    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def num_bodies(self) -> int:
        """n_b."""
        return len(self.bodies)

    def body_index(self, name: str) -> int:
        """Find the index of a body, or of ground. **Raises:** `ValueError` for an unknown name."""
        return GROUND_INDEX if name == GROUND_NAME else find(name, self.bodies, "body")

    def joint_index(self, name: str) -> int:
        """Find the index of a joint, in the tree or cut. **Raises:** `ValueError` for an unknown name."""
        return find(name, self.joints, "joint")

    @cached_property
    def cut_types(self) -> tuple[type[TableJoint], ...]:
        """The classes of the cut joints."""
        return cast(tuple[type[TableJoint], ...], self.joint_types[self.num_bodies :])

    @property
    def num_cuts(self) -> int:
        """Number of cut joints."""
        return len(self.joints) - len(self.bodies)

    @property
    def num_rows(self) -> int:
        """Number of rows of the loop constraints."""
        plain = len(self.rotation_rows) + len(self.translation_rows)
        return plain + len(self.combining) + self.num_constraint_rows

    @property
    def num_constraint_rows(self) -> int:
        """Number of rows of `constraints`, which come last."""
        return sum(self.constraint_rows)

    @cached_property
    def slips(self) -> np.ndarray:
        """Which rows are of speeds alone, without a residual, (m,)."""
        counts = zip(self.constraint_rows, self.constraint_slips, strict=True)
        of_constraints = [slips for rows, count in counts for slips in (rows - count) * [False] + count * [True]]
        return np.array((self.num_rows - len(of_constraints)) * [False] + of_constraints, dtype=bool)

    @cached_property
    def constraint_of_row(self) -> np.ndarray:
        """The constraint that each of these rows belongs to, (k,)."""
        return np.repeat(np.arange(len(self.constraints)), self.constraint_rows)

    @property
    def num_immobile_rows(self) -> int:
        """Number of loop rows that no motion changes."""
        return len(self.immobile_rotation_rows) + len(self.immobile_translation_rows)

    @cached_property
    def combining(self) -> tuple[int, ...]:
        """Cut joints with a combined row, counted from 0."""
        kinds = self.joint_types[self.num_bodies :]
        return tuple(i for i, kind in enumerate(kinds) if kind.combined_rotations or kind.combined_translations)

    @cached_property
    def coordinates(self) -> dict[str, slice]:
        """Where the coordinates of each tree joint lie in q."""
        return self._slices(lambda kind: len(kind.speed_units) + kind.has_quaternion)

    @cached_property
    def speeds(self) -> dict[str, slice]:
        """Where the speeds of each tree joint lie in v."""
        return self._slices(lambda kind: len(kind.speed_units))

    def _slices(self, count: Callable[[type[TableJoint] | JointKind], int]) -> dict[str, slice]:
        slices, start = {}, 0
        for name, kind in zip(self.joints[: self.num_bodies], self.joint_types, strict=False):
            slices[name] = slice(start, start + count(kind))
            start = slices[name].stop
        return ByName(slices, "joint in the tree")

    def column(self, term: Term) -> int:
        """Find the index in v of the speed of a term; its joint must be in the tree."""
        return self.speeds[term.joint].start + (term.index or 0)

    def columns_of(self, term: Term) -> np.ndarray:
        """Find the indices in v of the speeds of a term; its joint must be in the tree."""
        return (
            np.arange(self.num_speeds)[self.speeds[term.joint]] if term.index is None else np.array([self.column(term)])
        )

    def coordinate_slice(self, term: Term) -> slice:
        """Find where in q the coordinates of a term lie; its joint must be in the tree."""
        taken = self.coordinates[term.joint]
        if term.index is None:
            return taken
        place = taken.start + term.index + self.joint_types[self.joints.index(term.joint)].has_quaternion
        return slice(place, place + 1)

    def columns(self, body: int) -> np.ndarray:
        """Find the indices in v of the speeds that move a body on its predecessor."""
        driven_by, taken = self.driven_by[body], self.speeds[self.joints[body]]
        if driven_by is None:
            return np.arange(taken.start, taken.stop)
        return np.array([self.column(term) for term in driven_by], dtype=int)

    @cached_property
    def motions(self) -> np.ndarray:
        """Pairs of a body and the index in v of a speed that moves it on its predecessor, (n_m, 2), by body."""
        pairs = [(body, column) for body in range(self.num_bodies) for column in self.columns(body)]
        return np.array(pairs, dtype=int).reshape(-1, 2)

    @property
    def moved_body(self) -> np.ndarray:
        """The bodies of `motions`, (n_m,)."""
        return self.motions[:, 0]

    @cached_property
    def motion_column(self) -> np.ndarray | None:
        """The indices in v of `motions`, (n_m,); None where they are 0, 1, …, as each speed moves one body."""
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
        """Indices where each quaternion begins in q, and its angular velocity in v, (n, 2)."""
        kinds = zip(self.joints[: self.num_bodies], self.joint_types, strict=False)
        starts = [
            (self.coordinates[name].start, self.speeds[name].start) for name, kind in kinds if kind.has_quaternion
        ]
        return np.array(starts, dtype=int).reshape(-1, 2)

    @cached_property
    def plain(self) -> np.ndarray:
        """Indices in q and in v of coordinates whose rates are speeds, (n, 2)."""
        q, v = np.arange(self.num_coordinates), np.arange(self.num_speeds)
        turning = self.quaternions[:, None, :]
        in_q, in_v = turning[..., 0] + np.arange(4), turning[..., 1] + np.arange(3)
        return np.stack([np.setdiff1d(q, in_q), np.setdiff1d(v, in_v)], axis=-1)

    @cached_property
    def joint_groups(self) -> tuple["JointGroup", ...]:
        """The joints in the tree, grouped by their motion."""
        of_motion = {}
        for body, kind in enumerate(self.joint_types[: self.num_bodies]):
            driven_by = self.driven_by[body]
            count = len(kind.speed_units if driven_by is None else driven_by)
            alike = (kind, None) if kind.motion is None else (kind.motion, count)
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
        """Which speeds are in m/s, (n_v,)."""
        kinds = self.joint_types[: self.num_bodies]
        return np.array([unit == "m" for kind in kinds for unit in kind.speed_units], dtype=bool)

    def _moving(self, bodies: np.ndarray) -> np.ndarray:
        """Find the speeds that move bodies on their predecessors; `bodies`, (n_b,), is not zero for these."""
        return np.unique(self.motions[bodies[self.moved_body] != 0.0, 1])

    def read_by_joint(self, name: str) -> np.ndarray:
        """Indices in v of the speeds that a joint's coordinates depend on: its own, or those around its loop."""
        if name in self.speeds:
            return np.arange(self.num_speeds)[self.speeds[name]]
        return self._moving(self.loop[self.joints.index(name) - self.num_bodies])

    @cached_property
    def read_by_rows(self) -> tuple[np.ndarray, ...]:
        """Indices in v of the speeds that each loop row can depend on."""
        around = [self.read_by_joint(name) for name in self.joints[self.num_bodies :]]
        moving = lambda bodies: [self._moving(self.path[body]) for body in bodies]
        of_constraints = [
            np.unique(np.concatenate([*map(self.columns_of, terms), *moving(bodies)]))
            for terms, bodies in zip(self.constraint_terms, self.constraint_bodies, strict=True)
        ]
        of_constraints = [of_constraints[constraint] for constraint in self.constraint_of_row]
        plain = [cut for cut, *_ in (*self.rotation_rows, *self.translation_rows)]
        return (*(around[cut] for cut in (*plain, *self.combining)), *(found.astype(int) for found in of_constraints))

    @cached_property
    def coupled_by_inertia(self) -> tuple[np.ndarray, ...]:
        """Sets of speeds that the mass matrix couples: those on the way from ground to each body."""
        return tuple(self._moving(on_path) for on_path in self.path[:-1])

    @cached_property
    def reversed(self) -> np.ndarray:
        """Which tree joints lead from child to parent, away from ground, (n_b,)."""
        return np.array(self.predecessor) == np.array(self.child[: self.num_bodies])

    @cached_property
    def path(self) -> np.ndarray:
        """path[i, j] = 1 where body j is on the way from ground to body i, itself included; (n_b + 1, n_b).

        Row -1, of ground, is zero.
        """
        path = np.zeros((self.num_bodies + 1, self.num_bodies))
        for body, carrier in enumerate(self.predecessor):
            path[body] = path[carrier]
            path[body, body] = 1.0
        return path

    @cached_property
    def loop(self) -> np.ndarray:
        """+1 for tree joints from a loop's common ancestor to the cut joint's child, -1 to its parent; (cuts, n_b)."""
        cuts = slice(self.num_bodies, None)
        return self.path[list(self.child[cuts])] - self.path[list(self.parent[cuts])]

    @cached_property
    def root(self) -> np.ndarray:
        """The first body on the way from ground to each body, (n_b + 1,); -1 for ground."""
        root = np.full(self.num_bodies + 1, GROUND_INDEX)
        for body, carrier in enumerate(self.predecessor):
            root[body] = body if carrier == GROUND_INDEX else root[carrier]
        return root

    @cached_property
    def spinning(self) -> dict[int, tuple[int, int]]:
        """Bodies between two balls, which can spin about the line between these whatever all others do.

        With the joints of each, which hold no more than its distances from the two points.
        """
        hung = {body: [] for body in range(self.num_bodies)}
        for joint, kind in enumerate(self.joint_types):
            rotates = getattr(kind, "locked_rotations", None) == () and not kind.combined_rotations
            moves = {*getattr(kind, "locked_translations", ()), *kind.combined_translations}
            for end in {self.parent[joint], self.child[joint]} & {*hung} if moves or not rotates else ():
                hung[end].append((joint, rotates and len(moves) == 3))
        held = {body for bodies in self.constraint_bodies for body in bodies}
        return {
            body: (joints[0][0], joints[1][0])
            for body, joints in hung.items()
            if len(joints) == 2 and all(spins for _, spins in joints) and body not in held
        }

    def with_measures(self, measures: Sequence[AbstractJoint]) -> "Topology":
        """The same plan with joints that close loops without rows, and only measure."""
        index = {GROUND_NAME: GROUND_INDEX} | {name: place for place, name in enumerate(self.bodies)}
        return dataclasses.replace(
            self,
            joints=(*self.joints, *(joint.name for joint in measures)),
            parent=(*self.parent, *(index[joint.parent.body] for joint in measures)),
            child=(*self.child, *(index[joint.child.body] for joint in measures)),
            joint_types=(*self.joint_types, *(joint.kind for joint in measures)),
            driven_by=(*self.driven_by, *(joint.driven_by for joint in measures)),
        )

    def describe(self) -> str:
        """Describe the spanning tree, the cut joints and the constraints on coordinates, a line for each."""
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
