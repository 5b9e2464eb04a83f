"""Poses as homogeneous matrices, (4, 4), from the angles and quaternions of files."""

import numpy as np
from jaxtyping import Float

STEP = np.pi / 12
FEWEST_DECIMALS = 2
ROUNDING = 1e-15  # entries of a rotation that are as near to 0, 1 or −1 as that are meant to be it


def pose(
    position: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"] | None = None
) -> Float[np.ndarray, "4 4"]:
    """Make a pose from the origin [m] and the axes as columns."""
    found = np.eye(4)
    found[:3, 3] = position
    if rotation is not None:
        found[:3, :3] = rotation
    return found


def from_angles(roll_pitch_yaw: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """R_z(yaw) R_y(pitch) R_x(roll), as URDF and SDF turn."""
    from scipy.spatial.transform import Rotation  # SciPy takes its time

    return exact(Rotation.from_euler("xyz", roll_pitch_yaw).as_matrix())


def whole(angle: float) -> float:
    """The multiple of 15 degrees that an angle is when rounded to its decimals, such as π/2 for 1.5708; else itself."""
    multiple, decimals = round(angle / STEP) * STEP, len(repr(angle).partition(".")[2])
    return multiple if decimals >= FEWEST_DECIMALS and round(multiple, decimals) == angle else angle


def from_quaternion(w_x_y_z: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """The rotation of a quaternion, (w, x, y, z), of any length but zero."""
    from scipy.spatial.transform import Rotation

    return exact(Rotation.from_quat(w_x_y_z, scalar_first=True).as_matrix())


def to_quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """The quaternion (w, x, y, z) of a rotation, with w ≥ 0."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


def exact(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation without rounding in entries that are 0, 1 or −1, which cost no operation then."""
    near = np.round(rotation)
    return np.where(np.abs(rotation - near) < ROUNDING, near, rotation) + 0.0


def inverse(of: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse of a pose."""
    return pose(-of[:3, :3].T @ of[:3, 3], of[:3, :3].T)


def relative(of: Float[np.ndarray, "4 4"], seen_from: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """A pose seen from another one."""
    found = inverse(seen_from) @ of
    found[:3, :3] = exact(found[:3, :3])
    return found


def turned(inertia: Float[np.ndarray, "3 3"], rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """An inertia tensor in other axes, R I Rᵀ, symmetric to the last digit."""
    found = rotation @ inertia @ rotation.T
    return (found + found.T) / 2.0
