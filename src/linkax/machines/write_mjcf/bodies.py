"""Bodies of a model, nested by the spanning tree, with their joints, inertia and sites."""

import numpy as np

from linkax.machines.poses import inverse, pose
from linkax.machines.write_mjcf.model import Element, Model, add, at, polynomial, words
from linkax.machines.write_mjcf.pieces import ends_of, outwards, pieces_of, pose_of
from linkax.model.bodies import RigidBody
from linkax.model.joints.screw import Screw

LEAST = 2e-15  # mass [kg] and moments of inertia [kg m²]; MuJoCo refuses moving bodies with less than 1e-15
SLACK = 1e-12  # of the largest moment of inertia, by which the others exceed it at least, as MuJoCo does not round


def write_bodies(model: Model) -> None:
    """Write all bodies, with the joints that carry them."""
    mechanism, topology = model.mechanism, model.topology
    labels = [label for body in mechanism.bodies for label in body.frames]
    for index in outwards(topology):
        body, carrier = mechanism.bodies[index], topology.predecessor[index]
        before, after = map(pose_of, ends_of(mechanism, index))
        own = before @ inverse(after)
        model.drawn[index] = model.drawn[carrier] @ own
        element = model.bodies[index] = add(model.bodies[carrier], "body", name=body.name, **at(own))
        _write_joints(model, element, index)
        add(element, "inertial", **_inertial(body))
        for label, offset in body.frames.items():
            name = label if labels.count(label) == 1 else f"{body.name}.{label}"
            model.site(name, index, pose(np.asarray(offset)))


def _write_joints(model: Model, element: Element, body: int) -> None:
    """Write the joints of MuJoCo that carry a body, and the equality that holds a screw's slide to its turn."""
    joint, reverse = model.mechanism.joints[body], bool(model.topology.reversed[body])
    axes = np.asarray(joint.frames()[0 if reverse else 1]) * (-1.0 if reverse else 1.0)
    place = words(ends_of(model.mechanism, body)[1].offset)
    pieces = pieces_of(model.mechanism, body)
    plain = len(pieces) - isinstance(joint, Screw) == 1
    for piece in pieces:
        name = joint.name if plain else f"{joint.name}[{piece.index}]"
        name = f"{joint.name}.advance" if piece.advances else name
        found = add(element, "joint", name=name, type=piece.kind)
        if piece.kind != "free":
            found.set("pos", place)
        if piece.kind in ("hinge", "slide"):
            found.set("axis", words(axes[:, piece.axis]))
        if piece.advances and isinstance(joint, Screw):
            related = {"joint1": name, "joint2": joint.name, "polycoef": polynomial(0.0, joint.pitch)}
            model.equality("joint", f"{joint.name}.thread", **related)
            continue
        for index in range(3) if piece.kind == "ball" else (piece.index,):
            model.along[joint.name, index] = found


def _inertial(body: RigidBody) -> dict[str, str]:
    """Mass, centre and principal moments of inertia, as MuJoCo takes them."""
    inertia, axes = np.asarray(body.inertia, dtype=float), np.eye(3)
    moments = np.diag(inertia)
    if not np.array_equal(inertia, np.diag(moments)):
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.linalg.det(axes)
    moments = np.maximum(moments, max(LEAST, SLACK * moments.max()))
    least, middle, most = np.argsort(moments)
    moments[least] = max(moments[least], moments[most] * (1.0 + SLACK) - moments[middle])
    numbers = {"mass": max(float(body.mass), LEAST), "diaginertia": moments}
    return at(pose(np.asarray(body.center_of_mass), axes)) | {name: words(entry) for name, entry in numbers.items()}
