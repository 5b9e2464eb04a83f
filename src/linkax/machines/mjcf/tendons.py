"""Tendons of MJCF: linear combinations of coordinates, straight lines between two sites, and springs along both."""

from typing import Any

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.parts import Place
from linkax.machines.xml import Where
from linkax.model.forces.affine_actuator import AffineActuator
from linkax.model.forces.point_forces import Damper, Spring


def read_tendons(compiled: Compiled) -> None:
    """Read springs and dampers of tendons."""
    model, draft = compiled.model, compiled.draft
    for index, name in enumerate(compiled.names("tendon")):
        where = compiled.where("tendon", index)
        stiffness = float(model.tendon_stiffness[index]) * compiled.has("SPRING")
        damping = float(model.tendon_damping[index]) * compiled.has("DAMPER")
        if model.tendon_limited[index] or model.tendon_frictionloss[index] or model.tendon_armature[index]:
            draft.leave_out(where, "tendon", "range, dry friction or armature of a tendon")
        for field in ("stiffnesspoly", "dampingpoly", "springyield"):  # of newer versions of MuJoCo
            if np.any(getattr(model, f"tendon_{field}", np.zeros(model.ntendon))[index]):
                draft.leave_out(where, "spring", f"nonlinear terms, tendon_{field}")
        if not stiffness and not damping:
            continue
        free, end = map(float, model.tendon_lengthspring[index])
        if stiffness and free != end:
            draft.leave_out(where, "tendon", "a spring with a range of lengths without force")
        elif points := points_of(compiled, index):
            ends: dict[str, Any] = dict(zip(("first", "second"), points, strict=True))
            if stiffness:
                draft.force(Spring, f"{name}.spring", where, **ends, stiffness=stiffness, free_length=free)
            if damping:
                draft.force(Damper, f"{name}.damper", where, **ends, damping=damping)
        elif terms := transmission(compiled, index, where):
            rest = free - float(model.tendon_length0[index])
            bias = np.array([stiffness * rest, -stiffness, -damping])
            draft.force(AffineActuator, f"{name}.spring", where, transmission=terms, gain=0.0, bias=bias)


def points_of(compiled: Compiled, tendon: int) -> tuple[Place, Place] | None:
    """The ends of a tendon that is the straight line between sites on two bodies; None for any other tendon."""
    model, span = compiled.model, _span(compiled, tendon)
    if len(span) != 2 or any(model.wrap_type[wrap] != int(compiled.mujoco.mjtWrap.mjWRAP_SITE) for wrap in span):
        return None
    sites = [int(model.wrap_objid[wrap]) for wrap in span]
    first, second = (
        Place(compiled.body_names[model.site_bodyid[site]], np.array(model.site_pos[site]), np.eye(3)) for site in sites
    )
    return None if first.body == second.body else (first, second)


def transmission(compiled: Compiled, tendon: int, where: Where) -> dict[str, float] | None:
    """The coefficients of a fixed tendon, by joint; None for a spatial one, which is noted."""
    model, span = compiled.model, _span(compiled, tendon)
    if any(model.wrap_type[wrap] != int(compiled.mujoco.mjtWrap.mjWRAP_JOINT) for wrap in span):
        compiled.draft.leave_out(where, "tendon", "a spatial tendon; take linkax.Rope or ElasticRope")
        return None
    return {compiled.joint_names[model.wrap_objid[wrap]]: float(model.wrap_prm[wrap]) for wrap in span}


def _span(compiled: Compiled, tendon: int) -> range:
    """Indices of what a tendon goes along."""
    begin = int(compiled.model.tendon_adr[tendon])
    return range(begin, begin + int(compiled.model.tendon_num[tendon]))
