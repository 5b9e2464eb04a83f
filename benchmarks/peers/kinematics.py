"""Where the bodies of a `Description` are, from coordinates of its tree, and how good a run is; NumPy only."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.peers.description import Description

LARGEST = 1e6  # of coordinates and speeds; a run beyond has diverged


class Motion(NamedTuple):
    """Bodies over n_t times, in world axes; the last one is ground.

    - `axes`: each body's as columns, (n_t, n + 1, 3, 3). `center`: of mass [m], (n_t, n + 1, 3).
    - `velocity`: of the centre of mass [m/s]; `spin`: angular velocity [rad/s].
    """

    axes: np.ndarray
    center: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray


def move(description: Description, coordinates, speeds) -> Motion:
    """The motion of all bodies, from coordinates and speeds of the tree, (n_t, n) each."""
    count, width = len(coordinates), len(description.bodies) + 1
    axes = np.tile(np.eye(3), (count, width, 1, 1))
    center, velocity, spin = np.zeros((3, count, width, 3))
    starts = description.centers
    for body, joint in enumerate(description.tree):
        parent = joint.parent
        axis = axes[:, parent] @ joint.axis
        displacement, rate = axis * coordinates[:, [body]], axis * speeds[:, [body]]
        inner = axes[:, parent] @ (joint.anchor - starts[parent])
        axes[:, body], spin[:, body] = axes[:, parent], spin[:, parent]
        velocity[:, body] = velocity[:, parent]
        if joint.kind == "revolute":
            axes[:, body] = Rotation.from_rotvec(displacement).as_matrix() @ axes[:, parent]
            spin[:, body] += rate
        else:
            inner = inner + displacement
            velocity[:, body] += rate
        outer = axes[:, body] @ (starts[body] - joint.anchor)
        center[:, body] = center[:, parent] + inner + outer
        velocity[:, body] += np.cross(spin[:, parent], inner) + np.cross(spin[:, body], outer)
    return Motion(axes, center, velocity, spin)


def coordinates_of(description: Description, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and speeds of the tree, (n_t, n) each, nearest to a motion of bodies whose joints drift apart."""
    coordinates, speeds = np.empty((2, len(motion.center), len(description.tree)))
    for index, joint in enumerate(description.tree):
        read = _turned if joint.kind == "revolute" else _slid
        coordinates[:, index], rate = read(description, motion, joint)
        speeds[:, index] = np.sum((motion.axes[:, joint.parent] @ joint.axis) * rate, axis=1)
    return coordinates, speeds


def _turned(_, motion, joint):
    """A hinge's angle, and the angular velocity of its child on its parent."""
    turned = motion.axes[:, joint.parent].swapaxes(1, 2) @ motion.axes[:, joint.child]
    angle = np.unwrap(Rotation.from_matrix(turned).as_rotvec() @ joint.axis)
    return angle, motion.spin[:, joint.child] - motion.spin[:, joint.parent]


def _slid(description, motion, joint):
    """A slide's distance, and the velocity of its child's anchor as seen from its parent."""
    ends = [path(description, motion, body, joint.anchor) for body in (joint.child, joint.parent)]
    velocities = [
        motion.velocity[:, body] + np.cross(motion.spin[:, body], end - motion.center[:, body])
        for body, end in zip((joint.child, joint.parent), ends, strict=True)
    ]
    apart = ends[0] - ends[1]
    distance = np.sum((motion.axes[:, joint.parent] @ joint.axis) * apart, axis=1)
    return distance, velocities[0] - velocities[1] - np.cross(motion.spin[:, joint.parent], apart)


def path(description: Description, motion: Motion, body: int, point) -> np.ndarray:
    """Positions (n_t, 3) [m] of a point on a body, which is given where it is at the start."""
    return motion.center[:, body] + motion.axes[:, body] @ (point - description.centers[body])


def loop_gap(description: Description, motion: Motion) -> np.ndarray:
    """Largest distance between the two anchors of a cut joint [m], (n_t,); zero without loops."""
    ends = [
        path(description, motion, joint.parent, joint.anchor) - path(description, motion, joint.child, joint.anchor)
        for joint in description.cuts
    ]
    return np.max(np.linalg.norm(np.array(ends), axis=-1), axis=0) if ends else np.zeros(len(motion.center))


def energy(description: Description, motion: Motion) -> np.ndarray:
    """Kinetic and potential energy [J], (n_t,)."""
    masses = np.array([body.mass for body in description.bodies])
    inertias = np.array([body.inertia for body in description.bodies])
    own_spin = np.einsum("tbji,tbj->tbi", motion.axes, motion.spin)[:, :-1]
    moving = np.einsum("b,tbi->t", masses, motion.velocity[:, :-1] ** 2) / 2.0
    turning = np.einsum("tbi,bij,tbj->t", own_spin, inertias, own_spin) / 2.0
    return moving + turning - np.einsum("b,tbi,i->t", masses, motion.center[:, :-1], description.gravity)


def judge(description: Description, times, coordinates, speeds, reference) -> dict[str, float]:
    """How good a run is.

    **Arguments:**

    - `times` [s], (n_t,); `coordinates`, `speeds`: of the tree there, (n_t, n), not finite after an early end.
    - `reference`: positions of the tracked point [m], (n_t, 3).

    **Returns:** over the times reached: `error`, largest distance of the tracked point from the reference [m]; `gap`,
    largest of the loops' [m]; `energy_drift`, largest change of energy [J]; `reached`, the last time [s].
    """
    sound = np.all(np.abs(np.hstack([coordinates, speeds])) < LARGEST, axis=1)  # false for what is not a number
    count = len(times) if np.all(sound) else int(np.argmin(sound))
    motion = move(description, coordinates[:count], speeds[:count])
    change = energy(description, motion)
    tracked = path(description, motion, *description.tracked)
    return {
        "error": float(np.max(np.linalg.norm(tracked - reference[:count], axis=-1))),
        "gap": float(np.max(loop_gap(description, motion))),
        "energy_drift": float(np.max(np.abs(change - change[0]))),
        "reached": float(times[count - 1]),
    }
