"""Read a USD file: open its stage, once all files of it are checked, and fill a draft from it."""

import re
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft
from linkax.machines.machine import Start
from linkax.machines.poses import pose, relative
from linkax.machines.usd.bodies import read_body
from linkax.machines.usd.files import check_files
from linkax.machines.usd.joints import read_joint
from linkax.machines.usd.stage import AXES, Stage, prim_lines
from linkax.machines.xml import MachineFileError, Where, library, read_file

MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics")
EARTH = 9.81  # [m/s²], where a scene gives none
DRAWN = 1e-6  # how far from zero a coordinate is drawn, at least, to make a start [rad or m]


def read_usd(draft: Draft) -> None:
    """Fill a draft from a USD file.

    **Raises:** `MachineFileError` for what USD does not read, with its message, for files outside of the folder, and
    without usd-core.
    """
    path = draft.path
    data = read_file(path)
    pxr = {name: library(f"pxr.{name}", path, "USD, which usd-core") for name in MODULES}
    with pxr["Tf"].DiagnosticTrap() as told:
        try:
            check_files(pxr["Sdf"], path, draft)
            opened = pxr["Usd"].Stage.Open(str(path))
            if told.HasErrors() or told.HasWarnings():
                raise MachineFileError(f"{path.name}: USD warns: {_told([*told.GetErrors(), *told.GetWarnings()])}")
            _read_stage(Stage(pxr, opened, draft, prim_lines(data)))
        except (pxr["Tf"].ErrorException, RuntimeError) as error:
            raise MachineFileError(f"{path.name}: USD does not read it: {_told([error])}") from error
        finally:
            told.Clear()


def _told(messages: list[Any]) -> str:
    """What USD says, without places in its own code."""
    texts = [" ".join(str(getattr(message, "commentary", message)).split()) for message in messages]
    found = [match[1] if (match := re.search(r" in file \S+ : '(.*)'", text)) else text for text in texts]
    return "; ".join(found)[:1000]


def _read_stage(stage: Stage) -> None:
    """Read gravity, bodies, then joints."""
    draft, default = stage.draft, stage.usd_stage.GetDefaultPrim()
    draft.name = default.GetName() if default else ""
    gravity = _gravity(stage)
    for prim in stage.prims:
        if stage.moves(prim):
            read_body(stage, prim, gravity)
        elif prim.HasAPI(stage.physics.RigidBodyAPI) and stage.geometry.Xformable(prim).TransformMightBeTimeVarying():
            draft.leave_out(stage.where(prim), "kinematic", "a body that moves as drawn over time; it stands still")
        if prim.HasAPI(stage.physics.CollisionAPI) and stage.get(prim, "physics:collisionEnabled", True):
            draft.leave_out(stage.where(prim), "contact", "contact of this shape with others")
    for prim in stage.prims:
        if stage.is_joint(prim):
            read_joint(stage, prim)
    _start(draft)


def _gravity(stage: Stage) -> Float[np.ndarray, "3"]:
    """Gravity [m/s²] of the first scene, or the earth's."""
    draft = stage.draft
    scenes = [prim for prim in stage.prims if prim.IsA(stage.physics.Scene)]
    for scene in scenes[1:]:
        draft.leave_out(stage.where(scene), "scene", "a second scene; bodies move in the first one")
    up = -np.eye(3)[AXES.index(str(stage.geometry.GetStageUpAxis(stage.usd_stage)).upper())]
    if not scenes:
        draft.gravity(EARTH * up, Where(draft.path, 0, "stage", ""))
        return EARTH * up
    where = stage.where(scenes[0])
    magnitude = stage.number(scenes[0], "physics:gravityMagnitude", -np.inf)
    direction = stage.vector(scenes[0], "physics:gravityDirection")
    size = np.linalg.norm(direction)
    strength = EARTH if magnitude < 0.0 else magnitude * stage.length
    acceleration = strength * (direction / size if size else up)
    if not np.all(np.isfinite(acceleration)):
        raise where.error(f"gravity is {magnitude} along {direction}; give finite numbers")
    draft.gravity(acceleration, where)
    return acceleration


def _start(draft: Draft) -> None:
    """A start where the file draws the bodies, as far as joints are not at zero there."""
    positions = {}
    for joint in draft.joints:
        ends = (joint.arguments["parent"], joint.arguments["child"])
        first, second = (draft.poses[end.body] @ pose(end.offset, end.rotation) for end in ends)
        seen = relative(second, first)
        if joint.kind.speed_units:
            positions[joint.name] = np.asarray(joint.kind.measure(seen[:3, :3], seen[:3, 3]), dtype=float)
            zero = [1.0, 0.0, 0.0, 0.0] if joint.kind.has_quaternion else []
            zero = np.array(zero + [0.0] * (positions[joint.name].size - len(zero)))
            if np.abs(positions[joint.name] - zero).max() < DRAWN:
                positions[joint.name] = zero
            elif "drawn" not in draft.starts:
                draft.starts["drawn"] = Start(positions, {})
