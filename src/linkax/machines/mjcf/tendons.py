"""Tendons of MJCF: linear combinations of coordinates, with springs and dampers along them."""

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.xml import Where
from linkax.model.forces.affine_actuator import AffineActuator


def read_tendons(compiled: Compiled) -> None:
    """Read springs and dampers of fixed tendons."""
    model, draft = compiled.model, compiled.draft
    for index, name in enumerate(compiled.names("tendon")):
        where = compiled.where("tendon", index)
        stiffness = float(model.tendon_stiffness[index]) * compiled.has("SPRING")
        damping = float(model.tendon_damping[index]) * compiled.has("DAMPER")
        if model.tendon_limited[index] or model.tendon_frictionloss[index] or model.tendon_armature[index]:
            draft.leave_out(where, "tendon", "range, dry friction or armature of a tendon")
        if not stiffness and not damping:
            continue
        lower, upper = model.tendon_lengthspring[index]
        if stiffness and lower != upper:
            draft.leave_out(where, "tendon", "a spring with a range of lengths without force")
        elif terms := transmission(compiled, index, where):
            rest = float(lower - model.tendon_length0[index])
            bias = np.array([stiffness * rest, -stiffness, -damping])
            draft.force(AffineActuator, f"{name}.spring", where, transmission=terms, gain=0.0, bias=bias)


def transmission(compiled: Compiled, tendon: int, where: Where) -> dict[str, float] | None:
    """The coefficients of a fixed tendon, by joint; None for a spatial one, which is noted."""
    model = compiled.model
    span = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
    if any(model.wrap_type[wrap] != int(compiled.mujoco.mjtWrap.mjWRAP_JOINT) for wrap in span):
        compiled.draft.leave_out(where, "tendon", "a spatial tendon; take linkax.Rope or ElasticRope")
        return None
    return {compiled.joint_names[model.wrap_objid[wrap]]: float(model.wrap_prm[wrap]) for wrap in span}
