"""Mechanisms: bodies, joints, constraints and forces, checked, with a spanning tree."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import equinox as eqx
import jax

from linkax.model.beams import Beam
from linkax.model.bodies import GROUND_NAME, Frame, RigidBody
from linkax.model.constraints.constraint import AbstractConstraint, CoordinateConstraint
from linkax.model.description import described
from linkax.model.discretisation import (
    Parts,
    counted,
    discretise_beams,
    split_cuts,
    to_split,
    tree_joints_first,
)
from linkax.model.elements import is_own
from linkax.model.forces.force import AbstractForce, given_name
from linkax.model.forces.internal_states import checked_states
from linkax.model.functions import Law, check_unchanged, own_classes
from linkax.model.immobile_rows import split_rows
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.distance import Distance
from linkax.model.joints.joint import AbstractJoint
from linkax.model.names import find
from linkax.model.numbers import listed, read_only, require_bool
from linkax.model.spanning_tree import SpanningTree, spanning_tree
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.tables import printed_as
from scalarjit import kept_while_alive
from scalarjit.code import OwnClasses


@printed_as(described)
class Mechanism(eqx.Module):
    """Bodies connected by joints, with the constraints and forces on them.

    The spanning tree and the cut joints are found here, whatever the order of the joints: joints first that a
    constraint relates, that have inertia, whose angle a force reads or that it acts along, then breadth first from
    ground. A joint to cut of which a coordinate is needed gets a massless body behind it, which closes the loop in its
    place. `print(mechanism)` shows all in tables, `print(mechanism.topology.describe())` the tree; `cut=True` cuts a
    joint. Bodies and joints are kept in the order of the tree.

    A beam becomes sections, bodies with names such as "boom[2.5]" (counted in elements from the base), and a
    massless body at each place that something attaches to. `beams` holds the beams as given.

    **Arguments:**

    - `bodies`: `RigidBody` and `Beam`; names unique.
    - `joints`: `Revolute`, `Prismatic` and others; names unique among joints and constraints.
    - `forces`: `Gravity`, `Spring` and others.
    - `constraints`: `Coupling`, `Drive`, `Rope`, `Distance`, and your own, see `linkax.AbstractConstraint`.
    - `all_rows`: keep also loop rows that no motion changes, such as the out-of-plane rows of a planar loop. The
      motion is the same; Lagrange multipliers fail on such rows.

    **Raises:** `ValueError` naming the element: a duplicate or unknown name, a body that no joint connects to
    ground, a joint with `cut=True` that closes no loop.
    """

    bodies: tuple[RigidBody, ...]
    beams: tuple[Beam, ...]
    joints: tuple[AbstractJoint, ...]
    forces: tuple[AbstractForce, ...]
    constraints: tuple[AbstractConstraint, ...]
    topology: Topology = eqx.field(static=True, repr=False)
    own_classes: OwnClasses = eqx.field(static=True, repr=False)

    def __init__(
        self,
        bodies: Iterable[RigidBody | Beam],
        joints: Iterable[AbstractJoint],
        forces: Iterable[AbstractForce] = (),
        constraints: Iterable[AbstractConstraint | Distance] = (),
        *,
        all_rows: bool = False,
    ) -> None:
        given = _listed(bodies, joints, forces, constraints)
        _by_name(given[0], "body")  # of beams, too, which are parts with other names from here on
        parts = discretise_beams(*given)
        body_by_name = _check_names(parts)
        tree = _spanning_tree(list(body_by_name), parts)
        while misplaced := to_split(parts, tree.cuts):
            parts = split_cuts(parts, misplaced)
            body_by_name = _check_names(parts)
            tree = _spanning_tree(list(body_by_name), parts)
        self.bodies = read_only(tuple(body_by_name[name] for name in tree.bodies))
        self.beams = read_only(tuple(body for body in given[0] if isinstance(body, Beam)))
        self.joints = read_only((*tree.carriers, *tree.cuts))
        self.forces = read_only(tuple(parts.forces))
        self.constraints = read_only(tuple(parts.constraints))
        self.topology = _topology(tree, parts.constraints, require_bool(all_rows, "all_rows"))
        self.own_classes = own_classes((self.beams, self.joints, self.forces, self.constraints))

    def with_all_rows(self) -> "Mechanism":
        """Return the same mechanism with the loop rows too that no motion changes (see `all_rows`)."""
        bodies = (*self.bodies, *self.beams)
        return Mechanism(bodies, self.joints, self.forces, self.constraints, all_rows=True)

    def body(self, name: str) -> RigidBody | Beam:
        """Return the body of that name, which may be a beam or one of its sections.

        **Raises:** `ValueError` for an unknown name.
        """
        names = (*self.topology.bodies, *(beam.name for beam in self.beams))
        return (*self.bodies, *self.beams)[find(name, names, "body")]

    @property
    def force_names(self) -> tuple[str, ...]:
        """What to call each of `forces`: its name, else what it is and acts on, with a number for the second such."""
        names = []
        for force in self.forces:
            name = given_name(force) or force.display_name
            again = sum(other == name or other.startswith(f"{name} (") for other in names)
            names.append(f"{name} ({again + 1})" if again else name)
        return tuple(names)

    def joint(self, name: str) -> AbstractJoint:
        """Return the joint of that name.

        **Raises:** `ValueError` for an unknown name.
        """
        return self.joints[self.topology.joint_index(name)]

    def view(self, state: Any, path: str | os.PathLike | None = None, **settings: Any) -> Any:
        """Show the mechanism at a `linkax.State` in three dimensions; see `linkax.Solution.view`."""
        from linkax.simulation.read.solution import drawn

        return drawn(self, state).view(path, **settings)


def require_unchanged(mechanism: Mechanism) -> None:
    """Raise a `ValueError` where what functions of a mechanism, or classes of a user, read has changed since then."""
    for law in _laws(mechanism):
        law.check()
    for name, code in mechanism.own_classes:
        check_unchanged(f"{name}: what this class reads", code)


@kept_while_alive
def _laws(mechanism):
    is_law = lambda node: isinstance(node, Law)
    elements = mechanism.joints, mechanism.forces, mechanism.constraints
    return [*filter(is_law, jax.tree.leaves(elements, is_leaf=is_law))]


# What belongs into each argument, and what to give; a `Distance`, which is a joint, first of all among constraints.
ARGUMENTS = {
    "constraints": ((AbstractConstraint, Distance), "give a list of Coupling, Drive, Rope or Distance"),
    "bodies": ((RigidBody, Beam), "give a list of RigidBody or Beam"),
    "joints": (AbstractJoint, "give a list of Revolute, Prismatic and their like"),
    "forces": (AbstractForce, "give a list of Gravity, Spring and their like"),
}
ELEMENTS = tuple(kinds for kinds, _ in ARGUMENTS.values())


def _listed(
    bodies: Any, joints: Any, forces: Any, constraints: Any
) -> tuple[list[RigidBody | Beam], list[AbstractJoint], list[AbstractForce], list[AbstractConstraint]]:
    """Check and list what a user gives. A `Distance` moves from the constraints to the joints."""
    constraints, joints = _all_of("constraints", constraints), _all_of("joints", joints)
    joints = [*joints, *(c for c in constraints if isinstance(c, Distance))]
    constraints = [c for c in constraints if not isinstance(c, Distance)]
    bodies = _all_of("bodies", bodies)
    if not bodies:
        raise ValueError("bodies is empty, []; give at least one body")
    return bodies, joints, _all_of("forces", forces), constraints


def _all_of(argument: str, entries: Any) -> list[Any]:
    """List the elements of an argument; those that belong into another one are told by name."""
    kinds, remedy = ARGUMENTS[argument]
    if isinstance(entries, ELEMENTS):
        raise ValueError(f"{argument} is one element, {_named(entries)}; {remedy}")
    entries = listed(entries, object, argument, remedy)
    for entry in entries:
        if isinstance(entry, ELEMENTS) and not isinstance(entry, kinds):
            right = next(name for name, (kinds, _) in ARGUMENTS.items() if isinstance(entry, kinds))
            raise ValueError(f"{_named(entry)} belongs in {right}=[...]; take it out of {argument}")
    return listed(entries, kinds, argument, remedy)


def _named(element: Any) -> str:
    return getattr(element, "display_name", None) or f"{type(element).__name__} {element.name!r}"


def _check_names(parts: Parts) -> dict[str, RigidBody]:
    """Check that names are unique and that all that elements refer to is there; return the bodies by name."""
    bodies, joints = _by_name(parts.bodies, "body"), _by_name(parts.joints, "joint")
    _by_name([*parts.joints, *parts.constraints], "joint or constraint")
    forces = [force for force in parts.forces if given_name(force)]
    _by_name([*parts.joints, *parts.constraints, *forces], "joint, constraint or force")
    _check_references(bodies, joints, parts.constraints, parts.forces)
    for force in parts.forces:
        checked_states(force.states, force.display_name)
    return bodies


def _spanning_tree(bodies: list[str], parts: Parts) -> SpanningTree:
    """Find the tree, where possible with joints in it that need coordinates, then those that a force acts along."""
    acted_on = {name for force in parts.forces for name in force.joints}
    first = [*tree_joints_first(parts.joints), counted(parts), acted_on]
    tree = spanning_tree(bodies, parts.joints, first)
    for joint in tree.cuts:
        if isinstance(joint, OnBeam):
            raise ValueError(
                f"joint {joint.name!r} slides along a beam and closes a loop; put a massless body on it, and close "
                "the loop by another joint on that body"
            )
    return tree


def _topology(tree: SpanningTree, constraints: list[AbstractConstraint], all_rows: bool) -> Topology:
    joints = [*tree.carriers, *tree.cuts]
    index = {GROUND_NAME: GROUND_INDEX} | {name: position for position, name in enumerate(tree.bodies)}
    return Topology(
        bodies=tuple(tree.bodies),
        joints=tuple(joint.name for joint in joints),
        predecessor=tuple(index[name] for name in tree.predecessors),
        parent=tuple(index[joint.parent.body] for joint in joints),
        child=tuple(index[joint.child.body] for joint in joints),
        joint_types=tuple(cast(Any, joint.kind) for joint in joints),
        driven_by=tuple(joint.driven_by for joint in joints),
        **split_rows(tree, all_rows),
        constraints=tuple(constraint.name for constraint in constraints),
        constraint_rows=tuple(constraint.num_rows for constraint in constraints),
        constraint_slips=tuple(len(constraint.slip_units) for constraint in constraints),
        constraint_terms=tuple(constraint.terms for constraint in constraints),
        constraint_bodies=tuple(tuple(index[f.body] for f in constraint.frames) for constraint in constraints),
    )


def _by_name(elements: Sequence[Any], what: str) -> dict[str, Any]:
    for name, count in Counter(element.name for element in elements).items():
        if count > 1:
            raise ValueError(f"{what} {name!r} appears {count} times; give each {what} a name of its own")
    return {element.name: element for element in elements}


def _check_references(
    bodies: Mapping[str, RigidBody],
    joints: Mapping[str, AbstractJoint],
    constraints: Sequence[AbstractConstraint],
    forces: Sequence[AbstractForce],
) -> None:
    def check_frames(what: str, frames: Sequence[Frame]) -> None:
        for frame in frames:
            if frame.body not in bodies and frame.body != GROUND_NAME:
                raise ValueError(f"{what} attaches to body {frame.body!r}, which is not in bodies; add it there")

    def check_joint(what: str, name: str) -> None:
        if name not in joints:
            raise ValueError(f"{what} acts along unknown joint {name!r}; known: {', '.join(map(repr, joints))}")

    for joint in joints.values():
        check_frames(f"joint {joint.name!r}", (joint.parent, joint.child))
        if is_own(joint):
            joint.check_transform()
    for force in forces:
        check_frames(force.display_name, force.frames)
        for name, index in force.terms:
            check_joint(force.display_name, name)
            _check_index(force.display_name, joints[name], index, force.needs_coordinate)
    for constraint in constraints:
        check_frames(constraint.display_name, constraint.frames)
        for name, index in constraint.terms:
            check_joint(constraint.display_name, name)
            if isinstance(constraint, CoordinateConstraint):
                _check_index(constraint.display_name, joints[name], index, True)
        if is_own(constraint):
            constraint.check_residual({name: joints[name].num_coordinates for name in constraint.joints})


def _check_index(what: str, joint: AbstractJoint, index: int | None, needs_coordinate: bool) -> None:
    """Check that a joint has a speed of that index, and where needed a coordinate whose rate it is."""
    count = len(joint.speed_units)
    kind = f"joint {joint.name!r}, a {type(joint).__name__}"
    if index is None and count != 1:
        raise ValueError(f"{what} acts along {kind}, which has {count} speeds, not one; give ({joint.name!r}, index)")
    if not 0 <= (index or 0) < count:
        raise ValueError(f"{what} acts along speed {index} of {kind}, which has {count}; they are counted from 0")
    if needs_coordinate and joint.has_quaternion and (index or 0) < 3:
        raise ValueError(f"{what} acts along coordinate {index} of {kind}, which is part of a quaternion; use another")
