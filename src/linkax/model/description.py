"""A mechanism as a table: its bodies, joints, constraints and forces, with their numbers."""

import dataclasses
from typing import Any

import numpy as np

from linkax.model.beams import BeamElasticity
from linkax.model.bodies import GROUND_NAME, Frame
from linkax.model.functions import Law
from linkax.model.joints.bending import BeamSegment, OnBeam
from linkax.model.numbers import Constant
from linkax.tables import Rows, Table, count, known, numbers

Mechanism = Any  # a `linkax.Mechanism`, which imports this

UNITS = {
    "acceleration": "m/s²", "stiffness": "N/m", "free_length": "m", "damping": "N s/m", "force": "N", "moment": "N m",
    "length": "m", "pitch": "m/rad",
}  # fmt: skip
UNITS_ALONG = {
    "rad": {
        "stiffness": "N m/rad", "damping": "N m s/rad", "torque": "N m", "free": "rad", "scale": "rad/s",
        "speed": "rad/s", "start": "rad", "inertia": "kg m²",
    },
    "m": {
        "stiffness": "N/m", "damping": "N s/m", "torque": "N", "free": "m", "scale": "m/s",
        "speed": "m/s", "start": "m", "inertia": "kg",
    },
}  # fmt: skip
FRAMES = ("axis", "second_axis")  # which the tables leave out


def described(mechanism: Mechanism) -> Table:
    """Describe a mechanism; of beams not their parts."""
    topology = mechanism.topology
    parts_of_beams = [joint for joint in mechanism.joints if isinstance(joint, BeamSegment)]
    held = {section for beam in mechanism.beams for section in beam.sections}
    held |= {joint.child.body for joint in parts_of_beams}
    between = lambda name: name.endswith("]") and name.split("[")[0] in topology.joints  # parts of a sleeve
    bodies = [body for body in mechanism.bodies if body.name not in held and not between(body.name)]
    roles = ["tree"] * topology.num_bodies + ["cut"] * topology.num_cuts
    hidden = lambda joint: isinstance(joint, BeamSegment) or between(joint.name)
    joints = [(joint, role) for joint, role in zip(mechanism.joints, roles, strict=True) if not hidden(joint)]
    forces = [
        pair
        for pair in zip(mechanism.force_names, mechanism.forces, strict=True)
        if not isinstance(pair[1], BeamElasticity)
    ]
    title = f"Mechanism of {', '.join(_counts(mechanism, bodies, joints, forces))}"
    masses = [known(body.mass) for body in mechanism.bodies]
    if not any(mass is None or mass.shape for mass in masses):
        title += f"; {numbers(np.sum(masses), 'kg')}"
    constraints = [_constraint_row(topology, constraint) for constraint in mechanism.constraints]
    parts = [
        Rows(("body", "mass", "centre of mass", "moments of inertia"), [*map(_body_row, bodies)], "bodies"),
        Rows(("beam", "length", "elements", "damping"), [_beam_row(beam) for beam in mechanism.beams], "beams"),
        Rows(("joint", "type", "from", "to", "in"), [_joint_row(*pair) for pair in joints], "joints"),
        Rows(("constraint", "type", "of"), constraints, "constraints"),
        Rows(("force", "numbers"), [_force_row(topology, *pair) for pair in forces], "forces"),
    ]
    return Table(title, [part for part in parts if part.rows])


def _counts(mechanism, bodies, joints, forces):
    cuts = sum(role == "cut" for _, role in joints)
    yield count(len(bodies), "body")
    if mechanism.beams:
        yield count(len(mechanism.beams), "beam")
    yield count(len(joints), "joint") + (f" ({cuts} cut)" if cuts else "")
    if mechanism.constraints:
        yield count(len(mechanism.constraints), "constraint")
    yield count(len(forces), "force")


def _body_row(body):
    inertia = body.inertia
    if (tensor := known(inertia)) is not None:
        moments = np.linalg.eigvalsh(tensor)
        rounding = 10.0 * np.finfo(moments.dtype).eps * moments[..., -1:]
        inertia = np.where(np.abs(moments) > rounding, moments, 0.0)
    return body.name, numbers(body.mass, "kg"), numbers(body.center_of_mass, "m", 1), numbers(inertia, "kg m²", 1)


def _beam_row(beam):
    return beam.name, numbers(beam.length, "m"), str(beam.elements), numbers(beam.damping, "s")


def _joint_row(joint, role):
    own = () if isinstance(joint, OnBeam) else _own_numbers(joint, UNITS)
    kind = " ".join([type(joint).__name__.replace("SleevePart", "Sliding"), *own])
    return joint.name, kind, _place(joint.parent), _place(joint.child), role


def _place(frame):
    at = known(frame.offset)
    somewhere = frame.body == GROUND_NAME and at is not None and at.shape == (3,) and np.any(at)
    return f"{frame.body} at {numbers(at, 'm', 1)}" if somewhere else frame.body


def _constraint_row(topology, constraint):
    of = [*constraint.joints, *(frame.body for frame in constraint.frames)]
    own = _own_numbers(constraint, _units(topology, constraint))
    return constraint.name, type(constraint).__name__, ", ".join([*of, *own])


def _force_row(topology, name, force):
    return name, ", ".join(_own_numbers(force, _units(topology, force)))


def _units(topology, element):
    """Units of an element's numbers: along a joint where it acts along one."""
    units = UNITS
    for term in element.terms:
        kind = topology.joint_types[topology.joint_index(term.joint)]
        units = UNITS_ALONG[kind.speed_units[term.index or 0]]
    return units


def _own_numbers(element, units):
    """The numbers of an element, by the names of its fields."""
    for field in dataclasses.fields(element):
        entry = getattr(element, field.name)
        if field.metadata.get("static") or isinstance(entry, Frame | Constant) or field.name in FRAMES:
            continue
        if isinstance(entry, Law):
            yield f"{field.name} by a function"
        elif hasattr(entry, "shape"):
            yield f"{field.name} {numbers(entry, units.get(field.name, ''), np.ndim(entry))}"
