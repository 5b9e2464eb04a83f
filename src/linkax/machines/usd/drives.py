"""Stops and drives along the coordinates of joints; a drive is an actuator that holds a target."""

from typing import Any

import numpy as np

from linkax.machines.usd.kinds import NO_LIMIT, range_of
from linkax.machines.usd.stage import Stage
from linkax.model.forces.affine_actuator import AffineActuator


def read_along(stage: Stage, prim: Any, kind: Any, token: str, index: int) -> None:
    """Read stops and a drive along a coordinate, by USD's name of it and the index of its speed in linkax.

    About the axes of a ball, whose coordinates are a quaternion, linkax has neither.
    """
    draft, where, name = stage.draft, stage.where(prim), stage.names[prim.GetPath()]
    along = name if len(kind.speed_units) == 1 else (name, index)
    part = name if token in ("angular", "linear") else f"{name}.{token}"
    turns = token.startswith(("rot", "angular"))
    has_law = not (turns and kind.has_quaternion)
    unit = np.pi / 180.0 if turns else stage.length
    lower, upper = range_of(stage, prim, token)
    whole_ball = not has_law and lower <= -180.0 and upper >= 180.0
    if not whole_ball and (np.isfinite(lower) or np.isfinite(upper)):
        if not has_law or lower >= upper:
            draft.leave_out(where, "limit", f"its range {token} from {lower:g} to {upper:g}")
        else:
            ends = (float(end * unit) if np.isfinite(end) else None for end in (lower, upper))
            draft.limit(along, part, where, *ends)
    drive = lambda what, default: stage.number(prim, f"drive:{token}:physics:{what}", default)
    stiffness, damping, most = drive("stiffness", 0.0), drive("damping", 0.0), drive("maxForce", np.inf)
    if not (stiffness or damping) or draft.ignores("actuator", where, "the drive"):
        return
    if not has_law or stage.get(prim, f"drive:{token}:physics:type", "force") != "force":
        draft.leave_out(where, "actuator", f"its drive {token} on a ball, or that gives an acceleration")
        return
    newton = stage.mass * stage.length * (stage.length if turns else 1.0)
    target, speed = drive("targetPosition", 0.0) * unit, drive("targetVelocity", 0.0) * unit
    stiffness, damping = stiffness * newton / unit, damping * newton / unit
    servo = {"control": target, "gain": stiffness, "bias": np.array([damping * speed, -stiffness, -damping])}
    if not stiffness:
        servo = {"control": speed, "gain": damping, "bias": np.array([0.0, 0.0, -damping])}
    if most < NO_LIMIT:
        servo["force_range"] = np.array([-most, most]) * newton
    draft.force(AffineActuator, f"{part}.drive", where, transmission={along: 1.0}, **servo)
