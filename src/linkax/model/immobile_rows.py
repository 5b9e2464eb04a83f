"""Find loop rows that no motion changes, such as the out-of-plane rows of a planar loop.

A loop whose joints all turn about one direction n keeps vectors along n fixed, and rows made of these constant.
Equations leave such rows out; reports of violation check them. Only directions in the structure count (axes and
rotations given as names or numbers), never traced ones.
"""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.joint import AbstractJoint
from linkax.model.joints.table_joint import TableJoint
from linkax.model.numbers import Constant
from linkax.model.spanning_tree import SpanningTree

Mechanism = Any  # a `linkax.Mechanism`, which imports this
PARALLEL = 1e-14
Orientations = dict[str, np.ndarray | None]  # of bodies at coordinate zero; None where traced
Tests = tuple[Callable[[int, int], bool], Callable[[int], bool]]
EVERY_ROW: Tests = (lambda i, j: True), (lambda i: True)


def is_planar(mechanism: Mechanism) -> bool:
    """Whether all joints turn about one direction, and slide across it, as far as the structure tells."""
    topology = mechanism.topology
    if mechanism.beams:
        return False
    ends = (*topology.bodies, GROUND_NAME)  # ground has the index -1
    predecessors = [ends[index] for index in topology.predecessor]
    orientation, _ = _tree_of(mechanism.joints[: topology.num_bodies], predecessors)
    joints = [joint for joint in mechanism.joints if joint.speed_units or getattr(joint, "locked_rotations", ())]
    found = _directions(joints, orientation)
    if found is None:
        return False
    turns, slides = found
    if not turns or any(np.linalg.norm(np.cross(turns[0], turn)) > PARALLEL for turn in turns):
        return False
    return all(abs(slide @ turns[0]) <= PARALLEL for slide in slides)


def split_rows(tree: SpanningTree, all_rows: bool = False) -> dict[str, tuple]:
    """Sort the rows of all cut joints by whether motion changes them (see `Topology`); by `all_rows` all move."""
    orientation, carrier_of = _tree_of(tree.carriers, tree.predecessors)
    rows = {"rotation_rows": [], "translation_rows": [], "immobile_rotation_rows": [], "immobile_translation_rows": []}
    for index, cut in enumerate(cast(list[TableJoint], tree.cuts)):
        rotates, translates = EVERY_ROW if all_rows else _mobile(cut, _loop(cut, carrier_of), orientation)
        for i, j in cut.locked_rotations:
            rows["rotation_rows" if rotates(i, j) else "immobile_rotation_rows"].append((index, i, j))
        for i in cut.locked_translations:
            rows["translation_rows" if translates(i) else "immobile_translation_rows"].append((index, i))
    return {name: tuple(found) for name, found in rows.items()}


def _tree_of(
    carriers: Sequence[AbstractJoint], predecessors: Sequence[str]
) -> tuple[Orientations, dict[str, tuple[AbstractJoint, str]]]:
    """Find the orientation of each body at coordinate zero, and the joint and the predecessor that carry it."""
    orientation: Orientations = {GROUND_NAME: np.eye(3)}
    carrier_of: dict[str, tuple[AbstractJoint, str]] = {}
    for joint, predecessor in zip(carriers, predecessors, strict=True):
        body = joint.child.body if joint.parent.body == predecessor else joint.parent.body
        orientation[body] = _carried(joint, predecessor, orientation[predecessor])
        carrier_of[body] = (joint, predecessor)
    return orientation, carrier_of


def _carried(joint: AbstractJoint, predecessor: str, orientation: np.ndarray | None) -> np.ndarray | None:
    """Compute the orientation of a body at coordinate zero; None where it is traced."""
    if orientation is None or not _is_structure(joint):
        return None
    parent_axes, child_axes = joint.frames()
    turn = parent_axes @ child_axes.T
    return orientation @ (turn if joint.parent.body == predecessor else turn.T)


def _is_structure(joint: AbstractJoint) -> bool:
    return all(isinstance(part, Constant) for part in (joint.axis, joint.parent.rotation, joint.child.rotation))


def _loop(cut: AbstractJoint, carrier_of: dict[str, tuple[AbstractJoint, str]]) -> list[AbstractJoint]:
    """List the tree joints of a loop: those on one of the two ways from ground to the cut joint, but not on both."""

    def way(body: str) -> dict[str, AbstractJoint]:
        joints = {}
        while body != GROUND_NAME:
            joint, body = carrier_of[body]
            joints[joint.name] = joint
        return joints

    parents, children = way(cut.parent.body), way(cut.child.body)
    return [(parents | children)[name] for name in parents.keys() ^ children.keys()]


def _directions(
    joints: Sequence[AbstractJoint], orientation: Orientations
) -> tuple[list[np.ndarray], list[np.ndarray]] | None:
    """Find in what directions joints turn and slide; None where traced."""
    parents = [parent for joint in joints if (parent := orientation[joint.parent.body]) is not None]
    if len(parents) < len(joints) or not all(map(_is_structure, joints)):
        return None
    turns, slides = [], []
    for joint, parent in zip(joints, parents, strict=True):
        axes = parent @ joint.frames()[0]
        turns += [axes @ column for column in np.array(joint.angular_subspace) if np.any(column)]
        slides += [axes @ column for column in np.array(joint.linear_subspace) if np.any(column)]
    return turns, slides


def _mobile(cut: AbstractJoint, loop: list[AbstractJoint], orientation: Orientations) -> Tests:
    """Make two tests: whether the loop's motion changes h₁ⁱ·h₂ʲ, and h₁ⁱ·s."""
    # Rows are functions of the loop's coordinates alone, whatever the cut joint itself can do.
    parent, child, found = orientation[cut.parent.body], orientation[cut.child.body], _directions(loop, orientation)
    if parent is None or child is None or found is None or not _is_structure(cut):
        return EVERY_ROW
    turns, slides = found
    if turns and any(np.linalg.norm(np.cross(turns[0], turn)) > PARALLEL for turn in turns):
        return EVERY_ROW
    parent_axes, child_axes = parent @ cut.frames()[0], child @ cut.frames()[1]

    def fixed(direction: np.ndarray) -> bool:
        return not turns or bool(np.linalg.norm(np.cross(turns[0], direction)) <= PARALLEL)

    def rotates(i: int, j: int) -> bool:
        return not fixed(parent_axes[:, i]) and not fixed(child_axes[:, j])

    def translates(i: int) -> bool:
        across = all(abs(slide @ parent_axes[:, i]) <= PARALLEL for slide in slides)
        return not (fixed(parent_axes[:, i]) and across)

    return rotates, translates
