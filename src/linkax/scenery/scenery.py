"""Place what pictures and views show of a mechanism: bodies, joints, springs, ropes and points."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import ArrayLike, Float
from scipy.interpolate import CubicSpline

from linkax.equations.coordinates import rates
from linkax.model.bodies import GROUND_NAME, Frame, RigidBody
from linkax.model.constraints.ropes import ElasticRope, Rope
from linkax.model.forces.point_forces import BetweenPoints, Spring
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.distance import Distance
from linkax.model.joints.joint import AbstractJoint
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import require_type
from linkax.scenery.camera import Camera, camera_for
from linkax.simulation.read.by_name import BodyPoint
from linkax.simulation.read.kinematics import Kinematics

Moving = TypeVar("Moving", bound=Kinematics)
Points = Mapping[str, tuple[str, BodyPoint]]  # {name of a point: its body, and where on it}
CURVE_POINTS = 4  # of the path of a point, for each saved time


class Span(NamedTuple):
    """What is drawn along points of bodies, from each to the next.

    - `kind`: "rope", "rod" (massless: a `Distance`, or a `Rope` between two points), "spring", "damper" or "beam".
    - `label`: what it is, for people.
    """

    kind: Literal["rope", "rod", "spring", "damper", "beam"]
    label: str
    points: tuple[Frame, ...]


class Scenery(NamedTuple):
    """Positions of all that is drawn, at n_f times.

    - `times`: [s], (n_f,).
    - `poses`: {body or ground: origin, (n_f, 3) [m], and axes as columns, (n_f, 3, 3), of its reference frame}.
    - `outlines`: {body or ground: marked points in its reference frame, (n, 3) [m]}.
    - `points`: {name: positions of a point to trace, (n_f, 3) [m]}.
    - `curves`: {name: the path of that point, smooth through its positions at saved times, (n, 3) [m]}.
    """

    mechanism: Mechanism
    times: np.ndarray
    poses: dict[str, tuple[np.ndarray, np.ndarray]]
    outlines: dict[str, np.ndarray]
    points: dict[str, np.ndarray]
    curves: dict[str, np.ndarray]
    camera: Camera

    def placed(self, frame: Frame) -> Float[np.ndarray, "n_f 3"]:
        """Positions of a frame's origin [m]."""
        return _placed(self.poses[frame.body], frame.offset)

    def seen(self, body: str, offset: ArrayLike | Sequence[float]) -> Float[np.ndarray, "n_f 2"]:
        """Positions in the picture of a point at an offset in a body's reference frame [m]."""
        return self.camera.seen(_placed(self.poses[body], offset))

    def depth(self, body: str) -> float:
        """How near to the eye a body is at first [m]; larger is nearer."""
        return float(np.mean([_placed(self.poses[body], mark)[0] for mark in self.outlines[body]] @ self.camera.toward))

    @property
    def box(self) -> Float[np.ndarray, "2 2"]:
        """Lowest and highest corner in the picture of all that is drawn at any time [m]."""
        return _box(self.camera.seen(_everything(self.poses, self.outlines, self.points)))

    @property
    def space(self) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of all that is drawn at any time [m]."""
        return _box(_everything(self.poses, self.outlines, self.points))


def scenery_of(solution: Kinematics, points: Points, times: Float[np.ndarray, " n_f"] | None = None) -> Scenery:
    """Place a solution at its saved times, or at other times between them.

    **Arguments:** `points`: to trace.

    **Raises:** `ValueError` for the solution of a batch, one that holds no state, and points of another form.
    """
    saved, points = reached(solution), _checked_points(points)
    shown = saved if times is None else _between(saved, times)
    mechanism, moments = saved.mechanism, np.asarray(shown.ts)
    poses = {name: (np.asarray(origin), np.asarray(axes)) for name, (origin, axes) in shown.poses().items()}
    poses[GROUND_NAME] = np.zeros((len(moments), 3)), np.broadcast_to(np.eye(3), (len(moments), 3, 3))
    outlines = {name: _outline(mechanism, name) for name in poses}
    ways = {name: _way(saved, body, at) for name, (body, at) in points.items()}
    traced = {name: way(moments) for name, way in ways.items()}
    fine = np.linspace(moments[0], moments[-1], CURVE_POINTS * len(saved.ts))
    curves = {name: way(fine) for name, way in ways.items()}
    camera = camera_for(mechanism, _everything(poses, outlines, traced))
    return Scenery(mechanism, moments, poses, outlines, traced, curves, camera)


def _checked_points(points: Any) -> Points:
    """Check that points are {name: (body, at)}."""
    form = "give {name: (body, at)}, such as {'P': ('coupler', 'tip')} or {'P': ('coupler', [0.4, 0.2, 0.0])}"
    for name, entry in require_type(points, Mapping, "points", form).items():
        if not (isinstance(entry, tuple | list) and len(entry) == 2 and isinstance(entry[0], str)):
            raise ValueError(f"points: {name!r} is {entry!r}; {form}")
    return points


def reached(solution: Moving) -> Moving:
    """The solution at the saved times that it reached.

    **Raises:** `ValueError` for the solution of a batch, and one that holds no state.
    """
    if solution.q is None:
        raise ValueError("the solution saved functions of its own; draw one that saved its states")
    if np.ndim(solution.ts) != 1:
        member = "take jax.tree.map(lambda x: x[0], solution)"
        shape = np.shape(solution.ts)[:-1]
        raise ValueError(f"the solution is a batch of shape {shape}; draw one of its members: {member}")
    times = np.asarray(solution.ts)
    there = np.isfinite(times)
    if np.all(there) and np.all(np.diff(times) > 0.0):
        return solution  # which keeps what was read of it
    if not np.any(there):
        raise ValueError("the solution has no time that was reached; there is nothing to draw")
    arrays = {name: getattr(solution, name) for name in solution.by_time}
    kept = {name: np.asarray(array)[there] for name, array in arrays.items() if array is not None}
    if not np.all(np.diff(kept["ts"]) > 0.0):
        kept["ts"] = np.arange(float(len(kept["ts"])))  # a trace may go back
    return dataclasses.replace(solution, **kept)


def _between(saved: Moving, moments) -> Moving:
    """The solution at other times, by Hermite interpolation of the joints' coordinates; without internal states."""
    times, q, v = (np.asarray(values) for values in (saved.ts, saved.q, saved.v))
    left = np.clip(np.searchsorted(times, moments, side="right") - 1, 0, len(times) - 2)
    width = (times[left + 1] - times[left])[:, None]
    s = (moments - times[left])[:, None] / width
    ends = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * q[left] + (3.0 - 2.0 * s) * s**2 * q[left + 1]
    rate = np.asarray(jax.vmap(partial(rates, saved.mechanism.topology))(q, v))
    slopes = s * (1.0 - s) * width * ((1.0 - s) * rate[left] - s * rate[left + 1])
    return dataclasses.replace(saved, ts=moments, q=ends + slopes, v=v[left], internal=None)


