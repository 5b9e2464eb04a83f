"""Forces on points of bodies, and between two points."""

import abc
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import GROUND_NAME, BodyOrFrame, Frame, frame_of
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.force import AbstractForce, Load, described, named
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, Vector, number, one_of, zero_or_more
from linkax.spatial.vectors import dot, length
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio

Axes = Literal["ground", "frame"]


class BetweenPoints(AbstractForce):
    """A force along the line between the origins of two frames."""

    name: str | None = eqx.field(static=True)
    first: Frame
    second: Frame

    @property
    def frames(self) -> tuple[Frame, ...]:
        return (self.first, self.second)

    def extent(self, configuration: Configuration) -> Scalar:
        return length(configuration.between(self.first, self.second))

    @abc.abstractmethod
    def strength(self, t: Number, motion: Motion, *args: Any) -> Scalar:
        """Compute the pull [N], negative where it pushes."""

    def pull(self, t: Number, motion: Motion, *args: Any) -> Float[Array, "3"]:
        """Compute the force on the first point [N]; its opposite acts on the second."""
        return self.strength(t, motion, *args) * _unit(motion.configuration.between(self.first, self.second))

    def distance_rate(self, motion: Motion) -> Scalar:
        """Compute the rate of the distance [m/s]."""
        velocity = motion.point_velocity(self.second) - motion.point_velocity(self.first)
        return dot(velocity, _unit(motion.configuration.between(self.first, self.second)))

    def load(self, t: Number, motion: Motion, *args: Any) -> Load:
        force = self.pull(t, motion, *args)
        return motion.point_load(self.first, force).plus(motion.point_load(self.second, -force))


def _unit(vector: Float[Array, "3"]) -> Float[jax.Array, "3"]:
    """Divide a vector by its length; zero stays zero."""
    return ratio(vector, length(vector), 0.0)


class Spring(BetweenPoints):
    """A linear spring between two points, with the pull stiffness × (distance − free_length).

    Where the points meet there is no direction, and it does not push.

    **Arguments:** `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`;
    `stiffness` [N/m]; `free_length` [m], at which it has no force, zero or more; left out, it is zero, and the spring
    pulls at any distance; `name`, see `linkax.AbstractForce`.
    """

    stiffness: Scalar
    free_length: Scalar

    def __init__(
        self,
        first: BodyOrFrame,
        second: BodyOrFrame,
        stiffness: Number,
        free_length: Number = 0.0,
        *,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "Spring")
        self.first, self.second = two_points("Spring", first, second)
        self.stiffness = number(stiffness, (), f"{self.display_name}: stiffness [N/m]")
        self.free_length = zero_or_more(free_length, f"{self.display_name}: free_length [m]")

    @property
    def conserves_energy(self) -> bool:
        return True

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return self.stiffness * (self.extent(motion.configuration) - self.free_length)

    def pull(self, t: Number, motion: Motion) -> Float[Array, "3"]:
        along = motion.configuration.between(self.first, self.second)
        return self.stiffness * (along - self.free_length * _unit(along))

    def potential_energy(self, configuration: Configuration) -> Scalar:
        along = configuration.between(self.first, self.second)
        stretch = dot(along, _unit(along)) - self.free_length
        return self.stiffness * stretch**2 / 2.0


class Damper(BetweenPoints):
    """Viscous damping between two points, with the pull damping × rate of their distance.

    **Arguments:** `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`; `damping` [N s/m];
    `name`, see `linkax.AbstractForce`.
    """

    damping: Scalar

    def __init__(self, first: BodyOrFrame, second: BodyOrFrame, damping: Number, *, name: str | None = None) -> None:
        self.name = optional_name(name, "Damper")
        self.first, self.second = two_points("Damper", first, second)
        self.damping = number(damping, (), f"{self.display_name}: damping [N s/m]")

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return self.damping * self.distance_rate(motion)


class _OnPoint(AbstractForce):
    """A vector on a point of a body, in ground axes or in those of the frame at the point."""

    name: str | None = eqx.field(static=True)
    point: Frame
    axes: Axes = eqx.field(static=True)

    def __init__(self, point: BodyOrFrame, axes: Axes, name: str | None) -> None:
        self.name = optional_name(name, type(self).__name__)
        self.point = frame_of(point, f"{type(self).__name__}: point")
        if self.point.body == GROUND_NAME:
            raise ValueError(
                f"{self.display_name}: point is {point!r}, which nothing moves; give a point of another body"
            )
        self.axes = one_of(axes, ("ground", "frame"), f"{self.display_name}: axes")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return (self.point,)

    def _in_ground_axes(self, entry: Array | Law, t: Number, motion: Motion) -> Float[Array, "3"]:
        vector = evaluated(entry, t, motion)
        return motion.orientation(self.point) @ vector if self.axes == "frame" else vector


class PointForce(_OnPoint):
    """A force on a point of a body.

    **Arguments:**

    - `point`: a body (its reference frame), or `body.at(...)`.
    - `force`: three numbers [N], or a function (t, motion) ↦ three numbers; see `JointTorque`.
    - `axes`: "ground" (default), or "frame": those of the frame at the point, which turn with the body.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a point on the ground.
    """

    force: Float[Array, "3"] | Law

    def __init__(
        self,
        point: BodyOrFrame,
        force: Vector | Callable[[Any, Any], Vector],
        axes: Axes = "ground",
        *,
        name: str | None = None,
    ) -> None:
        super().__init__(point, axes, name)
        self.force = number_or_law(force, (3,), f"{self.display_name}: force [N]")

    def strength(self, t: Number, motion: Motion) -> Float[Array, "3"]:
        return self._in_ground_axes(self.force, t, motion)

    def load(self, t: Number, motion: Motion) -> Load:
        return motion.point_load(self.point, self.strength(t, motion))


class PointMoment(_OnPoint):
    """A moment on a body, or on the section of a beam at a point.

    **Arguments:** those of `PointForce`, with `moment`: three numbers [N m], or a function, in place of `force`.
    """

    moment: Float[Array, "3"] | Law

    def __init__(
        self,
        point: BodyOrFrame,
        moment: Vector | Callable[[Any, Any], Vector],
        axes: Axes = "ground",
        *,
        name: str | None = None,
    ) -> None:
        super().__init__(point, axes, name)
        self.moment = number_or_law(moment, (3,), f"{self.display_name}: moment [N m]")

    def strength(self, t: Number, motion: Motion) -> Float[Array, "3"]:
        return self._in_ground_axes(self.moment, t, motion)

    def load(self, t: Number, motion: Motion) -> Load:
        nothing = jnp.zeros(3, motion.system.dtype)
        return motion.point_load(self.point, nothing, self.strength(t, motion))


def two_points(kind: str, first: BodyOrFrame, second: BodyOrFrame) -> tuple[Frame, Frame]:
    """Check the points of a force between two bodies."""
    ends = frame_of(first, f"{kind}: first point"), frame_of(second, f"{kind}: second point")
    if ends[0].body == ends[1].body:
        raise ValueError(f"{described(kind, named(ends[:1]))}: both points are on it; give points on two bodies")
    return ends
