"""Bodies of a stage: where they are, and their mass and inertia, from shapes what the file does not give."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.poses import from_quaternion, turned
from linkax.machines.usd.shapes import shapes_of
from linkax.machines.usd.stage import Stage
from linkax.machines.xml import Where


def read_body(stage: Stage, prim: Any, gravity: Float[np.ndarray, "3"]) -> None:
    """Read a body that forces move."""
    draft, where, name = stage.draft, stage.where(prim), stage.names[prim.GetPath()]
    at, scale = stage.frame(prim)
    mass, center, moments, axes = _inertia(stage, prim, scale, where)
    draft.body(name, at, mass, center, turned(np.diag(moments), axes), where)
    if stage.get(prim, "physxRigidBody:disableGravity", False):
        draft.carry(name, center, -mass * gravity, where)
    for attribute in ("physics:velocity", "physics:angularVelocity"):
        if np.any(stage.vector(prim, attribute)):
            draft.leave_out(where, "velocity", f"{attribute} at the start; give it to linkax.assemble", False)
    stage.note_extensions(prim, where)


def _inertia(stage: Stage, prim: Any, scale: Any, where: Where) -> tuple[float, Any, Any, Any]:
    """Mass, centre of mass, principal moments and axes, in SI units; from shapes what the file does not give."""
    mass = stage.number(prim, "physics:mass", 0.0)
    center = stage.vector(prim, "physics:centerOfMass", [-np.inf] * 3)
    moments = stage.vector(prim, "physics:diagonalInertia")
    axes = stage.rotation(prim, "physics:principalAxes")
    of_inertia = stage.mass * stage.length**2
    if mass > 0.0 and np.any(moments) and np.all(np.isfinite(center)):
        return mass * stage.mass, scale @ center * stage.length, moments * of_inertia, axes
    shapes, unknown = shapes_of(stage, prim)
    if unknown or not shapes:
        what = f"has the shape {unknown[0].GetPath()}" if unknown else "has no shape"
        if not mass > 0.0 or not np.any(moments):
            reason = f"its mass or inertia is not given, and it {what}; it is taken as 1 kg and 1 kg m²"
            stage.draft.leave_out(where, "inertia", reason)
        elif unknown:
            reason = f"its centre of mass is not given, and it {what}; it is taken at the origin"
            stage.draft.leave_out(where, "inertia", reason)
        center = scale @ center * stage.length if np.all(np.isfinite(center)) else np.zeros(3)
        mass = mass * stage.mass if mass > 0.0 else 1.0
        return mass, center, moments * of_inertia if np.any(moments) else np.ones(3), axes
    found = stage.physics.RigidBodyAPI(prim).ComputeMassProperties(lambda shape: shapes[shape.GetPath()])
    quaternion = np.array([found[3].GetReal(), *found[3].GetImaginary()])
    mass = mass if mass > 0.0 else float(found[0])
    center = scale @ center if np.all(np.isfinite(center)) else np.array(found[2], dtype=float)
    if not np.any(moments):
        moments, axes = np.array(found[1], dtype=float), from_quaternion(quaternion)
    return mass * stage.mass, center * stage.length, moments * of_inertia, axes
