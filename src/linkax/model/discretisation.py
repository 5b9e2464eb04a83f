"""Take beams apart into rigid sections, the joints between them, and their elastic forces."""

import copy
from collections.abc import Iterable
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from linkax.model.beams import MASS_PLACES, Beam, BeamElasticity, FrameOnBeam
from linkax.model.bodies import Frame, RigidBody
from linkax.model.constraints.constraint import AbstractConstraint
from linkax.model.elements import is_own
from linkax.model.forces.force import AbstractForce
from linkax.model.forces.joint_forces import JointInertia
from linkax.model.functions import Law
from linkax.model.joints.bending import BeamSegment, OnBeam, SleevePart, Sliding
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.joint import AbstractJoint, JointKind
from linkax.model.numbers import rotation_matrix
from linkax.xla.arrays import ScalarLike


class Parts(NamedTuple):
    """The parts of a mechanism, with beams cut into segments and nodes."""

    bodies: list[RigidBody]
    joints: list[AbstractJoint]
    forces: list[AbstractForce]
    constraints: list[AbstractConstraint]


def discretise_beams(
    bodies: list[RigidBody | Beam],
    joints: list[AbstractJoint],
    forces: list[AbstractForce],
    constraints: list[AbstractConstraint],
) -> Parts:
    """Replace each beam by sections, joints and forces, unless its sections are among the bodies already.

    Places on it, and the parts of sleeves on it, become massless bodies.
    """
    names = {body.name for body in bodies}
    beams = {body.name: body for body in bodies if isinstance(body, Beam) and body.nodes[0] not in names}
    of_beams = [body for body in bodies if not isinstance(body, Beam) or body.name in beams]
    sections = [part for body in of_beams for part in (_sections(body) if isinstance(body, Beam) else [body])]
    if not beams:
        return Parts(sections, joints, forces, constraints)
    stations, holds = [], []

    def on_station(part: Any) -> Any:
        """Replace a place on a beam by a frame on a massless body that is held there; keep other parts."""
        if not (isinstance(part, FrameOnBeam) and part.body in beams):
            return part
        name = f"{part.body}({sum(body.name.startswith(part.body + '(') for body in stations) + 1})"
        stations.append(RigidBody(name, 0.0))
        holds.append(_hold(beams[part.body], name, part))
        return Frame(name, jnp.asarray(part.offset) * np.array([0.0, 1.0, 1.0]), part.rotation)

    elements = (joints, forces, constraints)
    joints, forces, constraints = jax.tree.map(on_station, elements, is_leaf=lambda part: isinstance(part, Frame))
    split = [_split_sleeve(joint, beams) for joint in joints]
    segments = [segment for beam in beams.values() for segment in _segments(beam)]
    return Parts(
        [*sections, *stations, *(body for between, _ in split for body in between)],
        [*segments, *holds, *(joint for _, parts in split for joint in parts)],
        [*forces, *map(BeamElasticity, beams.values())],
        constraints,
    )


def counted(parts: Parts) -> set[str]:
    """Name the joints that need coordinates of their own, which count turns.

    Those with inertia along them, those that constraints relate, and those whose angles forces read, or may read by
    functions of their own.
    """
    units = {joint.name: joint.speed_units for joint in parts.joints}
    is_law = lambda node: isinstance(node, Law)
    may_read = lambda force: (
        force.needs_coordinate or is_own(force) or any(map(is_law, jax.tree.leaves(force, is_leaf=is_law)))
    )
    angles = [along for force in parts.forces if may_read(force) for along in force.terms]
    turning = {along.joint for along in angles if units[along.joint][along.index or 0] == "rad"}
    inertial = {name for force in parts.forces if isinstance(force, JointInertia) for name in force.joints}
    return turning | inertial | {name for constraint in parts.constraints for name in constraint.joints}


