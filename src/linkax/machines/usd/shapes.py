"""Volume and inertia of the simple shapes that USD gives a body its mass by: boxes, balls, cylinders and capsules."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.poses import relative, to_quaternion
from linkax.machines.usd.stage import Stage

SHEAR = 1e-5  # of a scale, that is taken as rounding


def shapes_of(stage: Stage, body: Any) -> tuple[dict[Any, Any], list[Any]]:
    """Volume and inertia of the shapes of a body, in units of the stage, and the shapes that are not simple."""
    found: dict[Any, Any] = {}
    unknown = []
    whole = iter(stage.usd.PrimRange(body, stage.usd.TraverseInstanceProxies()))
    for prim in whole:
        if prim != body and prim.HasAPI(stage.physics.RigidBodyAPI):
            whole.PruneChildren()
        elif prim.HasAPI(stage.physics.CollisionAPI):
            shape = _shape(stage, prim, body)
            if shape is None:
                unknown.append(prim)
            else:
                found[prim.GetPath()] = shape
    return found, unknown


def _shape(stage: Stage, prim: Any, body: Any) -> Any:
    """Volume, and inertia at density one, of a box, ball, cylinder or capsule; None for another."""
    at, scale = stage.frame(prim)
    factors = np.diag(scale)
    sheared = np.abs(scale - np.diag(factors)).max() > SHEAR * factors.max()
    kind = prim.GetTypeName()
    round_ones = ("Sphere", "Cylinder", "Capsule")
    if sheared or kind not in ("Cube", *round_ones):
        return None
    if kind in round_ones and np.ptp(factors) > SHEAR * factors.max():
        return None
    if kind == "Cube":
        sides = stage.number(prim, "size", 2.0) * factors
        volume = float(np.prod(sides))
        moments = volume / 12.0 * (np.sum(sides**2) - sides**2)
    else:
        radius = stage.number(prim, "radius", 1.0) * factors[0]
        height = stage.number(prim, "height", 2.0) * factors[0]
        along = stage.axis(prim, "axis", "Z")
        volume, moments = _round(kind, radius, height, along)
    seen = relative(at, stage.frame(body)[0])
    information = stage.physics.RigidBodyAPI.MassInformation()
    information.volume, information.centerOfMass = volume, stage.gf.Vec3f(0.0)
    information.inertia = stage.gf.Matrix3f(stage.gf.Vec3f(*moments.tolist()))
    information.localPos = stage.gf.Vec3f(*(seen[:3, 3] / stage.length).tolist())
    information.localRot = stage.gf.Quatf(*to_quaternion(seen[:3, :3]).tolist())
    return information


def _round(kind: str, radius: float, height: float, along: int) -> tuple[float, Float[np.ndarray, "3"]]:
    """Volume and principal moments at density one of a ball, a cylinder, or a capsule with caps beyond its height."""
    ball, cylinder = 4.0 / 3.0 * np.pi * radius**3, np.pi * radius**2 * height
    if kind == "Sphere":
        return float(ball), np.full(3, 0.4 * ball * radius**2)
    axial, across = cylinder * radius**2 / 2.0, cylinder * (radius**2 / 4.0 + height**2 / 12.0)
    if kind == "Capsule":
        axial += 0.4 * ball * radius**2
        across += ball * (0.4 * radius**2 + height**2 / 4.0 + 0.375 * height * radius)
        cylinder += ball
    moments = np.full(3, across)
    moments[along] = axial
    return float(cylinder), moments
