"""Find where a wheel and a rail touch."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from linkax.model.attached import AbstractPoses
from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.forces.shapes import Spot
from linkax.model.functions import Law
from linkax.model.numbers import Vector, is_finite, number, require
from linkax.spatial.vectors import dot
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import jit_inline

PLACES = 64  # among which the search for the nearest one begins
STEPS = 20  # of Newton's method from there, at most
CLOSE = 1e-6  # of the span: a step to which another one leaves rounding

Profile = Callable[[Any], Any]  # y [m] ↦ radius, or height [m]


class WheelRailPair(eqx.Module):
    """A wheel and a rail on two bodies, by their profiles.

    - `wheel`, `rail`: frames at the middle of the wheel, y along its axle, and on the rail, x along it and z up.
    - `radius`: of the wheel at y [m] ↦ [m]. `height`: of the rail likewise. `span`: least and largest y of the wheel.
    """

    wheel: Frame
    rail: Frame
    radius: Law
    height: Law
    span: Float[Array, "2"]

    def __init__(
        self, wheel: BodyOrFrame, rail: BodyOrFrame, radius: Profile, height: Profile, span: Vector, what: str
    ) -> None:
        self.wheel, self.rail = frame_of(wheel, f"{what}: wheel"), frame_of(rail, f"{what}: rail")
        if self.wheel.body == self.rail.body:
            raise ValueError(f"{what}: wheel and rail are on body {self.wheel.body!r}; give frames of two bodies")
        self.radius, self.height = (
            _profile(entry, f"{what}: {name} [m]") for entry, name in ((radius, "radius"), (height, "height"))
        )
        rises = lambda ends: (ends[0] < ends[1]) & is_finite(ends)
        span = number(span, (2,), f"{what}: span [m]")
        self.span = require(span, rises, f"{what}: span [m]", "give the least y of the wheel, then the largest")

    @property
    def frames(self) -> tuple[Frame, Frame]:
        """Frames that the two attach to."""
        return self.wheel, self.rail

    def spot(self, poses: AbstractPoses) -> Spot:
        """Find where they are nearest; the gap along the rail's normal is negative where they penetrate.

        Seen along the rail, a wheel has an outline: the places on it where its surface is parallel to the rail, one for
        each y of its axle. Nearest are the outline and the profile of the rail where they have a normal in common.
        """
        axes = jnp.asarray(poses.orientation(self.rail))
        centre = poses.between(self.rail, self.wheel) @ axes
        axle = poses.orientation(self.wheel)[:, 1] @ axes
        outline = lambda u: self._outline(centre, axle, u)
        missed = lambda at: _missed(outline, self.height, at)
        found, held = self._nearest(*lax.stop_gradient((centre, axle)))
        holds = lambda at: jnp.where(jnp.array([False, True]) & held, at[0] - found[0], missed(at))
        at = lax.custom_root(holds, found, lambda _, found: found, _solved)
        place = outline(at[0])
        below, _, normal = _surface(self.height, at[1])
        gap = dot(place[1:] - below, normal)
        normal = jnp.concatenate([jnp.zeros_like(normal[:1]), normal])
        middle = place - gap / 2.0 * normal
        return Spot(gap, axes @ normal, (axes @ (middle - centre), axes @ middle))

    def _outline(self, centre, axle, u):
        """The place on the wheel at u along its axle where its normal is across the rail, in axes of the rail."""
        radius, slope = jax.jvp(self.radius, (u,), (jnp.ones_like(u),))
        ax, ay, az = axle
        across = jnp.sqrt(ay * ay + az * az)
        lean = slope * ax / across  # the radius leans along the rail, by this sine
        down = jnp.stack([jnp.zeros_like(ax), az, -ay]) * jnp.where(ay < 0.0, -1.0, 1.0)
        along = jnp.stack([across * across, -ax * ay, -ax * az])
        return centre + u * axle + radius * (lean * along + jnp.sqrt(1.0 - lean * lean) * down) / across

    @jit_inline
    def _nearest(self, centre, axle):
        """Places u on the wheel and y on the rail that are nearest, and whether u is held there, see `_newton`."""
        self = lax.stop_gradient(self)
        outline = lambda u: self._outline(centre, axle, u)
        span = jnp.asarray(self.span, centre.dtype)
        width = span[1] - span[0]
        newton = lambda at: _newton(lambda at: _missed(outline, self.height, at), at, span)

        def improved(carry):
            count, at, _ = carry
            # In one loop, of which programs hold many.
            better = lax.cond(count == 0, lambda at: self._best(outline, span), lambda at: newton(at)[0], at)
            return count + 1, better, jnp.where(count == 0, width, jnp.max(jnp.abs(better - at)))

        goes_on = lambda carry: (carry[0] <= STEPS) & (carry[2] > CLOSE * width)
        _, at, _ = lax.while_loop(goes_on, improved, (jnp.zeros((), int), span, width))
        return newton(at)

    def _best(self, outline, span):
        """The nearest of many places u on the wheel, and y straight below it."""
        u = span[0] + (span[1] - span[0]) * jnp.asarray(np.linspace(0.0, 1.0, PLACES), span.dtype)
        _, y, z = jax.vmap(outline)(u).T
        below, slope = jax.vmap(lambda y: jax.jvp(self.height, (y,), (jnp.ones_like(y),)))(y)
        best = jnp.nanargmin((z - below) / jnp.sqrt(1.0 + slope * slope))
        return jnp.stack([u[best], y[best]])


def _profile(entry, what):
    if not callable(entry):
        raise ValueError(f"{what} is {entry!r}; give a function of y, such as lambda y: 0.46 + y / 40, or a Spline")
    law = Law(entry, (), what)
    jax.eval_shape(law, jnp.zeros(()))
    return law


def _surface(height, y):
    """A place on the rail's profile, its unit tangent and normal, in the plane across the rail."""
    z, slope = jax.jvp(height, (y,), (jnp.ones_like(y),))
    tangent = jnp.stack([jnp.ones_like(y), slope]) / jnp.sqrt(1.0 + slope * slope)
    return jnp.stack([y, z]), tangent, jnp.stack([-tangent[1], tangent[0]])