def to_split(parts: Parts, cuts: Iterable[AbstractJoint]) -> list[AbstractJoint]:
    """Find the cut joints that belong into the tree: those with a motion, or with need of coordinates, of their own."""
    needed = counted(parts)
    moves_its_own_way = lambda joint: isinstance(joint.kind, JointKind) and not isinstance(joint, OnBeam)
    return [joint for joint in cuts if moves_its_own_way(joint) or joint.name in needed]


def split_cuts(parts: Parts, cuts: Iterable[AbstractJoint]) -> Parts:
    """Put cut joints into the tree, with a massless body behind each: a weld closes each loop in their place."""
    bodies, joints = [*parts.bodies], {joint.name: [joint] for joint in parts.joints}
    for joint in cuts:
        end = RigidBody(f"{joint.name} (end)", 0.0)
        carrier = copy.copy(joint)
        for name, entry in (("child", end.reference), ("cut", False)):
            object.__setattr__(carrier, name, entry)
        bodies.append(end)
        joints[joint.name] = [carrier, Fixed(f"{joint.name} (closed)", end, joint.child, cut=True)]
    return parts._replace(bodies=bodies, joints=[joint for own in joints.values() for joint in own])


def tree_joints_first(joints: Iterable[AbstractJoint]) -> list[set[str]]:
    """Name the joints that must be in the tree: those of beams, then also those that slide on beams."""
    joints = list(joints)
    segments = {joint.name for joint in joints if isinstance(joint, BeamSegment)}
    return [segments, {joint.name for joint in joints if isinstance(joint, OnBeam)}]


def _sections(beam: Beam) -> list[RigidBody]:
    """Make the sections of a beam: massless at nodes, with half of an element's mass at each place between them."""
    density, (about_y, about_z) = beam.section.linear_density, beam.section.rotary_inertia
    inertia, share = jnp.stack([about_y + about_z, about_y, about_z]), beam.element_length / len(MASS_PLACES)
    at_nodes = {name: RigidBody(name, 0.0) for name in beam.nodes}
    between = lambda name: RigidBody(name, share * density, inertia=share * inertia)
    return [at_nodes[name] if name in at_nodes else between(name) for name in beam.sections]


def _segments(beam: Beam) -> list[BeamSegment]:
    """Make the joints from the first node of each element to its second node and to the sections between them."""
    joints = []
    for element, far in enumerate(beam.nodes[1:]):
        joints.append(_segment(beam, beam.name if element == 0 else far, far, element, 1.0))
        for place in MASS_PLACES:
            name = beam.section_name(element + place)
            joints.append(_segment(beam, name, name, element, float(place)))
    return joints


def _hold(beam: Beam, name: str, place: FrameOnBeam) -> BeamSegment:
    """Make the joint that holds a massless body at a place on the axis."""
    within = place.offset[0] / beam.element_length - place.element
    return _segment(beam, name, name, place.element, within)


def _segment(beam: Beam, name: str, child: str, element: int, place: ScalarLike) -> BeamSegment:
    return BeamSegment(name, _reference(beam.nodes[element]), _reference(child), beam, element, place)


def _split_sleeve(sleeve: AbstractJoint, beams: dict[str, Beam]) -> tuple[list[RigidBody], list[AbstractJoint]]:
    """Split a sleeve into parts, one in each element, and massless bodies between them; keep other joints."""
    if not (isinstance(sleeve, Sliding) and sleeve.beam in beams):
        return [], [sleeve]
    beam = beams[sleeve.beam]
    between = [RigidBody(f"{sleeve.name}[{element + 1}]", 0.0) for element in range(beam.elements - 1)]
    ends = [sleeve.parent, *(body.reference for body in between), sleeve.child]
    names = [*(body.name for body in between), sleeve.name]
    parts = zip(names, pairwise(ends), strict=True)
    return between, [SleevePart(name, *pair, beam, element, sleeve.name) for element, (name, pair) in enumerate(parts)]


def _reference(body: str) -> Frame:
    return Frame(body, np.zeros(3), rotation_matrix(None, body))