def _way(saved, body, at):
    """The position of a point as a function of time, smooth through the saved times."""
    positions = np.asarray(saved.position(body, at))
    if len(saved.ts) < 2:
        return lambda times: np.broadcast_to(positions[0], (len(times), 3))
    return CubicSpline(saved.ts, positions)


def _placed(pose, offset):
    origin, axes = pose
    return origin + axes @ np.asarray(offset)


def _everything(poses, outlines, points) -> Float[np.ndarray, "n n_f 3"]:
    placed = [_placed(poses[name], point) for name, outline in outlines.items() for point in outline]
    return np.stack([*placed, *points.values()])


def _box(positions):
    flat = positions.reshape(-1, positions.shape[-1])
    return np.stack([flat.min(axis=0), flat.max(axis=0)])


def _outline(mechanism, body) -> np.ndarray:
    """Points of a body in its reference frame: of its joints, ropes, springs and named frames, and of its shape."""
    frames = [frame for joint in mechanism.joints for frame in (joint.parent, joint.child)]
    frames += [point for span in spans(mechanism) for point in span.points]
    marks = [np.asarray(frame.offset) for frame in frames if frame.body == body]
    if body != GROUND_NAME:
        found = mechanism.body(body)
        marks += map(np.asarray, found.frames.values())
        if is_concentrated(mechanism, found):
            marks.append(np.asarray(found.center_of_mass))
        if is_shaped(found):
            axes, half = principal_box(found)
            corners = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3) * half
            marks += list(np.asarray(found.center_of_mass) + corners @ axes.T)
    return np.unique(np.array(marks).reshape(-1, 3), axis=0)


def principal_box(body: RigidBody) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Principal axes of a body as columns, and half the extent along each of the shape that has its inertia [m]."""
    moments, axes = np.linalg.eigh(np.asarray(body.inertia) / np.asarray(body.mass))
    squares = np.sum(moments) / 2.0 - moments  # mean squares of the distances along each axis
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return axes, np.sqrt(np.maximum(squares, 0.0) * (3.0 if body.shape == "box" else 5.0))


def spans(mechanism: Mechanism) -> list[Span]:
    """All ropes, massless rods, springs, dampers and beams of a mechanism; cylinders are drawn as dampers."""
    found: list[Span] = []
    for joint in mechanism.joints:
        if isinstance(joint, Distance):
            found.append(Span("rod", f"{joint.name}: Distance", (joint.parent, joint.child)))
    for rope in mechanism.constraints:
        if isinstance(rope, Rope):
            found.append(Span("rod" if len(rope.points) == 2 else "rope", f"{rope.name}: Rope", rope.points))
    for name, force in zip(mechanism.force_names, mechanism.forces, strict=True):
        label = f"{name}: {type(force).__name__}" if getattr(force, "name", None) else name
        if isinstance(force, BetweenPoints):
            found.append(Span("spring" if isinstance(force, Spring) else "damper", label, (force.first, force.second)))
        if isinstance(force, ElasticRope):
            found.append(Span("rope", label, force.points))
    for beam in mechanism.beams:
        sections = (mechanism.body(section) for section in beam.sections)
        found.append(Span("beam", f"{beam.name}: Beam", tuple(section.reference for section in sections)))
    return found


def is_slide(joint: AbstractJoint) -> bool:
    """Whether a joint is drawn as a box on a guide."""
    return joint.speed_units.count("m") == 1 and not isinstance(joint, OnBeam)


def is_hinge(joint: AbstractJoint) -> bool:
    """Whether a joint is drawn as a pivot."""
    return "rad" in joint.speed_units and "m" not in joint.speed_units and not isinstance(joint, OnBeam)


def moving_frame(joint: AbstractJoint) -> Frame:
    """The frame of a joint that is not on ground; the child's where both are not."""
    return joint.child if joint.child.body != GROUND_NAME else joint.parent


def is_shaped(body: RigidBody) -> bool:
    """Whether a body is drawn as the box or ellipsoid that has its inertia."""
    return isinstance(body.shape, str) and bool(body.mass > 0.0)


def is_concentrated(mechanism: Mechanism, body: RigidBody) -> bool:
    """Whether a body is drawn as a disc or ball: a mass without inertia that is on no slide."""
    on_slide = any(is_slide(joint) for joint in mechanism.joints if body.name in (joint.parent.body, joint.child.body))
    return bool(np.all(np.asarray(body.inertia) == 0.0) and body.mass > 0.0 and not on_slide)
