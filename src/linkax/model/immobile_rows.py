"""Loop rows that no motion changes, such as the out-of-plane rows of a planar loop.

Found from the directions that belong to the structure (axes and rotations given as names or
numbers), never from traced ones: a loop whose rotations all have one direction n keeps every
vector along n fixed. Such a row is constant; it is checked where violations are reported, and
left out of all equations.
"""

import numpy as np

from linkax.model.bodies import GROUND_NAME
from linkax.model.numbers import Constant

PARALLEL = 1e-14
EVERY_ROW = (lambda i, j: True), (lambda i: True)


def split_rows(carriers, predecessors, cuts, all_rows=False) -> dict[str, tuple]:
    """The rows of all cut joints, those that move and those that do not (see `Topology`); or all as if they moved."""
    orientation, carrier_of = {GROUND_NAME: np.eye(3)}, {}
    for joint, predecessor in zip(carriers, predecessors, strict=True):
        body = joint.child.body if joint.parent.body == predecessor else joint.parent.body
        orientation[body] = _carried(joint, predecessor, orientation[predecessor])
        carrier_of[body] = (joint, predecessor)
    rows = {"rotation_rows": [], "translation_rows": [], "immobile_rotation_rows": [], "immobile_translation_rows": []}
    for index, cut in enumerate(cuts):
        rotates, translates = EVERY_ROW if all_rows else _mobile(cut, _loop(cut, carrier_of), orientation)
        for i, j in cut.locked_rotations:
            rows["rotation_rows" if rotates(i, j) else "immobile_rotation_rows"].append((index, i, j))
        for i in cut.locked_translations:
            rows["translation_rows" if translates(i) else "immobile_translation_rows"].append((index, i))
    return {name: tuple(found) for name, found in rows.items()}


def _carried(joint, predecessor, orientation):
    """Orientation of a body at coordinate zero, or None where it is traced."""
    if orientation is None or not _is_structure(joint):
        return None
    parent_axes, child_axes = joint.frames()
    turn = parent_axes @ child_axes.T
    return orientation @ (turn if joint.parent.body == predecessor else turn.T)


def _is_structure(joint):
    return all(isinstance(part, Constant) for part in (joint.axis, joint.parent.rotation, joint.child.rotation))


def _loop(cut, carrier_of):
    """The tree joints on one of the two ways from ground to the cut joint, but not on both."""

    def way(body):
        joints = {}
        while body != GROUND_NAME:
            joint, body = carrier_of[body]
            joints[joint.name] = joint
        return joints

    parents, children = way(cut.parent.body), way(cut.child.body)
    return [(parents | children)[name] for name in parents.keys() ^ children.keys()]


def _mobile(cut, loop, orientation):
    """Two tests, whether the loop's motion changes h₁ⁱ·h₂ʲ and h₁ⁱ·s."""
    if any(not _is_structure(joint) or orientation[joint.parent.body] is None for joint in [cut, *loop]):
        return EVERY_ROW
    if orientation[cut.child.body] is None:
        return EVERY_ROW
    turns, slides = [], []
    for joint in [cut, *loop]:
        axes = orientation[joint.parent.body] @ joint.frames()[0]
        turns += [axes @ column for column in np.array(joint.angular_subspace) if np.any(column)]
        slides += [axes @ column for column in np.array(joint.linear_subspace) if np.any(column)]
    if turns and any(np.linalg.norm(np.cross(turns[0], turn)) > PARALLEL for turn in turns):
        return EVERY_ROW
    parent_axes = orientation[cut.parent.body] @ cut.frames()[0]
    child_axes = orientation[cut.child.body] @ cut.frames()[1]

    def fixed(direction):
        return not turns or np.linalg.norm(np.cross(turns[0], direction)) <= PARALLEL

    def rotates(i, j):
        return not fixed(parent_axes[:, i]) and not fixed(child_axes[:, j])

    def translates(i):
        across = all(abs(slide @ parent_axes[:, i]) <= PARALLEL for slide in slides)
        return not (fixed(parent_axes[:, i]) and across)

    return rotates, translates
