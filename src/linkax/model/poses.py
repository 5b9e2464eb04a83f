"""Where a body is in the world and how it moves there, as users give it and as solutions tell it."""

from typing import Any, NamedTuple

import numpy as np

from linkax.tables import Table, among, by_axis, known, printed_as


def _table(pose):
    rows = [("position", pose.position, "m")]
    if pose.orientation is not None:
        axes = known(pose.orientation)
        columns = [pose.orientation if axes is None else axes[..., column] for column in range(3)]
        rows += [(f"{name} axis", column, "") for name, column in zip("xyz", columns, strict=True)]
    return Table("Pose of a frame, along ground axes" + among(np.shape(pose.position)[:-1]), [by_axis(*rows)])


@printed_as(_table)
class Pose(NamedTuple):
    """Pose of a body's reference frame in the world.

    - `position`: of its origin [m], (..., 3).
    - `orientation`: its axes as columns, (..., 3, 3); None where a pose is given without.

    For example, `lx.Pose([1.0, 0.5, 0.0])` is a position with any orientation.
    """

    position: Any
    orientation: Any = None


class Velocity(NamedTuple):
    """Velocity of a body in the world, in ground axes; None for a part that is not given.

    - `linear`: of the origin of its reference frame [m/s], (3,).
    - `angular`: [rad/s], (3,).

    For example, `lx.Velocity(angular=[0.0, 0.0, 2.0])`.
    """

    linear: Any = None
    angular: Any = None
