"""Constraints that lead a point or a body: on a surface, or as a function of time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.attached import Attached
from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.constraints.constraint import AbstractConstraint, checked_name
from linkax.model.functions import Law
from linkax.model.numbers import Number, Vector
from linkax.xla.arrays import Array, Scalar


class PointOnSurface(AbstractConstraint):
    """A point that stays on a surface f(x) = 0 of another body.

    `PointOnSurface("bowl", ball, lx.GROUND, lambda x: jnp.linalg.norm(x) - 0.5)` keeps the ball's reference point on a
    sphere. Its reaction μ is the force μ ∇f on the point [N]: the normal force where f is a distance.

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `point`, `surface`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
    - `function`: f, position of the point in the frame `surface` [m], (3,) ↦ number [m]; twice differentiable by JAX,
      with a gradient on the surface that is not zero. What it may read is as for `Drive`.

    **Raises:** `ValueError` for a function that does not return one number.
    """

    point: Frame
    surface: Frame
    function: Law

    def __init__(self, name: str, point: BodyOrFrame, surface: BodyOrFrame, function: Callable[[Any], Number]) -> None:
        self.name = checked_name(name, "surface")
        self.point = frame_of(point, f"surface {name!r}: point")
        self.surface = frame_of(surface, f"surface {name!r}: surface")
        self.function = Law(function, (), f"surface {name!r}: function [m]")
        jax.eval_shape(self.function, jnp.zeros(3))

    def residual(self, t: Number, attached: Attached) -> Scalar:
        return self.function(attached.between(self.surface, self.point) @ attached.orientation(self.surface))


class Prescribed(AbstractConstraint):
    """A pose of a body as a function of time, such as that of a moving ground.

    `Prescribed("shaker", table, lambda t: jnp.array([0.0, 0.0, 0.01 * jnp.sin(50.0 * t)]), lambda t: jnp.eye(3))`
    moves a table that a `Free` joint carries. Its reaction is the force on the body at the point [N], and with an
    orientation the moment on it [N m], in ground axes, (n_t, 3) or (n_t, 6).

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `frame`: a body (its reference frame), or `body.at(...)`.
    - `position`: t [s] ↦ the origin in the world [m], (3,).
    - `orientation`: t ↦ the axes as columns in ground axes, (3, 3); None leaves it free. Both twice differentiable by
      JAX. What they may read is as for `Drive`.

    **Raises:** `ValueError` for functions that return other shapes.
    """

    is_driven = True

    frame: Frame
    position: Law
    orientation: Law | None

    def __init__(
        self,
        name: str,
        frame: BodyOrFrame,
        position: Callable[[Any], Vector],
        orientation: Callable[[Any], Any] | None = None,
    ) -> None:
        self.name = checked_name(name, "prescribed pose")
        what = f"prescribed pose {name!r}"
        self.frame = frame_of(frame, what)
        self.position = Law(position, (3,), f"{what}: position [m]")
        self.orientation = None if orientation is None else Law(orientation, (3, 3), f"{what}: orientation")
        for law in filter(None, (self.position, self.orientation)):
            jax.eval_shape(law, jnp.zeros(()))

    @property
    def units(self) -> tuple[str, ...]:
        return 3 * ("m",) + (3 * ("rad",) if self.orientation is not None else ())

    @property
    def display_name(self) -> str:
        return f"prescribed pose {self.name!r}"

    def residual(self, t: Number, attached: Attached) -> Float[Array, " k"]:
        missed = attached.point_position(self.frame) - self.position(t)
        if self.orientation is None:
            return missed
        asked = self.orientation(t)
        return jnp.concatenate([missed, asked @ _turn(asked.T @ attached.orientation(self.frame))])


def _turn(rotation: Float[Array, "3 3"]) -> Float[jax.Array, "3"]:
    """The vector 2 tan(θ/2) n of a rotation by θ about n: of Rodrigues' parameters, not zero at half a turn."""
    skew = rotation - rotation.T
    return 2.0 * jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]]) / (1.0 + jnp.trace(rotation))
