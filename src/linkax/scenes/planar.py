"""Planar mechanisms that are drawn by the places of their pins, which several scenes share."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import linkax as lx
from linkax.model.bodies import BodyOrFrame
from linkax.model.numbers import Number, is_finite, require
from linkax.xla.arrays import Array, Scalar
from linkax.xla.tracing import concrete

Point = Float[Array, "2"]


def meet(center: Point, radius: Number, other: Point, other_radius: Number, side: float = 1.0) -> Point:
    """Compute where two circles meet [m], left of the way from the first centre to the other, or right for side −1.

    NaN where they do not; see `closed`.
    """
    way = other - center
    square = way @ way
    along = (square + radius**2 - other_radius**2) / (2.0 * square)
    across = side * jnp.sqrt(radius**2 / square - along**2)
    return center + along * way + across * jnp.stack([-way[1], way[0]])


def along(angle: Number) -> Point:
    """Compute the unit vector at an angle from +x [rad]."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@partial(jax.jit, static_argnames="ring")
def outline(corners: list[Point], ring: bool = False) -> Scalar:
    """Compute the length of bars from each corner to the next, and back to the first in a ring [m]."""
    ends = jnp.stack([*corners, corners[0]] if ring else corners)
    return jnp.sum(jnp.sqrt(jnp.sum(jnp.diff(ends, axis=0) ** 2, axis=1)))


def turn_between(first: Point, second: Point) -> Scalar:
    """Compute the angle from one vector to another, in (−π, π] [rad]."""
    return jnp.arctan2(first[0] * second[1] - first[1] * second[0], first @ second)


def closed(places: Mapping[str, Array], scene: str) -> dict[str, Array]:
    """Check that all pins have a place; they have none where links are too short or too long for each other."""
    what, remedy = f"scene {scene!r}: place of pin %r [m]", "links do not reach each other; change lengths or angles"
    return {name: require(settled(place), is_finite, what % name, remedy) for name, place in places.items()}


def settled(array: Array) -> Array:
    """The same array, NumPy's where it is not traced, so that what follows compiles nothing."""
    return array if concrete(array) is None else np.asarray(array)


def linked(
    name: str, places: Mapping[str, Point], mass: Number, *, ring: bool = False, height: Number = 0.0
) -> lx.RigidBody:
    """Make a flat body of uniform slender bars from each place to the next one, as it stands in the world.

    **Arguments:**

    - `places`: its frames, {name: [x, y] in the world [m]}; its reference frame is at the first.
    - `mass`: of all bars together [kg].
    - `ring`: whether a bar leads from the last place back to the first.
    - `height`: z of all places [m].
    """
    first, *_ = corners = list(places.values())
    center, gyration = map(settled, _of_bars(corners, ring))
    return lx.RigidBody(
        name,
        mass,
        [center[0], center[1], 0.0],
        mass * gyration,
        {label: [place[0] - first[0], place[1] - first[1], 0.0] for label, place in places.items()},
    ).placed([first[0], first[1], height])


@partial(jax.jit, static_argnames="ring")
def _of_bars(corners: list[Point], ring: bool) -> tuple[Point, Scalar]:
    """Centre of mass, from the first corner [m], and squared radius of gyration about it [m²]."""
    ends = jnp.stack([*corners, corners[0]] if ring else corners)
    squares = jnp.sum(jnp.diff(ends, axis=0) ** 2, axis=1)
    shares = jnp.sqrt(squares) / jnp.sum(jnp.sqrt(squares))
    middles = (ends[:-1] + ends[1:]) / 2.0
    center = shares @ middles
    return center - ends[0], shares @ (squares / 12.0 + jnp.sum((middles - center) ** 2, axis=1))


def pin(name: str, parent: BodyOrFrame, child: BodyOrFrame) -> lx.Revolute:
    """Make a hinge about z."""
    return lx.Revolute(name, parent, child, axis="z")


def on_ground(place: Point, height: Number = 0.0) -> lx.Frame:
    """Make a frame on the ground at [x, y] [m]."""
    return lx.GROUND.at([place[0], place[1], height])
