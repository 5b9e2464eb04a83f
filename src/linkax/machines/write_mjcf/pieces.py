"""What MuJoCo has of a mechanism: its bodies in the order of MuJoCo, and the joints that each joint consists of."""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from linkax.machines.poses import pose
from linkax.model.bodies import Frame
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.rectangular import Rectangular
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.screw import Screw
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import require_type, value
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.xla.tracing import all_concrete


class Piece(NamedTuple):
    """A joint of MuJoCo, of which those of linkax consist.

    - `index`: of the speed of linkax's joint, the first of three for a ball. `axis`: h¹, h² or h³, from 0.
    - `advances`: a slide that a thread moves with the turn.
    """

    kind: Literal["hinge", "slide", "ball", "free"]
    index: int
    axis: int
    advances: bool = False


# From the parent on, as each moves all that follow.
PIECES: dict[type, tuple[Piece, ...]] = {
    Fixed: (),
    Revolute: (Piece("hinge", 0, 0),),
    Prismatic: (Piece("slide", 0, 0),),
    Spherical: (Piece("ball", 0, 0),),
    Universal: (Piece("hinge", 0, 0), Piece("hinge", 1, 1)),
    Cylindrical: (Piece("slide", 1, 0), Piece("hinge", 0, 0)),
    Planar: (Piece("slide", 1, 1), Piece("slide", 2, 2), Piece("hinge", 0, 0)),
    Rectangular: (Piece("slide", 0, 1), Piece("slide", 1, 2)),
    Screw: (Piece("slide", 0, 0, advances=True), Piece("hinge", 0, 0)),
    Free: (Piece("slide", 3, 0), Piece("slide", 4, 1), Piece("slide", 5, 2), Piece("ball", 0, 0)),
}
FREE = (Piece("free", 0, 0),)


def check_tree(mechanism: Mechanism, state: Any = None) -> None:
    """Check that the tree is one of MuJoCo, and that all numbers of mechanism and state are known.

    **Raises:** `ValueError` naming what MuJoCo does not have: beams, joints, a body "world"; for what is traced, and
    for batches.
    """
    require_type(mechanism, Mechanism, "mechanism", "give a linkax.Mechanism")
    if not all_concrete((mechanism, state)):
        raise ValueError("the mechanism is traced, and MuJoCo needs numbers; call this outside of jit, grad and vmap")
    if mechanism.beams:
        raise ValueError(f"beam {mechanism.beams[0].name!r}: MuJoCo has no such beam; put rigid bodies in its place")
    topology = mechanism.topology
    for body, joint in zip(mechanism.bodies, mechanism.joints[: topology.num_bodies], strict=True):
        if np.ndim(body.mass):
            raise ValueError(f"the mechanism is a batch of shape {np.shape(body.mass)}; give one member at a time")
        if body.name == "world":
            raise ValueError("body 'world' has the name of MuJoCo's ground; give it another one")
        if type(joint) not in PIECES:
            kinds = ", ".join(kind.__name__ for kind in PIECES)
            raise ValueError(f"joint {joint.name!r} is a {type(joint).__name__}, which MuJoCo has not; it has {kinds}")


def outwards(topology: Topology) -> Iterator[int]:
    """All bodies from the ground on, depth first, as MuJoCo numbers them."""
    carried = defaultdict[int, list[int]](list)
    for body, predecessor in enumerate(topology.predecessor):
        carried[predecessor].append(body)
    open_ones = carried[GROUND_INDEX][::-1]
    while open_ones:
        body = open_ones.pop()
        yield body
        open_ones += carried[body][::-1]


def pieces_of(mechanism: Mechanism, body: int) -> tuple[Piece, ...]:
    """The joints of MuJoCo that carry a body, from what carries it on."""
    topology, joint = mechanism.topology, mechanism.joints[body]
    if topology.reversed[body]:
        return PIECES[type(joint)][::-1]
    if type(joint) is Free and topology.predecessor[body] == GROUND_INDEX:
        elements = (*mechanism.forces, *mechanism.constraints)
        return PIECES[Free] if any(joint.name in element.joints for element in elements) else FREE
    return PIECES[type(joint)]


def ends_of(mechanism: Mechanism, body: int) -> tuple[Frame, Frame]:
    """The frames of the joint that carries a body, on what carries it and on the body."""
    joint = mechanism.joints[body]
    return (joint.child, joint.parent) if mechanism.topology.reversed[body] else (joint.parent, joint.child)


def pose_of(frame: Frame) -> Float[np.ndarray, "4 4"]:
    """The pose of a frame on its body."""
    return pose(np.asarray(frame.offset), np.asarray(value(frame.rotation)))
