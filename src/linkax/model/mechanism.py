"""A mechanism: bodies, joints, constraints and forces, checked, with its spanning tree."""

from collections import Counter

import equinox as eqx

from linkax.model.beams import Beam, discretise_beams, held_first
from linkax.model.bodies import GROUND_NAME, RigidBody
from linkax.model.constraints import AbstractConstraint
from linkax.model.forces import AbstractForce
from linkax.model.immobile_rows import split_rows
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.distance import Distance
from linkax.model.joints.joint import AbstractJoint
from linkax.model.numbers import listed, require_bool
from linkax.model.topology import GROUND_INDEX, Topology, spanning_tree


class Mechanism(eqx.Module):
    """Bodies held together by joints, with the constraints and the forces on them.

    Beams are taken apart into sections, bodies with names such as "boom[2.5]" (in elements from the base), and
    places on them that something attaches to into massless bodies. `beams` holds them as they were given.

    The spanning tree and the cut joints are found here, in any order of the joints: breadth
    first from ground, joints that carry a constraint or a force element first.
    `print(mechanism.topology.describe())` shows the choice; `cut=True` on a joint forces it. Bodies
    and joints are kept in tree order.

    **Arguments:**

    - `bodies`, `joints`, `forces`: sequences; names unique among bodies and among joints.
    - `constraints`: `Coupling`, `Drive`, `Rope` and `Distance`; names unique among joints and constraints.
    - `all_rows`: keep those loop rows too that no motion changes, such as the out-of-plane rows of a planar
      loop. It changes no motion; Lagrange multipliers fail on such rows.

    **Raises:** `ValueError` naming the element: a duplicate or unknown name, a body that no
    joint connects to ground, a joint with `cut=True` that closes no loop.
    """

    bodies: tuple[RigidBody, ...]
    beams: tuple[Beam, ...]
    joints: tuple[AbstractJoint, ...]
    forces: tuple[AbstractForce, ...]
    constraints: tuple[AbstractConstraint, ...]
    topology: Topology = eqx.field(static=True)

    def __init__(self, bodies, joints, forces=(), constraints=(), *, all_rows=False):
        related = "give a list of Coupling, Drive, Rope or Distance"
        constraints = listed(constraints, (AbstractConstraint, Distance), "constraints", related)
        joints = listed(joints, AbstractJoint, "joints", "give a list of Revolute, Prismatic and their like")
        joints = [*joints, *(c for c in constraints if isinstance(c, Distance))]
        constraints = [c for c in constraints if not isinstance(c, Distance)]
        bodies = listed(bodies, (RigidBody, Beam), "bodies", "give a list of RigidBody or Beam")
        if not bodies:
            raise ValueError("bodies is empty, []; give at least one body")
        forces = listed(forces, AbstractForce, "forces", "give a list of Gravity, Spring and their like")
        beams = [body for body in bodies if isinstance(body, Beam)]
        bodies, joints, forces, constraints = discretise_beams(bodies, joints, forces, constraints)
        by_name, joint_by_name = _by_name(bodies, "body"), _by_name(joints, "joint")
        _by_name([*joints, *constraints], "joint or constraint")
        _check_references(by_name, joint_by_name, constraints, forces)
        related = {name for constraint in constraints for name in constraint.joints}
        acted_on = {name for force in forces for name in force.joints}
        first = [*held_first(joints), related, acted_on]
        order, carriers, predecessors, cuts = spanning_tree(list(by_name), joints, first)
        for joint in cuts:
            if isinstance(joint, OnBeam):
                raise ValueError(
                    f"joint {joint.name!r} slides along a beam and closes a loop; put a massless body on it, and close "
                    "the loop by another joint on that body"
                )
        for name in related & {joint.name for joint in cuts}:
            of_joint = ", ".join(repr(c.name) for c in constraints if name in c.joints)
            raise ValueError(
                f"constraint {of_joint} relates joint {name!r}, which is cut, and whose angle therefore does not count "
                "turns; remove cut=True, or relate fewer joints of this loop"
            )
        self.bodies = tuple(by_name[name] for name in order)
        self.beams = tuple(beams)
        self.joints = (*carriers, *cuts)
        self.forces = tuple(forces)
        self.constraints = tuple(constraints)
        index = {GROUND_NAME: GROUND_INDEX} | {name: position for position, name in enumerate(order)}
        self.topology = Topology(
            bodies=tuple(order),
            joints=tuple(joint.name for joint in self.joints),
            predecessor=tuple(index[name] for name in predecessors),
            parent=tuple(index[joint.parent.body] for joint in self.joints),
            child=tuple(index[joint.child.body] for joint in self.joints),
            joint_types=tuple(joint.kind for joint in self.joints),
            driven_by=tuple(joint.driven_by for joint in self.joints),
            **split_rows(carriers, predecessors, cuts, require_bool(all_rows, "all_rows")),
            constraints=tuple(constraint.name for constraint in constraints),
            constraint_terms=tuple(constraint.terms for constraint in constraints),
            constraint_bodies=tuple(tuple(index[f.body] for f in constraint.frames) for constraint in constraints),
        )

    def with_all_rows(self) -> "Mechanism":
        """The same mechanism with those loop rows too that no motion changes (see `all_rows`)."""
        bodies = (*self.bodies, *self.beams)
        return Mechanism(bodies, self.joints, self.forces, self.constraints, all_rows=True)

    def body(self, name: str) -> RigidBody | Beam:
        """The body of that name, a beam or one of its sections too."""
        names = (*self.topology.bodies, *(beam.name for beam in self.beams))
        return (*self.bodies, *self.beams)[_find(name, names, "body")]

    def joint(self, name: str) -> AbstractJoint:
        """The joint of that name."""
        return self.joints[_find(name, self.topology.joints, "joint")]


