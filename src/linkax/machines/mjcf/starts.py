"""Keyframes of MJCF, as coordinates and speeds of linkax."""

from typing import Any

import numpy as np

from linkax.machines.machine import Start
from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.poses import from_quaternion, pose, relative, to_quaternion


def read_starts(compiled: Compiled) -> None:
    """Read all keyframes."""
    model, draft = compiled.model, compiled.draft
    for index, name in enumerate(compiled.names("key")):
        qpos, qvel = np.array(model.key_qpos[index]), np.array(model.key_qvel[index])
        found = {joint: _of_joint(compiled, place, qpos, qvel) for place, joint in enumerate(compiled.joint_names)}
        positions, speeds = ({joint: entries[which] for joint, entries in found.items()} for which in (0, 1))
        draft.starts[name] = Start(positions, speeds)
        if np.any(model.key_ctrl[index]):
            draft.leave_out(compiled.where("key", index), "key", "controls of a keyframe; give them as params", False)


def _of_joint(compiled: Compiled, joint: int, qpos: np.ndarray, qvel: np.ndarray) -> tuple[Any, Any]:
    """Coordinates and speeds of a joint."""
    model, kind = compiled.model, compiled.joint_kinds[joint]
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    if kind == "free":
        drawn = compiled.draft.poses[compiled.body_names[model.jnt_bodyid[joint]]]
        turn, into = from_quaternion(qpos[at + 3 : at + 7]), drawn[:3, :3].T
        seen = relative(pose(qpos[at : at + 3], turn), drawn)
        angular, linear = into @ turn @ qvel[dof + 3 : dof + 6], into @ qvel[dof : dof + 3]
        return np.concatenate([to_quaternion(seen[:3, :3]), seen[:3, 3]]), np.concatenate([angular, linear])
    if kind == "ball":
        quaternion = qpos[at : at + 4]
        return quaternion, from_quaternion(quaternion) @ qvel[dof : dof + 3]
    return float(qpos[at] - model.qpos0[at]), float(qvel[dof])
