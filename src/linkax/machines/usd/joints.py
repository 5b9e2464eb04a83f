"""Joints of a stage: where they attach, and which of linkax they are."""

from typing import Any

import numpy as np

from linkax.machines.parts import Place
from linkax.machines.poses import exact, pose, relative
from linkax.machines.usd.drives import read_along
from linkax.machines.usd.kinds import NO_LIMIT, kind_of
from linkax.machines.usd.stage import Stage
from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.distance import Distance
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal


def read_joint(stage: Stage, prim: Any) -> None:
    """Read a joint of any type, with what acts along it."""
    draft, where, name = stage.draft, stage.where(prim), stage.names[prim.GetPath()]
    if not stage.get(prim, "physics:jointEnabled", True):
        draft.leave_out(where, "joint", "it is not enabled", False)
        return
    parent, child = _place(stage, prim, "0"), _place(stage, prim, "1")
    if parent.body == child.body:
        if parent.body != GROUND_NAME:
            raise where.error(f"both ends are on {parent.body!r}; name two bodies")
        draft.leave_out(where, "joint", "both ends stand still", False)
        return
    for attribute in ("physics:breakForce", "physics:breakTorque"):
        if stage.number(prim, attribute, np.inf) < NO_LIMIT:
            draft.leave_out(where, "break", f"it breaks at its {attribute}")
    stage.note_extensions(prim, where)
    if prim.GetTypeName() == "PhysicsDistanceJoint":
        least, most = (stage.number(prim, f"physics:{end}Distance", -1.0) for end in ("min", "max"))
        if least == most > 0.0:
            draft.joint_at(Distance, name, parent, child, where, length=most * stage.length)
        else:
            draft.leave_out(where, "joint", f"a distance between {least:g} and {most:g}; linkax has fixed ones")
        return
    kind, axes, along = kind_of(stage, prim)
    if kind is None:
        draft.leave_out(where, "joint", f"no joint of linkax moves along {', '.join(along) or 'these axes'} alone")
        return
    arguments: dict[str, Any] = {}
    if axes is not None:
        parent, child = (Place(end.body, end.offset, exact(end.rotation @ axes)) for end in (parent, child))
        arguments["axis"] = "x"
    if kind is Universal:
        arguments["second_axis"] = "y"
    draft.joint_at(kind, name, parent, child, where, **arguments)
    for token, index in along.items():
        read_along(stage, prim, kind, token, index)
    if kind is Spherical and "Spherical" in prim.GetTypeName():
        cones = [stage.number(prim, f"physics:coneAngle{end}Limit", -1.0) for end in "01"]
        if any(0.0 <= cone < np.inf for cone in cones):
            draft.leave_out(where, "limit", f"the cone of {cones} degrees that it stays in")


def _place(stage: Stage, prim: Any, end: str) -> Place:
    """Where a joint attaches at one end: on the body that holds a prim, or on the ground."""
    position, rotation = stage.vector(prim, f"physics:localPos{end}"), stage.rotation(prim, f"physics:localRot{end}")
    if not np.all(np.isfinite(position)):
        raise stage.where(prim).error(f"localPos{end} is {position}; give finite numbers")
    targets = prim.GetRelationship(f"physics:body{end}").GetTargets()
    if len(targets) > 1:
        raise stage.where(prim).error(f"body{end} names {len(targets)} prims; name one")
    if not targets:
        return Place(GROUND_NAME, position * stage.length, rotation)
    target = stage.usd_stage.GetPrimAtPath(targets[0])
    if not target:
        raise stage.where(prim).error(f"body{end} is {targets[0]}, which is not in the file; name a body")
    if not stage.geometry.Xformable(target):
        raise stage.where(prim).error(f"body{end} is {targets[0]}, which is no body and has no place; name a body")
    at, scale = stage.frame(target)
    on_target = pose(scale @ position * stage.length, rotation)
    body = target
    while body and not stage.moves(body) and not body.HasAPI(stage.physics.RigidBodyAPI):
        body = body.GetParent()
    if not body or not stage.moves(body):
        return Place.at(GROUND_NAME, at @ on_target)
    if body == target:
        return Place.at(stage.names[body.GetPath()], on_target)
    return Place.at(stage.names[body.GetPath()], relative(at @ on_target, stage.frame(body)[0]))