def _find(name, names, what):
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"unknown {what} {name!r}; known: {', '.join(map(repr, names))}")
    return names.index(name)


def _by_name(elements, what):
    for name, count in Counter(element.name for element in elements).items():
        if count > 1:
            raise ValueError(f"{what} {name!r} appears {count} times; give each {what} a name of its own")
    return {element.name: element for element in elements}


def _check_references(bodies, joints, constraints, forces):
    def check_frames(what, frames):
        for frame in frames:
            if frame.body not in bodies and frame.body != GROUND_NAME:
                raise ValueError(f"{what} attaches to body {frame.body!r}, which is not in bodies; add it there")

    def check_joint(what, name):
        if name not in joints:
            raise ValueError(f"{what} acts along unknown joint {name!r}; known: {', '.join(map(repr, joints))}")

    for joint in joints.values():
        check_frames(f"joint {joint.name!r}", (joint.parent, joint.child))
    for force in forces:
        check_frames(force.display_name, force.frames)
        for name, index in force.terms:
            check_joint(force.display_name, name)
            _check_index(force.display_name, joints[name], index, force.needs_coordinate)
    for constraint in constraints:
        check_frames(constraint.display_name, constraint.frames)
        for name, index in constraint.terms:
            check_joint(constraint.display_name, name)
            _check_index(constraint.display_name, joints[name], index, True)


def _check_index(what, joint, index, needs_coordinate):
    """Whether a joint has a speed of that index, and if need be a coordinate whose rate it is."""
    count = len(joint.speed_units)
    kind = f"joint {joint.name!r}, a {type(joint).__name__}"
    if index is None and count != 1:
        raise ValueError(f"{what} acts along {kind}, which has {count} speeds, not one; give ({joint.name!r}, index)")
    if not 0 <= (index or 0) < count:
        raise ValueError(f"{what} acts along speed {index} of {kind}, which has {count}; they are counted from 0")
    if needs_coordinate and joint.has_quaternion and (index or 0) < 3:
        raise ValueError(f"{what} acts along coordinate {index} of {kind}, which is part of a quaternion; use another")
