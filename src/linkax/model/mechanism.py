"""A mechanism: bodies, joints and forces, checked, with its spanning tree."""

from collections import Counter

import equinox as eqx

from linkax.model.bodies import GROUND_NAME, RigidBody
from linkax.model.forces import AbstractForce
from linkax.model.immobile_rows import split_rows
from linkax.model.joints.joint import AbstractJoint
from linkax.model.topology import GROUND_INDEX, Topology, spanning_tree


class Mechanism(eqx.Module):
    """Bodies held together by joints, with the forces on them.

    The spanning tree and the cut joints are found here, in any order of the joints: breadth
    first from ground, joints that carry a force element first. `print(mechanism.topology.describe())`
    shows the choice; `cut=True` on a joint forces it. Bodies and joints are kept in tree order.

    **Arguments:** `bodies`, `joints`, `forces`: sequences, names unique among bodies and among joints.

    **Raises:** `ValueError` naming the element: a duplicate or unknown name, a body that no
    joint connects to ground, a joint with `cut=True` that closes no loop.
    """

    bodies: tuple[RigidBody, ...]
    joints: tuple[AbstractJoint, ...]
    forces: tuple[AbstractForce, ...]
    topology: Topology = eqx.field(static=True)

    def __init__(self, bodies, joints, forces=()):
        bodies, joints = _checked(bodies, RigidBody, "bodies"), _checked(joints, AbstractJoint, "joints")
        forces = _checked(forces, AbstractForce, "forces")
        by_name = _by_name(bodies, "body")
        _check_references(by_name, _by_name(joints, "joint"), forces)
        driven = {name for force in forces for name in force.joints}
        order, carriers, predecessors, cuts = spanning_tree(list(by_name), joints, driven)
        for name in driven & {joint.name for joint in cuts}:
            raise ValueError(
                f"a force element acts along joint {name!r}, which is cut; remove cut=True, or the force "
                "elements along the other joints of its loop"
            )
        self.bodies = tuple(by_name[name] for name in order)
        self.joints = (*carriers, *cuts)
        self.forces = tuple(forces)
        index = {GROUND_NAME: GROUND_INDEX} | {name: position for position, name in enumerate(order)}
        self.topology = Topology(
            bodies=tuple(order),
            joints=tuple(joint.name for joint in self.joints),
            predecessor=tuple(index[name] for name in predecessors),
            parent=tuple(index[joint.parent.body] for joint in self.joints),
            child=tuple(index[joint.child.body] for joint in self.joints),
            joint_types=tuple(type(joint) for joint in self.joints),
            **split_rows(carriers, predecessors, cuts),
        )

    def body(self, name: str) -> RigidBody:
        """The body of that name."""
        return self.bodies[_find(name, self.topology.bodies, "body")]

    def joint(self, name: str) -> AbstractJoint:
        """The joint of that name."""
        return self.joints[_find(name, self.topology.joints, "joint")]


def _find(name, names, what):
    if name not in names:
        raise ValueError(f"unknown {what} {name!r}; known: {', '.join(map(repr, names))}")
    return names.index(name)


def _checked(elements, kind, what):
    elements = list(elements)
    for element in elements:
        if not isinstance(element, kind):
            raise ValueError(f"{what} holds {element!r}, which is no {kind.__name__.removeprefix('Abstract')}")
    return elements


def _by_name(elements, what):
    for name, count in Counter(element.name for element in elements).items():
        if count > 1:
            raise ValueError(f"{what} {name!r} appears {count} times; give each {what} a name of its own")
    return {element.name: element for element in elements}


def _check_references(bodies, joints, forces):
    for joint in joints.values():
        for frame in (joint.parent, joint.child):
            if frame.body not in bodies and frame.body != GROUND_NAME:
                raise ValueError(
                    f"joint {joint.name!r} attaches to body {frame.body!r}, which is not in bodies; add it there"
                )
    for force in forces:
        for name in force.joints:
            kind = type(force).__name__
            if name not in joints:
                raise ValueError(f"{kind} acts along unknown joint {name!r}; known: {', '.join(map(repr, joints))}")
            if joints[name].num_coordinates != 1:
                raise ValueError(
                    f"{kind} acts along joint {name!r}, which has {joints[name].num_coordinates} coordinates, not one"
                )
