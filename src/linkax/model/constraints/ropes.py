"""Ropes over points of bodies, of given length or elastic."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.attached import Attached
from linkax.model.bodies import AbstractBody, BodyOrFrame, Frame, frame_of
from linkax.model.constraints.constraint import AbstractConstraint, checked_name
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.force import AbstractForce, Load
from linkax.model.functions import Law, evaluated
from linkax.model.names import optional_name
from linkax.model.numbers import Number, listed, positive, zero_or_more
from linkax.spatial.vectors import dot, length
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio

Points = tuple[Frame, ...]


def _points(points: Iterable[BodyOrFrame], what: str) -> Points:
    remedy = "give a list of bodies, body.at(...), or lx.GROUND.at(...)"
    given = listed(points, (AbstractBody, Frame), f"{what}: points", remedy)
    frames = tuple(frame_of(point, f"{what}: a point") for point in given)
    if len(frames) < 2:
        raise ValueError(f"{what} has {len(frames)} points; give two or more, in the order of the rope")
    if len({frame.body for frame in frames}) == 1:
        raise ValueError(f"{what}: its points are all on body {frames[0].body!r}; give points on two bodies or more")
    return frames


def _spans(configuration: Configuration, points: Points) -> Float[jax.Array, "n 3"]:
    """Compute the vectors from each point to the next [m]."""
    ends = pairwise(points)
    return jnp.stack([configuration.between(first, second) for first, second in ends])


def _directions(spans: Float[jax.Array, "n 3"]) -> Float[jax.Array, "n 3"]:
    return ratio(spans, length(spans)[:, None])


def _rate(motion: Motion, points: Points) -> Float[Array, "n 3"]:
    velocity = jnp.stack([motion.point_velocity(point) for point in points])
    return velocity[1:] - velocity[:-1]


def _pull(configuration: Configuration, points: Points, tension: Number) -> Load:
    """Compute the load of a rope on its points."""
    forces = tension * _directions(_spans(configuration, points))
    total = Load.none(configuration.system)
    for first, second, force in zip(points, points[1:], forces, strict=False):
        total = total.plus(configuration.point_load(first, force)).plus(configuration.point_load(second, -force))
    return total


class Rope(AbstractConstraint):
    """A rope, without mass and friction, that stays taut over points (small sheaves); or a strut between two.

    `Rope("hoist", [winch, boom.at("tip"), hook], length=30.0)` keeps the sum of the distances from point to point
    at 30 m. Its reaction is the tension [N]; where that is negative, a rope would be slack, and a strut is pressed.
    It carries no body: each body needs joints that connect it to ground.

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `points`: two or more bodies (their reference frames), `body.at(...)`, or `lx.GROUND.at(...)`, in order.
    - `length`: [m], a number, or a function of time t [s], twice differentiable, for a winch or a driven cylinder.
      What the function may read is as for `Drive`.

    **Raises:** `ValueError` for fewer than two points, for points that are all on one body, and for a length that is
    not positive.
    """

    points: Points
    length: Scalar | Law

    def __init__(self, name: str, points: Iterable[BodyOrFrame], length: Number | Callable[[Any], Number]) -> None:
        self.name = checked_name(name, "rope")
        self.points = _points(points, f"rope {name!r}")
        if callable(length):
            self.length = Law(length, (), f"rope {name!r}: length [m]")
            jax.eval_shape(self.length, jnp.zeros(()))
        else:
            self.length = positive(length, f"rope {name!r}: length [m]")

    @property
    def is_driven(self) -> bool:
        return isinstance(self.length, Law)

    def residual(self, t: Number, attached: Attached) -> Scalar:
        """Compute what it is too long; with this sign its multiplier is the tension."""
        return evaluated(self.length, t) - self.extent(attached)

    def extent(self, configuration: Configuration) -> Scalar:
        return jnp.sum(length(_spans(configuration, self.points)))


class ElasticRope(AbstractForce):
    """An elastic rope, without mass and friction, over points (small sheaves). It pulls, and never pushes.

    Taut, it has the tension stiffness × stretch + damping × rate of stretch. With damping the tension jumps where it
    goes taut. Steps end where it goes taut or slack.

    **Arguments:** `points`: see `Rope`; `stiffness` [N/m], E A / free_length; `free_length` [m]; `damping` [N s/m];
    `name`, see `linkax.AbstractForce`.

    **Raises:** `ValueError` as for `Rope`, for a stiffness or free length that is not positive, and for a negative
    damping.
    """

    name: str | None = eqx.field(static=True)
    points: Points
    stiffness: Scalar
    free_length: Scalar
    damping: Scalar

    def __init__(
        self,
        points: Iterable[BodyOrFrame],
        stiffness: Number,
        free_length: Number,
        damping: Number = 0.0,
        *,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "ElasticRope")
        self.points = _points(points, "ElasticRope")
        self.stiffness = positive(stiffness, f"{self.display_name}: stiffness [N/m]")
        self.free_length = positive(free_length, f"{self.display_name}: free_length [m]")
        self.damping = zero_or_more(damping, f"{self.display_name}: damping [N s/m]")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.points

    def extent(self, configuration: Configuration) -> Scalar:
        return jnp.sum(length(_spans(configuration, self.points)))

    def _stretch(self, configuration: Configuration) -> Scalar:
        return self.extent(configuration) - self.free_length

    def _rate_of_stretch(self, motion: Motion) -> Scalar:
        along = _directions(_spans(motion.configuration, self.points))
        return jnp.sum(dot(along, _rate(motion, self.points)))

    def switch(self, t: Number, motion: Motion) -> Scalar:
        """Positive where it is taut: longer than free, and not shortening so fast that damping cancels the pull."""
        stretch = self._stretch(motion.configuration)
        slower = self.damping / self.stiffness * self._rate_of_stretch(motion)
        return (stretch + jnp.minimum(slower, 0.0)) / self.free_length

    def separation(self, configuration: Configuration) -> Scalar:
        return -self._stretch(configuration) / self.free_length

    def strength(self, t: Number, motion: Motion, on: Any) -> Scalar:
        stretch, rate = self._stretch(motion.configuration), self._rate_of_stretch(motion)
        return jnp.where(on, self.stiffness * stretch + self.damping * rate, 0.0)

    def load(self, t: Number, motion: Motion, on: Any) -> Load:
        return _pull(motion.configuration, self.points, self.strength(t, motion, on))

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.stiffness * jnp.maximum(self._stretch(configuration), 0.0) ** 2 / 2.0
