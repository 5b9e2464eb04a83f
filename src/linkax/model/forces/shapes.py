"""Shapes of bodies that touch, where two of them are nearest, and how far apart they are there."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.elements import Configuration
from linkax.model.numbers import Number, positive, require_type, zero_or_more
from linkax.spatial.vectors import dot, length
from linkax.xla.arrays import Scalar
from linkax.xla.derivatives import ratio

DEEPEST = 0.9  # of the sum of both radii: just before middles pass each other, where the normal turns round
PARALLEL = 1e-12  # sine squared between two segments, below which their middles count as nearest


class Sphere(eqx.Module):
    """A sphere, or a disc that moves in the plane of its contacts.

    **Arguments:** `center`: a body (its reference frame), or `body.at(...)`; `radius` [m], zero for a point.
    """

    frame: Frame
    radius: Scalar

    def __init__(self, center: BodyOrFrame, radius: Number) -> None:
        self.frame = frame_of(center, "Sphere: center")
        self.radius = zero_or_more(radius, "Sphere: radius [m]")

    @property
    def corners(self) -> tuple[Frame, ...]:
        """Frames whose spheres are its hull."""
        return (self.frame,)


class Capsule(eqx.Module):
    """All within a radius of a segment between two points of a body.

    **Arguments:** `start`, `end`: two points of one body, such as `rod.at("base")` and `rod.at("tip")`; `radius` [m].

    **Raises:** `ValueError` for points of two bodies.
    """

    frame: Frame
    end: Frame
    radius: Scalar

    def __init__(self, start: BodyOrFrame, end: BodyOrFrame, radius: Number) -> None:
        self.frame, self.end = frame_of(start, "Capsule: start"), frame_of(end, "Capsule: end")
        if self.frame.body != self.end.body:
            raise ValueError(
                f"Capsule: start is on body {self.frame.body!r}, end on {self.end.body!r}; give points of one body"
            )
        self.radius = zero_or_more(radius, "Capsule: radius [m]")

    @property
    def corners(self) -> tuple[Frame, ...]:
        """Frames whose spheres are its hull."""
        return self.frame, self.end


class Plane(eqx.Module):
    """The x-y plane of a frame; what is on the side that z points to is free.

    **Arguments:** `frame`: a body, or `body.at(offset, rotation)`; for the floor of a mechanism in the x-y plane
    `lx.GROUND.at([0, 0, 0], rotation)` with y as the third column of `rotation`.
    """

    frame: Frame

    def __init__(self, frame: BodyOrFrame) -> None:
        self.frame = frame_of(frame, "Plane: frame")


Shape = Sphere | Capsule | Plane


class Spot(NamedTuple):
    """Where two shapes are nearest.

    - `gap`: between their surfaces [m], negative where they penetrate.
    - `normal`: away from the second, in ground axes, (3,).
    - `arms`: from the origins of both shapes' frames to the middle of the gap, in ground axes [m], (3,) each.
    """

    gap: Float[jax.Array, ""]
    normal: Float[jax.Array, "3"]
    arms: tuple[Float[jax.Array, "3"], Float[jax.Array, "3"]]


def smallest_gap(spots: Sequence[Spot]) -> Scalar:
    """The smallest gap of some places [m]."""
    return jnp.min(jnp.stack([spot.gap for spot in spots]))


class ShapePair(eqx.Module):
    """Two shapes on two bodies, a plane second."""

    first: Sphere | Capsule
    second: Shape

    def __init__(self, first: Any, second: Any, what: str) -> None:
        for shape in (first, second):
            remedy = "give a linkax.Sphere, Capsule or Plane"
            require_type(shape, (Sphere, Capsule, Plane), f"{what}: a shape", remedy)
        if isinstance(first, Plane):
            first, second = second, first
        if isinstance(first, Plane):
            raise ValueError(f"{what}: both shapes are planes; give a Sphere or a Capsule for one")
        if first.frame.body == second.frame.body:
            raise ValueError(f"{what}: both shapes are on body {first.frame.body!r}; give shapes of two bodies")
        if not isinstance(second, Plane):
            positive(first.radius + second.radius, f"{what}: the sum of both radii [m]", "give one of them, or both")
        self.first, self.second = first, second

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames that the shapes attach to."""
        return (*self.first.corners, *getattr(self.second, "corners", (self.second.frame,)))

    def spots(self, configuration: Configuration) -> list[Spot]:
        """Find where they are nearest: at both ends of a capsule on a plane, else at one place."""
        if isinstance(self.second, Plane):
            return [_on_plane(configuration, self.first, corner, self.second) for corner in self.first.corners]
        return [_between(configuration, self.first, self.second)]

    def gap(self, configuration: Configuration) -> Scalar:
        """Compute the smallest gap [m]."""
        return smallest_gap(self.spots(configuration))

    @property
    def deepest(self) -> Scalar | None:
        """How deep they penetrate just before they are through each other [m]; None in a plane."""
        return None if isinstance(self.second, Plane) else DEEPEST * (self.first.radius + self.second.radius)

    def unit(self, configuration: Configuration) -> Scalar:
        """The mechanism's length [m]."""
        return configuration.system.length


def _on_plane(configuration, first, corner, plane):
    normal = configuration.orientation(plane.frame)[:, 2]
    above = configuration.between(plane.frame, corner)
    height = dot(normal, above)
    gap = height - first.radius
    down = -normal * (height - gap / 2.0)
    return Spot(gap, normal, (_along(configuration, first, corner) + down, above + down))


def _along(configuration, shape, corner):
    """From the origin of a shape's frame to one of its corners."""
    return configuration.between(shape.frame, corner)


def _between(configuration, first, second):
    """The nearest points of two segments, of length zero for spheres.

    Ericson, Real-Time Collision Detection, Morgan Kaufmann, 2005, section 5.1.9.
    """
    apart = configuration.between(second.frame, first.frame)
    one, other = (_along(configuration, shape, shape.corners[-1]) for shape in (first, second))
    a, b, c = dot(one, one), dot(one, other), dot(one, apart)
    e, f = dot(other, other), dot(other, apart)
    turned = a * e - b * b
    share = lambda numerator, denominator: jnp.clip(ratio(numerator, denominator, 0.0), 0.0, 1.0)
    crossing = turned > PARALLEL * a * e
    on_first = jnp.where(crossing, share(b * f - c * e, jnp.where(crossing, turned, 1.0)), jnp.where(a > 0.0, 0.5, 0.0))
    on_second = share(b * on_first + f, e)
    on_first = share(b * on_second - c, a)
    to_first, to_second = on_first * one, on_second * other
    between = apart + to_first - to_second
    distance = length(between)
    normal = ratio(between, distance, 0.0)
    gap = distance - first.radius - second.radius
    return Spot(
        gap,
        normal,
        (to_first - normal * (first.radius + gap / 2.0), to_second + normal * (second.radius + gap / 2.0)),
    )
