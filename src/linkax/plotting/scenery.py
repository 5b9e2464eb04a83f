"""Place what an animation draws: bodies, joints, ropes and points, in the plane of the picture."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from linkax.model.bodies import GROUND_NAME, Frame, RigidBody
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.joint import AbstractJoint
from linkax.model.mechanism import Mechanism
from linkax.model.ropes import ElasticRope, Rope
from linkax.simulation.read.by_name import BodyPoint
from linkax.simulation.read.solution import Solution

NEGLIGIBLE = 1e-9  # length in the picture up to which a direction is seen from its end
Points = Mapping[str, tuple[str, BodyPoint]]  # {name of a point: its body, and where on it}


class Scenery(NamedTuple):
    """Positions of all that is drawn, in n_f frames.

    - `poses`: {body or ground: origin, (n_f, 3) [m], and axes as columns, (n_f, 3, 3), of its reference frame}.
    - `outlines`: {body or ground: marked points in its reference frame, (n, 3) [m]}.
    - `points`: {name: positions of a point to trace, (n_f, 3) [m]}.
    - `plane`: the two ground axes that span the picture.
    """

    mechanism: Mechanism
    poses: dict[str, tuple[np.ndarray, np.ndarray]]
    outlines: dict[str, np.ndarray]
    points: dict[str, np.ndarray]
    plane: tuple[int, int]

    def seen(self, body: str, offset: ArrayLike | Sequence[float]) -> Float[np.ndarray, "n_f 2"]:
        """Position in the picture of a point at an offset in a body's reference frame [m]."""
        return _placed(self.poses[body], offset)[:, self.plane]

    @property
    def box(self) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest corner of all that is drawn in any frame [m]."""
        everything = _everything(self.poses, self.outlines, self.points)[:, self.plane]
        return np.stack([everything.min(axis=0), everything.max(axis=0)])

    @property
    def unit(self) -> float:
        """Size of a symbol [m]."""
        low, high = self.box
        return 0.025 * (max(high - low) or 1.0)


def scenery_of(moments: Solution, points: Points) -> Scenery:
    """Place a solution at the times of the frames, in the plane in which it moves most."""
    mechanism, count = moments.mechanism, len(moments.ts)
    poses = {name: (np.asarray(origin), np.asarray(axes)) for name, (origin, axes) in moments.poses().items()}
    poses[GROUND_NAME] = np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3))
    outlines = {name: _outline(mechanism, name) for name in poses}
    traced = {name: np.asarray(moments.position(body, at)) for name, (body, at) in points.items()}
    spread = np.ptp(_everything(poses, outlines, traced), axis=0)
    first, second = sorted(np.argsort(-spread, kind="stable")[:2].tolist())
    return Scenery(mechanism, poses, outlines, traced, (first, second))


def _placed(pose, offset):
    origin, axes = pose
    return origin + axes @ np.asarray(offset)


def _everything(poses, outlines, points):
    placed = [_placed(poses[name], point) for name, outline in outlines.items() for point in outline]
    return np.concatenate([*placed, *points.values()])


def _outline(mechanism, body) -> np.ndarray:
    """Points of a body in its reference frame: of its joints, ropes and named frames, and of a concentrated mass."""
    frames = [frame for joint in mechanism.joints for frame in (joint.parent, joint.child)]
    frames += [point for rope in ropes(mechanism) for point in rope.points]
    marks = [np.asarray(frame.offset) for frame in frames if frame.body == body]
    if body != GROUND_NAME:
        marks += map(np.asarray, mechanism.body(body).frames.values())
        if is_concentrated(mechanism, mechanism.body(body)):
            marks.append(np.asarray(mechanism.body(body).center_of_mass))
    return np.unique(np.array(marks), axis=0)


def ropes(mechanism: Mechanism) -> list[Rope | ElasticRope]:
    """All ropes of a mechanism, and its struts between two points."""
    return [
        element for element in (*mechanism.constraints, *mechanism.forces) if isinstance(element, Rope | ElasticRope)
    ]


def is_slide(joint: AbstractJoint) -> bool:
    """Whether a joint is drawn as a box on a guide."""
    return joint.speed_units.count("m") == 1 and not isinstance(joint, OnBeam)


def is_hinge(joint: AbstractJoint) -> bool:
    """Whether a joint is drawn as a pivot."""
    return "rad" in joint.speed_units and not is_slide(joint) and not isinstance(joint, OnBeam)


def slide_way(
    scenery: Scenery, joint: AbstractJoint
) -> tuple[Float[np.ndarray, "n_f 2"], Float[np.ndarray, "n_f 2"] | None]:
    """Path in the picture of a slide's moving frame, and its direction; None where that is seen from its end."""
    parent, moving = joint.parent, moving_frame(joint)
    axis = joint.frames()[0][:, 0]
    direction = scenery.seen(parent.body, np.asarray(parent.offset) + axis) - scenery.seen(parent.body, parent.offset)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return scenery.seen(moving.body, moving.offset), direction / length if np.all(length > NEGLIGIBLE) else None


def moving_frame(joint: AbstractJoint) -> Frame:
    """The frame of a joint that is not on ground; the child's where both are not."""
    return joint.child if joint.child.body != GROUND_NAME else joint.parent


def is_concentrated(mechanism: Mechanism, body: RigidBody) -> bool:
    """Whether a body is drawn as a disc: a mass without inertia that is on no slide."""
    on_slide = any(is_slide(joint) for joint in mechanism.joints if body.name in (joint.parent.body, joint.child.body))
    return bool(np.all(np.asarray(body.inertia) == 0.0) and body.mass > 0.0 and not on_slide)
