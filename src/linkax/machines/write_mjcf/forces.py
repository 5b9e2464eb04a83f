"""Forces of a model: attributes of joints, springs and dampers of tendons, actuators."""

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np

from linkax.machines.write_mjcf.actuators import write_actuator
from linkax.machines.write_mjcf.model import Model, refused, terms_of, words
from linkax.model.forces.affine_actuator import AffineActuator
from linkax.model.forces.force import Gravity
from linkax.model.forces.joint_forces import JointDamper, JointFriction, JointInertia, JointSpring, JointTorque
from linkax.model.forces.joint_limits import JointLimit
from linkax.model.forces.point_forces import Damper, Spring

NO_END = 1e10  # of a range with one end [rad or m], MuJoCo's largest number
SUMMED: dict[type, tuple[str, str]] = {  # along a joint, by its attribute of MuJoCo and that of linkax
    JointDamper: ("damping", "damping"),
    JointFriction: ("frictionloss", "torque"),
    JointInertia: ("armature", "inertia"),
}
BETWEEN_POINTS: dict[type, dict[str, str]] = {
    Spring: {"stiffness": "stiffness", "springlength": "free_length"},
    Damper: {"damping": "damping"},
}


def write_forces(model: Model, forces: Iterable[tuple[str, Any]]) -> None:
    """Write forces, each with its name.

    **Raises:** `ValueError` for one that MuJoCo does not have.
    """
    sums = defaultdict[tuple[str, str, int], float](float)
    for name, force in forces:
        if type(force) in SUMMED:
            attribute, number = SUMMED[type(force)]
            model.joint(force, force.joint)
            sums[attribute, force.joint.joint, force.joint.index or 0] += float(getattr(force, number))
        else:
            _write(model, force, name)
    _set_sums(model, sums)


def _write(model: Model, force: Any, name: str) -> None:
    if type(force) is JointSpring:
        _set_once(model, force, stiffness=words(force.stiffness), springref=words(force.free))
    elif type(force) is JointLimit:
        ends = zip((force.range.lower, force.range.upper), (-NO_END, NO_END), strict=True)
        _set_once(model, force, limited="true", range=words([far if end is None else end for end, far in ends]))
    elif type(force) is JointTorque and not callable(force.torque):
        write_actuator(model, force, name, {force.joint: 1.0}, np.ones(1), np.array([force.torque, 0.0, 0.0]))
    elif type(force) is AffineActuator and not callable(force.control):
        gain = np.atleast_1d(np.asarray(force.gain))
        bias = np.asarray(force.bias) + np.pad(gain, (0, 3 - len(gain))) * float(force.control)
        write_actuator(model, force, name, terms_of(force.transmission), gain, bias, force.force_range)
    elif type(force) in BETWEEN_POINTS:
        sites = [model.site_at(f"{name}.{end}", getattr(force, end)) for end in ("first", "second")]
        numbers = {entry: words(getattr(force, field)) for entry, field in BETWEEN_POINTS[type(force)].items()}
        model.spatial(name, sites, **numbers)
    elif type(force) is not Gravity:
        is_law = isinstance(force, JointTorque | AffineActuator)
        why = "MuJoCo knows no functions of time; give a number" if is_law else "MuJoCo has no such force"
        raise refused(force, why)


def _set_once(model: Model, force: Any, **attributes: str) -> None:
    """Set attributes of a joint that it has once."""
    joint = model.joint(force, force.joint)
    if next(iter(attributes)) in joint.attrib:
        raise refused(force, f"joint {joint.get('name')!r} has two of its kind, in MuJoCo one; join them")
    joint.attrib.update(attributes)


def _set_sums(model: Model, sums: dict[tuple[str, str, int], float]) -> None:
    """Set damping, friction and inertia along joints; a ball has one number of each for all its axes."""
    for attribute, joint, index in sums:
        element = model.along[joint, index]
        alike = [key for key, other in model.along.items() if other is element]
        found = {sums.get((attribute, *key), 0.0) for key in alike}
        if len(found) > 1:
            raise ValueError(
                f"joint {joint!r}: {attribute} about its three axes is {sorted(found)}, and MuJoCo has one number "
                "for all; make them equal"
            )
        element.set(attribute, words(found.pop()))
