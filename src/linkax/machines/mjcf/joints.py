"""Joints of MJCF in the tree, and what acts along them: springs, dampers, friction, rotors and stops."""

from typing import Any

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.parts import Place
from linkax.machines.xml import Where
from linkax.model.forces.joint_forces import JointInertia
from linkax.model.joints.free import Free
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical


def read_joint(compiled: Compiled, index: int, parent: Place, child: Place) -> None:
    """Read a joint, from its place on what carries it and on its body."""
    model, draft = compiled.model, compiled.draft
    where, name, kind = compiled.where("joint", index), compiled.joint_names[index], compiled.joint_kinds[index]
    if kind == "free":
        draft.joint_at(Free, name, parent, child, where)
        terms = [(name, place) for place in (3, 4, 5, 0, 1, 2)]
    else:
        at = np.array(model.jnt_pos[index])
        first, second = (Place(end.body, end.offset + end.rotation @ at, end.rotation) for end in (parent, child))
        if kind == "ball":
            draft.joint_at(Spherical, name, first, second, where)
            terms = [(name, place) for place in range(3)]
        else:
            of_type = Revolute if kind == "hinge" else Prismatic
            draft.joint_at(of_type, name, first, second, where, axis=np.array(model.jnt_axis[index]))
            terms = [name]
    _along(compiled, index, name, where, terms)


def _along(compiled: Compiled, index: int, name: str, where: Where, terms: list[Any]) -> None:
    """Spring, damper, friction, rotor and stops along a joint, whose coordinates are in the order of MuJoCo."""
    model, draft, dof = compiled.model, compiled.draft, int(compiled.model.jnt_dofadr[index])
    ref = float(model.qpos0[model.jnt_qposadr[index]])
    for place, along in enumerate(terms):
        label = name if len(terms) == 1 else f"{name}[{along[1]}]"
        damping = float(model.dof_damping[dof + place]) * compiled.has("DAMPER")
        friction = float(model.dof_frictionloss[dof + place]) * compiled.has("FRICTIONLOSS")
        draft.along(along, label, where, damping=damping, friction=friction)
        if armature := float(model.dof_armature[dof + place]):
            draft.force(JointInertia, f"{label}.armature", where, joint=along, inertia=armature)
    if stiffness := float(model.jnt_stiffness[index]) * compiled.has("SPRING"):
        if len(terms) == 1:
            free = float(model.qpos_spring[model.jnt_qposadr[index]]) - ref
            draft.along(name, name, where, stiffness=stiffness, free=free)
        else:
            draft.leave_out(where, "spring", "a spring along several coordinates")
    of_newer = {"jnt_stiffnesspoly": index, "jnt_springyield": index, "dof_dampingpoly": slice(dof, dof + len(terms))}
    for field, rows in of_newer.items():
        if hasattr(model, field) and np.any(getattr(model, field)[rows]):
            draft.leave_out(where, "spring", f"nonlinear terms, {field}")
    if model.jnt_limited[index] and compiled.has("LIMIT"):
        if len(terms) > 1:
            draft.leave_out(where, "limit", "a range of a ball")
            return
        lower, upper = (float(end) - ref for end in model.jnt_range[index])
        draft.limit(name, name, where, lower, upper, stiffness=_stop_stiffness(compiled, index))


def _stop_stiffness(compiled: Compiled, index: int) -> float | None:
    """The stiffness that MuJoCo's `solreflimit` means for the inertia that the joint has as drawn."""
    model = compiled.model
    time, ratio = map(float, model.jnt_solref[index])
    if time <= 0.0:
        return -time or None
    most, inverse_inertia = float(model.jnt_solimp[index][1]), float(model.dof_invweight0[model.jnt_dofadr[index]])
    return 1.0 / (most * time**2 * ratio**2 * inverse_inertia)
