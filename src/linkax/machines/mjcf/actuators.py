"""Actuators of MJCF: forces along a joint or a fixed tendon, affine in control, length and rate."""

from typing import Any

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.mjcf.tendons import transmission
from linkax.machines.xml import Where
from linkax.model.forces.affine_actuator import AffineActuator

OWN = ("damping", "dampingpoly", "armature", "delay")  # of an actuator, in newer versions of MuJoCo


def read_actuators(compiled: Compiled) -> None:
    """Read all actuators, or note what they are."""
    model, draft = compiled.model, compiled.draft
    names = compiled.names("actuator")
    targets = [_target(compiled, index) for index in range(len(names))]
    for index, (name, target) in enumerate(zip(names, targets, strict=True)):
        where, group = compiled.where("actuator", index), int(model.actuator_group[index])
        if group >= 0 and model.opt.disableactuator >> group & 1:
            draft.leave_out(where, "actuator", f"its group {group} is disabled", False)
            continue
        if draft.ignores("actuator", where, "the actuator"):
            continue
        terms = _terms(compiled, index, target, where)
        law = _law(compiled, index, terms or {})
        if terms and law is not None:
            for own in OWN:
                if np.any(getattr(model, f"actuator_{own}", np.zeros(len(names)))[index]):
                    draft.leave_out(where, "actuator", f"its own {own}")
            law |= _range(compiled, index, target, targets.count(target) == 1, [*terms], where)
            draft.force(
                AffineActuator, name, where, transmission=terms, control=_control(compiled, index, where), **law
            )
        elif terms is not None or target[0] != "tendon":
            reason = "an actuator that is not affine, has a state, or acts on no hinge, slide or fixed tendon"
            draft.leave_out(where, "actuator", reason)


def _control(compiled: Compiled, index: int, where: Where) -> float:
    """The control that is zero in MuJoCo, which clamps it to its range; those that a user gives are not clamped."""
    model = compiled.model
    if not (model.actuator_ctrllimited[index] and compiled.has("CLAMPCTRL")):
        return 0.0
    lower, upper = map(float, model.actuator_ctrlrange[index])
    compiled.draft.leave_out(where, "ctrlrange", f"controls you give are not clamped to {lower:g} to {upper:g}", False)
    return min(max(0.0, lower), upper)


def _target(compiled: Compiled, index: int) -> tuple[str, int]:
    """What an actuator acts on, "joint", "tendon" or another thing, and its index."""
    kind = compiled.mujoco.mjtTrn(int(compiled.model.actuator_trntype[index])).name.removeprefix("mjTRN_").lower()
    return kind.removesuffix("inparent"), int(compiled.model.actuator_trnid[index][0])


def _terms(compiled: Compiled, index: int, target: tuple[str, int], where: Where) -> dict[str, float] | None:
    """Joints with their factors; None where it acts on another thing, which a tendon notes."""
    kind, of = target
    terms: dict[str, float] | None = None
    if kind == "tendon":
        terms = transmission(compiled, of, where)
    elif kind == "joint" and compiled.joint_kinds[of] in ("hinge", "slide"):
        terms = {compiled.joint_names[of]: 1.0}
    gear = float(compiled.model.actuator_gear[index][0])
    return terms and {joint: gear * factor for joint, factor in terms.items()}


def _range(
    compiled: Compiled, index: int, target: tuple[str, int], alone: bool, joints: list[str], where: Where
) -> dict[str, Any]:
    """The range of the force: its own, and that of its joint or tendon where it acts on that alone."""
    model, draft, (kind, of) = compiled.model, compiled.draft, target
    gear, ranges = float(model.actuator_gear[index][0]), []
    if model.actuator_forcelimited[index]:
        ranges.append(np.array(model.actuator_forcerange[index]))
    limited, given = (
        (model.jnt_actfrclimited, model.jnt_actfrcrange)
        if kind == "joint"
        else (model.tendon_actfrclimited, model.tendon_actfrcrange)
    )
    if limited[of] and gear and alone:
        ranges.append(np.sort(given[of] / gear))
    elif limited[of] and gear:
        draft.leave_out(where, "actuator", f"the range of the force on its {kind}, on which others act, too")
    if kind == "tendon" and any(model.jnt_actfrclimited[compiled.joint_names.index(joint)] for joint in joints):
        draft.leave_out(where, "actuator", "the range of the force on a joint of its tendon")
    if not ranges:
        return {}
    lower, upper = np.array(ranges).T
    return {"force_range": np.array([lower.max(), upper.min()])}


def _law(compiled: Compiled, index: int, terms: dict[str, float]) -> dict[str, Any] | None:
    """Gain and bias of the force, for a length that is zero where the file draws it; None where not affine."""
    model, gains, biases = compiled.model, compiled.mujoco.mjtGain, compiled.mujoco.mjtBias
    gain_type, bias_type = gains(int(model.actuator_gaintype[index])), biases(int(model.actuator_biastype[index]))
    is_affine = gain_type in (gains.mjGAIN_FIXED, gains.mjGAIN_AFFINE)
    is_affine &= bias_type in (biases.mjBIAS_NONE, biases.mjBIAS_AFFINE)
    if not is_affine or model.actuator_dyntype[index] != int(compiled.mujoco.mjtDyn.mjDYN_NONE):
        return None
    drawn = sum(
        factor * float(model.qpos0[model.jnt_qposadr[compiled.joint_names.index(joint)]])
        for joint, factor in terms.items()
    )
    from_drawn = lambda prm: np.array([prm[0] + prm[1] * drawn, prm[1], prm[2]])
    gain, bias = model.actuator_gainprm[index], model.actuator_biasprm[index]
    return {
        "gain": float(gain[0]) if gain_type == gains.mjGAIN_FIXED else from_drawn(gain),
        "bias": np.zeros(3) if bias_type == biases.mjBIAS_NONE else from_drawn(bias),
    }
