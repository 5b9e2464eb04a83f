"""Describe a moving mechanism as JSON and numbers, for `viewer.js` to draw."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.model.bodies import GROUND_NAME, Frame, RigidBody
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.distance import Distance
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.joint import AbstractJoint
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.rectangular import Rectangular
from linkax.model.joints.screw import Screw
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal
from linkax.scenery.camera import gravity, upwards
from linkax.scenery.colours import BODY_COLOURS, body_colour
from linkax.scenery.scenery import (
    Scenery,
    Span,
    is_concentrated,
    is_hinge,
    is_shaped,
    is_slide,
    moving_frame,
    principal_box,
    spans,
)
from linkax.view.solids import solids_of, space

FLAT = 1e-6  # size of a singular value, relative to the largest, up to which marked points lie in a plane or line
SYMBOLS = {
    Cylindrical: "sleeve", Screw: "sleeve", Prismatic: "box", Spherical: "ball", Universal: "cross", Fixed: "weld",
    Planar: "plate", Rectangular: "plate", Free: None, Distance: None,
}  # fmt: skip


class Numbers:
    """One array of all numbers; each of its parts is told by [where it starts, how many there are]."""

    def __init__(self) -> None:
        self.parts: list[np.ndarray] = []
        self.count = 0

    def add(self, values: Any) -> list[int]:
        """Append numbers, and tell where they are."""
        flat = np.asarray(values, np.float64).reshape(-1)
        self.parts.append(flat)
        self.count += len(flat)
        return [self.count - len(flat), len(flat)]

    def bytes(self) -> bytes:
        """All numbers, little endian."""
        return np.concatenate(self.parts).astype("<f8").tobytes()


def contents(scenery: Scenery, arrows: dict[str, tuple[Frame, np.ndarray]]) -> tuple[dict[str, Any], bytes, bytes]:
    """Describe bodies, joints, spans, traced points and arrows; positions in [m], ground axes.

    **Arguments:** `arrows`: {label: the frame where it begins, and its components at each time, (n_f, 3) [N]}.

    **Returns:** the description, its numbers and those of meshes, to which it refers by where they are.
    """
    mechanism, numbers = scenery.mechanism, Numbers()
    names = [*mechanism.topology.bodies, GROUND_NAME]
    solids, meshes = solids_of(mechanism)
    (low, high), up = space(scenery, solids, meshes), upwards(mechanism)
    place = lambda frame: [names.index(frame.body), _listed(frame.offset)]
    described = {
        "times": numbers.add(scenery.times),
        "low": _listed(low),
        "high": _listed(high),
        "up": _listed(up if abs(up @ scenery.camera.toward) < 0.9 else scenery.camera.up),
        "camera": {"up": _listed(scenery.camera.up), "toward": _listed(scenery.camera.toward)},
        "gravity": float(np.linalg.norm(gravity(mechanism))),
        "bodies": [
            {
                "name": name,
                "label": _label(mechanism, name),
                "colour": body_colour(index) if name != GROUND_NAME else "#777777",
                "position": numbers.add(scenery.poses[name][0]),
                "quaternion": numbers.add(quaternions(scenery.poses[name][1])),
                "parts": solids.get(name) or parts_of(scenery, name),
            }
            for index, name in enumerate(names)
        ],
        "joints": [_symbol(joint, place) for joint in mechanism.joints if not isinstance(joint, OnBeam)],
        "spans": [
            {
                "kind": span.kind,
                "label": span.label,
                "colour": span_colour(span, index),
                "points": [place(point) for point in span.points],
            }
            for index, span in enumerate(spans(mechanism))
        ],
        "points": [
            {"name": name, "position": numbers.add(positions), "curve": numbers.add(scenery.curves[name])}
            for name, positions in scenery.points.items()
        ],
        "arrows": [
            {"label": label, "unit": "N", "at": place(frame), "vector": numbers.add(values), "colour": BODY_COLOURS[1]}
            for label, (frame, values) in arrows.items()
        ],
    }
    return described | {"meshes": meshes.described}, numbers.bytes(), meshes.bytes()


def quaternions(axes: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 4"]:
    """Unit quaternions (x, y, z, w) of rotations, without a jump of sign from one to the next."""
    from scipy.spatial.transform import Rotation  # takes its time to import

    found = Rotation.from_matrix(np.array(axes)).as_quat()  # a copy: SciPy 1.15 refuses arrays that are read-only
    turns = np.sign(np.sum(found[1:] * found[:-1], axis=1))
    found[1:] *= np.cumprod(np.where(turns == 0.0, 1.0, turns))[:, None]
    return found


def span_colour(span: Span, index: int) -> str:
    """The colour of a span, which is the one of that index."""
    return body_colour(index) if span.kind == "beam" else "#444444"


def _listed(values) -> list[float]:
    return np.asarray(values, np.float64).tolist()


def _label(mechanism, name) -> str:
    if name == GROUND_NAME:
        return GROUND_NAME
    mass = float(np.asarray(mechanism.body(name).mass))
    return f"{name}: body, {mass:.4g} kg" if mass > 0.0 else f"{name}: body without mass"


def symbol_of(joint: AbstractJoint) -> tuple[str | None, Frame, Float[np.ndarray, "3 3"]]:
    """The symbol of a joint, where it is on its moving side, and its axes in that body, as columns."""
    moving = moving_frame(joint)
    axes = joint.frames()[1 if moving is joint.child else 0]
    return (
        next((symbol for kind, symbol in SYMBOLS.items() if isinstance(joint, kind)), "hinge"),
        moving,
        np.asarray(axes),
    )


def _symbol(joint: AbstractJoint, place) -> dict[str, Any]:
    kind, moving, axes = symbol_of(joint)
    return {
        "name": joint.name,
        "label": f"{joint.name}: {type(joint).__name__}",
        "kind": kind,
        "at": place(moving),
        "axes": [_listed(column) for column in axes.T],
        "ground": [place(frame) for frame in (joint.parent, joint.child) if frame.body == GROUND_NAME],
        "stands": is_hinge(joint),
        "slides": is_slide(joint),
    }


def parts_of(scenery: Scenery, name: str) -> list[dict[str, Any]]:
    """The solids of a body: of its inertia if it has a shape, else those that its marked points span."""
    if name == GROUND_NAME or name in {section for beam in scenery.mechanism.beams for section in beam.sections}:
        return []
    body = scenery.mechanism.body(name)
    assert isinstance(body, RigidBody)
    parts: list[dict[str, Any]] = []
    if is_shaped(body):
        axes, half = principal_box(body)
        centre, columns = _listed(body.center_of_mass), [_listed(column) for column in axes.T]
        parts.append({"kind": body.shape, "centre": centre, "axes": columns, "half": _listed(half)})
        return parts
    if is_concentrated(scenery.mechanism, body):
        parts.append({"kind": "ball", "centre": _listed(body.center_of_mass)})
    marks = scenery.outlines[name]
    if len(marks) < 2:
        on_slide = any(is_slide(joint) and moving_frame(joint).body == name for joint in scenery.mechanism.joints)
        seen = body.mass > 0.0 and not on_slide
        return parts or ([{"kind": "ball", "centre": _listed(mark)} for mark in marks] if seen else [])
    centre = marks.mean(axis=0)
    _, sizes, directions = np.linalg.svd(marks - centre)
    rank = int(np.sum(sizes > FLAT * sizes[0]))
    if rank == 1:
        along = (marks - centre) @ directions[0]
        ends = marks[np.argmin(along)], marks[np.argmax(along)]
        return [*parts, {"kind": "rod", "ends": [_listed(end) for end in ends]}]
    from scipy.spatial import ConvexHull  # takes its time to import

    hull = ConvexHull((marks - centre) @ directions[:rank].T)
    corners = marks[hull.vertices]
    return [*parts, {"kind": "plate" if rank == 2 else "hull", "corners": [_listed(corner) for corner in corners]}]