def _missed(outline, height, at):
    """Zero where the outline at u is straight above the rail at y, and parallel to it."""
    u, y = at
    place, along = jax.jvp(outline, (u,), (jnp.ones_like(u),))
    below, tangent, normal = _surface(height, y)
    return jnp.stack([dot(place[1:] - below, tangent), dot(along[1:], normal)])


def _newton(missed, at, span):
    """A step of Newton's method to less than a place further, and whether u stays where it is.

    It does at an end of its span, and along a line of contact, of which any place will do; y is straight below then.
    """
    (above, parallel), ((by_u, by_y), (bend_u, bend_y)) = missed(at), jax.jacfwd(missed)(at)
    farthest = (span[1] - span[0]) / PLACES
    curved = by_u * bend_y - by_y * bend_u  # positive where a place is nearest
    u = at[0] + jnp.clip(ratio(by_y * parallel - bend_y * above, curved, 0.0), -farthest, farthest)
    held = (u <= span[0]) | (u >= span[1]) | (curved <= 0.0)
    u = jnp.clip(u, *span)
    step = jnp.stack([u, at[1] - (above + by_u * (u - at[0])) / by_y])
    return jnp.where(jnp.isfinite(step).all(), step, at), held  # a profile may end


def _solved(linear, right):
    """Solve two linear equations."""
    (a, c), (b, d) = jax.vmap(linear)(jnp.eye(2, dtype=right.dtype))
    return jnp.stack([d * right[0] - b * right[1], a * right[1] - c * right[0]]) / (a * d - b * c)
