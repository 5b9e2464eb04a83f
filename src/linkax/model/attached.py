"""Where bodies are, as elements read it: points, orientations and coordinates by name."""

import abc
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import GROUND_NAME, BodyOrFrame, Frame, frame_of
from linkax.model.names import ByName
from linkax.model.numbers import value
from linkax.model.terms import Term
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array


class BodyPose(NamedTuple):
    """The pose of a body in ground axes.

    - `rotation`: its axes as columns, (3, 3).
    - `position`: of its reference point from the anchor of its tree [m], (3,).
    - `anchor`: of that tree in the world [m], (3,), apart, so that a mechanism far from the origin loses no digits.
    """

    rotation: Float[Array, "3 3"]
    position: Float[Array, "3"]
    anchor: Float[Array, "3"]


class AbstractPoses(eqx.Module):
    """Poses of bodies, and coordinates of joints."""

    @abc.abstractmethod
    def pose(self, body: str) -> BodyPose:
        """Find the pose of a body."""

    @abc.abstractmethod
    def joint_coordinates(self, name: str) -> Float[Array, " n"]:
        """Find the coordinates of a joint [rad or m]."""

    def joint(self, name: str) -> Float[Array, ""] | Float[Array, " n"]:
        """Coordinate of a joint [rad or m]; (n,) where it has several."""
        return alone(self.joint_coordinates(name))

    def point_position(self, point: BodyOrFrame) -> Float[Array, "3"]:
        """Position of a point in ground axes [m]: the origin of `body.at(...)`, or of a body's reference frame."""
        place, anchor = self._place(frame_of(point, "point"))
        return place + anchor

    def between(self, first: BodyOrFrame, second: BodyOrFrame) -> Float[Array, "3"]:
        """Vector from one point to another in ground axes [m]; exact to more digits than the difference of both."""
        (near, near_anchor), (far, far_anchor) = (self._place(frame_of(end, "point")) for end in (first, second))
        return (far - near) + (far_anchor - near_anchor)

    def orientation(self, body: BodyOrFrame | str) -> Float[Array, "3 3"]:
        """Axes of a body's reference frame, or of a frame `body.at(...)`, as columns in ground axes.

        `body`: also the name of one. R = orientation takes a vector from the body's axes to ground axes by R @ vector.
        """
        if isinstance(body, str):
            return self.pose(body).rotation
        frame = frame_of(body, "body")
        rotation = self.pose(frame.body).rotation
        return rotation @ jnp.asarray(value(frame.rotation), rotation.dtype)

    def _place(self, frame: Frame) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Origin of a frame from the anchor of its tree, and that anchor."""
        rotation, position, anchor = self.pose(frame.body)
        offset = jnp.asarray(frame.offset, position.dtype)
        return (position, offset) if frame.body == GROUND_NAME else (position + rotation @ offset, anchor)


class Attached(AbstractPoses):
    """What a constraint reads: poses of the bodies that it attaches to, and coordinates of its joints, by name.

    `point_position`, `between` and `orientation` read it at a body or `body.at(...)`, in ground axes, `joint` by a
    joint's name.

    - `quaternions`: the joints whose coordinates begin with one.
    """

    poses: ByName[BodyPose]
    coordinates: ByName[Float[Array, "..."]]
    quaternions: tuple[str, ...] = eqx.field(static=True)

    def pose(self, body: str) -> BodyPose:
        return self.poses[body]

    def joint_coordinates(self, name: str) -> Float[Array, " n"]:
        return self.coordinates[name]

    def coordinate(self, term: Term) -> Float[Array, ""]:
        """Coordinate of one speed of a joint [rad or m]."""
        return self.coordinates[term.joint][(term.index or 0) + (term.joint in self.quaternions)]

    def moving(self, twists: Mapping[str, "Twist"], speeds: Mapping[str, Array]) -> "Moving":
        """The same with twists of the bodies, and speeds of the joints."""
        named = ByName(twists, self.poses.what), ByName(speeds, self.coordinates.what)
        return Moving(self.poses, self.coordinates, self.quaternions, *named)

    def still(self) -> "Moving":
        """The same at rest."""
        zeros = {name: jnp.zeros_like(pose.position) for name, pose in self.poses.items()}
        speeds = {name: entries[int(name in self.quaternions) :] for name, entries in self.coordinates.items()}
        twists = {name: Twist(none, none) for name, none in zeros.items()}
        return self.moving(twists, {name: jnp.zeros_like(entries) for name, entries in speeds.items()})


class Twist(NamedTuple):
    """The motion of a body in ground axes: angular velocity [rad/s], and velocity of its reference point [m/s]."""

    angular: Float[Array, "3"]
    linear: Float[Array, "3"]


class Moving(Attached):
    """What the speeds of a constraint are read from: twists of the bodies, and speeds of joints, besides their places.

    `point_velocity` and `angular_velocity` read it at a body or `body.at(...)`, in ground axes, `joint_speed` by a
    joint's name.
    """

    twists: ByName[Twist]
    speeds: ByName[Float[Array, "..."]]

    def angular_velocity(self, body: BodyOrFrame) -> Float[Array, "3"]:
        """Angular velocity of a body in ground axes [rad/s]."""
        return self.twists[frame_of(body, "body").body].angular

    def point_velocity(self, point: BodyOrFrame) -> Float[Array, "3"]:
        """Velocity of a point of a body in ground axes [m/s]."""
        frame = frame_of(point, "point")
        rotation, twist = self.pose(frame.body).rotation, self.twists[frame.body]
        return twist.linear + cross(twist.angular, rotation @ jnp.asarray(frame.offset, rotation.dtype))

    def velocity_at(self, body: BodyOrFrame, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """Velocity of what is at a place on a body, given from the frame's origin in ground axes [m/s]."""
        return self.point_velocity(body) + cross(self.angular_velocity(body), place)

    def joint_speed(self, name: str) -> Float[Array, ""] | Float[Array, " n"]:
        """Speed of a joint [rad/s or m/s]; (n,) where it has several."""
        return alone(self.speeds[name])


def alone(values: Any) -> Any:
    """Take the only entry out of an array along its first axis; keep several."""
    return values[0] if len(values) == 1 else values
