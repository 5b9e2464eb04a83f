"""Actuators of MJCF: forces along a joint or a fixed tendon, affine in control, length and rate."""

from typing import Any

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.mjcf.tendons import transmission
from linkax.machines.xml import Where
from linkax.model.forces.affine_actuator import AffineActuator


def read_actuators(compiled: Compiled) -> None:
    """Read all actuators, or note what they are."""
    draft = compiled.draft
    for index, name in enumerate(compiled.names("actuator")):
        where = compiled.where("actuator", index)
        if draft.ignores("actuator", where, "the actuator"):
            continue
        on_tendon, terms = _terms(compiled, index, where)
        law = _law(compiled, index, terms or {})
        if terms and law is not None:
            draft.force(AffineActuator, name, where, transmission=terms, control=0.0, **law)
        elif terms is not None or not on_tendon:
            reason = "an actuator that is not affine, has a state, or acts on no hinge, slide or fixed tendon"
            draft.leave_out(where, "actuator", reason)


def _terms(compiled: Compiled, index: int, where: Where) -> tuple[bool, dict[str, float] | None]:
    """Whether it acts on a tendon, and joints with their factors; None on another thing, which a tendon notes."""
    model, kinds = compiled.model, compiled.mujoco.mjtTrn
    on, target = kinds(int(model.actuator_trntype[index])), int(model.actuator_trnid[index][0])
    terms: dict[str, float] | None = None
    if on == kinds.mjTRN_TENDON:
        terms = transmission(compiled, target, where)
    elif on in (kinds.mjTRN_JOINT, kinds.mjTRN_JOINTINPARENT) and compiled.joint_kinds[target] in ("hinge", "slide"):
        terms = {compiled.joint_names[target]: 1.0}
    gear = float(model.actuator_gear[index][0])
    return on == kinds.mjTRN_TENDON, terms and {joint: gear * factor for joint, factor in terms.items()}


def _law(compiled: Compiled, index: int, terms: dict[str, float]) -> dict[str, Any] | None:
    """Gain, bias and range of the force, for a length that is zero where the file draws it; None where not affine."""
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
    found: dict[str, Any] = {
        "gain": float(gain[0]) if gain_type == gains.mjGAIN_FIXED else from_drawn(gain),
        "bias": np.zeros(3) if bias_type == biases.mjBIAS_NONE else from_drawn(bias),
    }
    if model.actuator_forcelimited[index]:
        found["force_range"] = np.array(model.actuator_forcerange[index])
    return found
