"""Newton's and Euler's equations of all bodies of a `Description`, in NumPy: slow, and independent of linkax.

Joints constrain accelerations, with Baumgarte's stabilisation, by a pseudo-inverse, which takes redundant rows. Not
through singular configurations, where accelerations alone do not say how to go on.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

from benchmarks.peers.description import Description
from benchmarks.peers.kinematics import Motion, move

REDUNDANT = 1e-6  # of the largest singular value; well above what loops drift apart, which makes such rows independent
DECAY = 5.0  # of what the joints have drifted apart [1/s]


def simulate(description: Description, times, rtol: float = 1e-13) -> Motion:
    """The motion at times [s], evenly or not, by DOP853 at a relative tolerance."""
    count = len(description.bodies)
    at_rest = np.zeros((1, count))
    start = move(description, at_rest, description.speeds[None])
    y0 = np.concatenate([part[0, :count].ravel() for part in start])

    def rates(_, y):
        axes, center, velocity, spin = _with_ground(y, count)
        acceleration, spin_rate = _accelerations(description, axes, center, velocity, spin)
        turning = np.cross(spin[:count, None], axes[:count].swapaxes(1, 2)).swapaxes(1, 2)
        return np.concatenate([part.ravel() for part in (turning, velocity[:count], acceleration, spin_rate)])

    found = solve_ivp(rates, (times[0], times[-1]), y0, method="DOP853", rtol=rtol, atol=rtol, t_eval=times)
    return Motion(*(np.array(part) for part in zip(*(_with_ground(y, count) for y in found.y.T), strict=True)))


def _with_ground(y, count):
    sizes = np.cumsum([9 * count, 3 * count, 3 * count])
    axes, *vectors = np.split(y, sizes)
    vectors = [np.vstack([part.reshape(count, 3), np.zeros(3)]) for part in vectors]
    return np.concatenate([axes.reshape(count, 3, 3), np.eye(3)[None]]), *vectors


def _accelerations(description, axes, center, velocity, spin):
    """Of centres of mass and angular, (n, 3) each: a = J⁺γ + N (NᵀMN)⁻¹ Nᵀ(f − M J⁺γ), where J N = 0."""
    count = len(description.bodies)
    mass, force = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
    for index, body in enumerate(description.bodies):
        linear, angular = _linear(index), _angular(index)
        inertia = axes[index] @ body.inertia @ axes[index].T
        mass[linear, linear], mass[angular, angular] = body.mass * np.eye(3), inertia
        force[linear] = body.mass * description.gravity
        force[angular] = -np.cross(spin[index], inertia @ spin[index])
    rows, right = _joint_rows(description, axes, center, velocity, spin)
    jacobian = rows[:, : 6 * count]
    inverse = np.linalg.pinv(jacobian, rcond=REDUNDANT)
    given = inverse @ right
    free = null_space(jacobian, rcond=REDUNDANT)
    found = given + free @ np.linalg.solve(free.T @ mass @ free, free.T @ (force - mass @ given))
    return tuple(found.reshape(count, 2, 3).swapaxes(0, 1))


def _joint_rows(description, *motion):
    """J (k, 6 n + 6), ground's columns last, and γ (k,) of all joints."""
    places = _Places(description, *motion)
    rows = [row for joint in (*description.tree, *description.cuts) for row in places.rows(joint)]
    jacobian = np.vstack([row.jacobian for row in rows])
    right = [-row.bias - 2.0 * DECAY * row.rate - DECAY**2 * row.value for row in rows]
    return jacobian, np.concatenate(right)


class _Row(NamedTuple):
    """What a joint keeps at zero, (k,): its rate, and its second derivative as J a + bias."""

    value: np.ndarray
    rate: np.ndarray
    jacobian: np.ndarray
    bias: np.ndarray


class _Places:
    """Points and directions on bodies at one instant, ground last."""

    def __init__(self, description, *motion):
        self.starts = description.centers
        self.axes, self.center, self.velocity, self.spin = motion

    def rows(self, joint):
        apart = self._apart(self._point, joint, joint.anchor)
        if joint.kind == "revolute":
            return [apart, self._apart(self._direction, joint, joint.axis)]
        turned = [self._apart(self._direction, joint, axis) for axis in np.eye(3)]
        normals = [self._direction(joint.parent, across) for across in null_space(joint.axis[None]).T]
        return [*turned, *(_along(normal, apart) for normal in normals)]

    def _apart(self, of, joint, start):
        """What the child's point or direction is away from the parent's."""
        ends = zip(of(joint.child, start), of(joint.parent, start), strict=True)
        return _Row(*(child - parent for child, parent in ends))

    def _point(self, body, start):
        """Of a body, given where it is at the start."""
        arm, spin = self.axes[body] @ (start - self.starts[body]), self.spin[body]
        rows = np.zeros((3, 6 * len(self.starts)))
        rows[:, _linear(body)], rows[:, _angular(body)] = np.eye(3), -_cross(arm)
        velocity = self.velocity[body] + np.cross(spin, arm)
        return _Row(self.center[body] + arm, velocity, rows, np.cross(spin, np.cross(spin, arm)))

    def _direction(self, body, start):
        """Of a body, given as it is at the start."""
        along, spin = self.axes[body] @ start, self.spin[body]
        rows = np.zeros((3, 6 * len(self.starts)))
        rows[:, _angular(body)] = -_cross(along)
        return _Row(along, np.cross(spin, along), rows, np.cross(spin, np.cross(spin, along)))


def _along(normal, apart):
    """The row n·s, where n turns."""
    return _Row(
        np.array([normal.value @ apart.value]),
        np.array([normal.value @ apart.rate + normal.rate @ apart.value]),
        normal.value @ apart.jacobian + apart.value @ normal.jacobian,
        np.array([normal.value @ apart.bias + apart.value @ normal.bias + 2.0 * normal.rate @ apart.rate]),
    )


def _linear(body):
    """Columns of a body's acceleration; ground's, -1, are the last, as it stands in `Motion`."""
    return slice(6 * body, 6 * body + 3)


def _angular(body):
    return slice(6 * body + 3, 6 * body + 6 or None)


def _cross(vector):
    """[v]×, with [v]× w = v × w."""
    return np.cross(vector, np.eye(3)).T
