"""Motions of linkax in the coordinates and speeds of MuJoCo."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Pose
from linkax.machines.poses import to_quaternion
from linkax.machines.write_mjcf.pieces import Piece, check_tree, ends_of, outwards, pieces_of, pose_of
from linkax.model.joints.screw import Screw
from linkax.model.mechanism import Mechanism
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.start.state import State
from linkax.spatial.quaternions import conjugate, multiply, rotation_matrix


def mujoco_trajectory(
    motion: Kinematics | State, mechanism: Mechanism | None = None
) -> tuple[Float[np.ndarray, "... nq"], Float[np.ndarray, "... nv"]]:
    """Read a motion in the coordinates of the model that `linkax.to_mjcf` writes, to show or check it in MuJoCo.

    Of a freejoint MuJoCo has the position in the world [m], then the quaternion (w, x, y, z); as speeds the velocity of
    the body's origin in the world's axes [m/s], then the angular velocity in the body's axes [rad/s]. Of a ball it has
    the quaternion, and the angular velocity in the body's axes.

    **Arguments:** `motion`: a `linkax.Solution` or another motion, or a `linkax.State` of the `mechanism`.

    **Returns:** `qpos`, (n_t, nq), and `qvel`, (n_t, nv); of a state (nq,) and (nv,).

    **Raises:** `ValueError` for a joint in the tree that MuJoCo does not have, and for a state without its mechanism.
    """
    found = motion.mechanism if isinstance(motion, Kinematics) else mechanism
    if found is None:
        raise ValueError("the mechanism of a state is not known; give mujoco_trajectory(state, mechanism)")
    check_tree(found, motion if isinstance(motion, State) else None)
    return in_mujoco(found, motion.q, motion.v)


def in_mujoco(mechanism: Mechanism, q: Any, v: Any) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates, (..., n_q), and speeds, (..., n_v), as qpos and qvel."""
    topology, found = mechanism.topology, [(np.zeros((*np.shape(q)[:-1], 0)), np.zeros((*np.shape(v)[:-1], 0)))]
    for body in outwards(topology):
        name = topology.joints[body]
        own = np.asarray(q)[..., topology.coordinates[name]], np.asarray(v)[..., topology.speeds[name]]
        found += [_of_piece(mechanism, body, piece, *own) for piece in pieces_of(mechanism, body)]
    qpos, qvel = (np.concatenate(entries, axis=-1) for entries in zip(*found, strict=True))
    return qpos, qvel


def _of_piece(mechanism: Mechanism, body: int, piece: Piece, q: np.ndarray, v: np.ndarray) -> tuple[Any, Any]:
    """Coordinates and speeds of one joint of MuJoCo from those of linkax's joint."""
    joint, (carrier, end) = mechanism.joints[body], map(pose_of, ends_of(mechanism, body))
    if piece.kind == "free":
        return _of_free(carrier, end, q, v)
    if piece.kind == "ball":
        reverse = mechanism.topology.reversed[body]
        axes = -end[:3, :3] if reverse else end[:3, :3]
        into = np.eye(3) if reverse else np.swapaxes(rotation_matrix(q[..., :4]), -1, -2)
        return np.concatenate([q[..., :1], _rotate(axes, q[..., 1:4])], axis=-1), _rotate(axes @ into, v[..., :3])
    factor = np.asarray(joint.pitch) if piece.advances and isinstance(joint, Screw) else 1.0
    place = piece.index + joint.has_quaternion
    return factor * q[..., place : place + 1], factor * v[..., piece.index : piece.index + 1]


def _of_free(carrier: Pose, end: Pose, q: np.ndarray, v: np.ndarray) -> tuple[Any, Any]:
    """Place and speed of the origin of a body, whose joint has frames on the ground and on the body."""
    at, turn = carrier[:3, :3], np.asarray(rotation_matrix(q[..., :4]))
    arm = -_rotate(at @ turn @ end[:3, :3].T, end[:3, 3] + np.zeros_like(v[..., :3]))  # to the body's origin
    angular, linear = _rotate(at, v[..., :3]), _rotate(at, v[..., 3:])
    into = conjugate(to_quaternion(end[:3, :3]))
    quaternion = multiply(multiply(to_quaternion(at), q[..., :4]), into)
    qpos = carrier[:3, 3] + _rotate(at, q[..., 4:]) + arm, np.asarray(quaternion)
    qvel = linear + np.cross(angular, arm), _rotate(end[:3, :3] @ np.swapaxes(turn, -1, -2), v[..., :3])
    return np.concatenate(qpos, axis=-1), np.concatenate(qvel, axis=-1)


def _rotate(rotation: Any, vector: Any) -> Any:
    """Vectors, (..., 3), in other axes."""
    return (rotation @ vector[..., None])[..., 0]
