"""Choose from where a mechanism is seen."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from linkax.model.forces.force import Gravity
from linkax.model.mechanism import Mechanism

NEGLIGIBLE = 1e-9  # extent, relative to the largest, up to which there is none
ASIDE, ABOVE = np.radians([35.0, 25.0])  # of a corner, from the front


class Camera(NamedTuple):
    """Unit vectors in ground axes: to the right and upwards in the picture, and towards the eye.

    `plane`: the ground axes to the right and upwards, where the mechanism is seen along the third; else None.
    """

    right: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    toward: Float[np.ndarray, "3"]
    plane: tuple[int, int] | None

    def seen(self, positions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Project positions [m] on the picture, in parallel [m]."""
        return positions @ np.stack([self.right, self.up], axis=1)


def camera_for(mechanism: Mechanism, everything: Float[np.ndarray, "n n_f 3"]) -> Camera:
    """See a planar motion along its normal, where that is a level ground axis, and all else from a corner.

    `everything`: the positions of all that is drawn, in n_f frames [m].
    """
    extents = np.ptp(everything.reshape(-1, 3), axis=0)
    moves = np.max(np.ptp(everything, axis=1), axis=0)
    flat = moves if np.any(moves > NEGLIGIBLE * max(extents)) else extents
    fall = np.abs(gravity(mechanism))
    still = np.flatnonzero((flat <= NEGLIGIBLE * max(flat)) & (fall <= NEGLIGIBLE * max(fall)))
    if not len(still):
        return _corner(upwards(mechanism))
    normal = min(still.tolist(), key=lambda axis: (extents[axis], -axis))
    first, second = (axis for axis in range(3) if axis != normal)
    right, up = np.eye(3)[[first, second]]
    return Camera(right, up, np.cross(right, up), (first, second))


def upwards(mechanism: Mechanism) -> Float[np.ndarray, "3"]:
    """The direction against gravity; z without gravity."""
    fall = gravity(mechanism)
    return -fall / np.linalg.norm(fall) if np.any(fall) else np.eye(3)[2]


def gravity(mechanism: Mechanism) -> Float[np.ndarray, "3"]:
    """Acceleration of free fall [m/s²]."""
    parts = [np.asarray(force.acceleration) for force in mechanism.forces if isinstance(force, Gravity)]
    return np.sum([np.zeros(3), *parts], axis=0)


def _corner(up) -> Camera:
    across = np.eye(3)[int(abs(up[0]) > 0.9)]
    across = across - across @ up * up
    across /= np.linalg.norm(across)
    toward = np.cos(ABOVE) * (np.cos(ASIDE) * np.cross(across, up) + np.sin(ASIDE) * across) + np.sin(ABOVE) * up
    right = np.cross(up, toward)
    right /= np.linalg.norm(right)
    return Camera(right, np.cross(toward, right), toward, None)
