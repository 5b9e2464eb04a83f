"""Press and pull a wheel on a rail: Hertz' normal force, and forces of creep."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame, Frame
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.contact import SurfaceContact
from linkax.model.forces.contact_law import ContactLaw
from linkax.model.forces.shapes import Spot
from linkax.model.forces.wheel_rail import Profile, WheelRailPair
from linkax.model.names import optional_name
from linkax.model.numbers import Number, Vector, positive, require_type, zero_or_more
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import positive_or_one


class Creep(eqx.Module):
    """What a rolling wheel pulls with where it slips a little: Kalker's linear theory, saturated by Polach's formula.

    Creepages are slip over rolling speed: ξ along the rail, η across it, and φ [1/m] of the angular velocity about the
    normal. In the axes of rolling, the normal third, they give the force −f₁₁ ξ, −f₂₂ η − f₂₃ φ and the moment
    f₂₃ η − f₃₃ φ on the wheel: Kalker, Three-Dimensional Elastic Bodies in Rolling Contact, Kluwer, 1990, section 2.2.
    With τ the size of this force and ε = π τ / (4 μ N), both are multiplied by

    [1 / (1 + ε²) + arctan(ε) / ε] / 2,

    which is 1 at small creep, and leaves a force of μ N at a large one: Polach, A fast wheel-rail forces calculation
    computer code, Vehicle System Dynamics 33 (supplement), 1999. They never add energy.

    **Arguments:**

    - `longitudinal`, `lateral`: f₁₁, f₂₂ [N], zero or more; f = G a b C of Kalker's table, a and b the half-axes of
      the ellipse of contact, G the shear modulus.
    - `friction`: μ.
    - `lateral_spin`, `spin`: f₂₃ = G (a b)^(3/2) C₂₃ [N m], f₃₃ = G (a b)² C₃₃ [N m²], zero by default.
    - `load`: the normal force N₀ at which these hold [N]. At N they are multiplied by (N / N₀)^(2/3), f₂₃ by N / N₀,
      and f₃₃ by (N / N₀)^(4/3), as Hertz' ellipse grows; None (default) keeps them constant.
    - `least_speed`: v₀ [m/s], 0.1 by default: at a rolling speed v creepages are slip over √(v² + v₀²), so that a wheel
      that stands creeps slowly.

    **Raises:** `ValueError` for numbers that are negative, and for a `load`, a `least_speed` or a `friction` of zero.
    """

    longitudinal: Scalar
    lateral: Scalar
    lateral_spin: Scalar
    spin: Scalar
    friction: Scalar
    load: Scalar | None
    least_speed: Scalar

    def __init__(
        self,
        longitudinal: Number,
        lateral: Number,
        friction: Number,
        *,
        lateral_spin: Number = 0.0,
        spin: Number = 0.0,
        load: Number | None = None,
        least_speed: Number = 0.1,
    ) -> None:
        self.longitudinal = zero_or_more(longitudinal, "Creep: longitudinal [N]")
        self.lateral = zero_or_more(lateral, "Creep: lateral [N]")
        self.friction = positive(
            friction, "Creep: friction", "it must be positive; without forces of creep leave it out"
        )
        self.lateral_spin = zero_or_more(lateral_spin, "Creep: lateral_spin [N m]")
        self.spin = zero_or_more(spin, "Creep: spin [N m²]")
        self.load = None if load is None else positive(load, "Creep: load [N]")
        self.least_speed = positive(least_speed, "Creep: least_speed [m/s]")

    def force(self, normal: Scalar, speed: Scalar, slip: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        """Compute the forces along and across the rail [N], and the moment about the normal [N m], on the wheel.

        **Arguments:** `normal`: force [N]; `speed`: of rolling along the rail [m/s]; `slip`: velocity of the wheel
        seen from the rail, along and across [m/s], and the angular velocity about the normal [rad/s].
        """
        pressed = positive_or_one(jnp.abs(normal))
        root = 1.0 if self.load is None else jnp.cbrt(pressed / self.load)
        unit = jnp.sqrt(speed**2 + self.least_speed**2)
        along, across, spin = slip / unit
        coupled = self.lateral_spin * root**3 * speed / unit  # of the axes of rolling, which turn with its direction
        pull = -self.longitudinal * root**2 * along
        push = -self.lateral * root**2 * across - coupled * spin
        moment = coupled * across - self.spin * root**4 * spin
        share = _saturation((pull**2 + push**2) * (jnp.pi / (4.0 * self.friction * pressed)) ** 2)
        # Odd in the normal force, which goes on a little past zero within a step that ends there.
        return jnp.sign(normal) * share * jnp.stack([pull, push, moment])


def _saturation(square: Any) -> Any:
    """Polach's share as a function of ε², smooth at zero."""
    small = square < 1e-3
    root = jnp.sqrt(jnp.where(small, 1.0, square))
    series = 1.0 + square * (-1.0 / 3.0 + square * (0.2 + square * (-1.0 / 7.0 + square * (1.0 / 9.0 - square / 11.0))))
    return (1.0 / (1.0 + square) + jnp.where(small, series, jnp.arctan(root) / root)) / 2.0


class WheelRailContact(SurfaceContact):
    """Contact of a wheel with a straight rail: its normal force by a contact law, with forces of creep.

    The wheel is a surface of revolution about the y axis of its frame, with a radius for each y, and the rail a
    profile, a height z for each y, along the x axis of its frame. Where they are nearest is found at each instant,
    exactly for any attitude of the wheel: the normal force acts there, in the middle of the penetration, and the
    rolling radius, the slope of the contact and the spin follow. Steps end where the wheel lifts off, and where it
    meets the rail.

    Rails are straight, and may be on a body that moves; curved track it cannot tell. Where a wheel touches in two
    places, on its tread and its flange, give two of these with a `span` each, which the place of contact does not
    leave; one alone jumps from one place to the other. Profiles need curvatures that differ where they touch: a cone on
    a flat rail touches along a line, which one force cannot stand for.

    `Solution.force` has the normal force [N].

    **Arguments:**

    - `wheel`: a body (its reference frame), or `body.at(...)`, on the axle, with y along it.
    - `rail`: a body, `body.at(...)` or `lx.GROUND`, with x along the rail and z up. For the rail on the other side turn
      both frames about z by π, or give functions of −y.
    - `radius`: y [m] ↦ radius of the wheel [m], `height`: y ↦ z of the rail [m]; functions, such as
      `lambda y: 0.46 + y / 40`, or a `linkax.Spline` through measured profiles, three times differentiable for forces
      that change smoothly. They go on beyond what touches, as a parabola does and an arc does not, since a search looks
      there. What they may read is as for `linkax.Drive`.
    - `span`: least and largest y of the wheel at which it may touch [m]; at its ends the force has no potential energy.
    - `law`: a `linkax.ContactLaw` without friction. `creep`: a `linkax.Creep`; None: it slips freely.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for two frames on one body, profiles that are no functions of one number, a span that does
    not rise, and a law with friction.
    """

    name: str | None = eqx.field(static=True)
    pair: WheelRailPair
    law: ContactLaw
    creep: Creep | None

    def __init__(
        self,
        wheel: BodyOrFrame,
        rail: BodyOrFrame,
        *,
        radius: Profile,
        height: Profile,
        span: Vector,
        law: ContactLaw,
        creep: Creep | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "WheelRailContact")
        what = "WheelRailContact" if name is None else f"WheelRailContact {name!r}"
        self.pair = WheelRailPair(wheel, rail, radius, height, span, what)
        self.law = require_type(law, ContactLaw, f"{what}: law", "give a linkax.ContactLaw")
        if law.friction is not None:
            raise ValueError(f"{what}: its law has friction; leave that out, and give creep=linkax.Creep(...)")
        if creep is not None:
            require_type(creep, Creep, f"{what}: creep", "give a linkax.Creep, or None")
        self.creep = creep

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.pair.frames

    @property
    def sides(self) -> tuple[Frame, Frame]:
        return self.pair.frames

    def spots(self, configuration: Configuration) -> list[Spot]:
        return [self.pair.spot(configuration)]

    def tangential(self, motion: Motion, spot: Spot, velocity: Array, normal: Array) -> tuple[Any, Any]:
        if self.creep is None:
            return super().tangential(motion, spot, velocity, normal)
        wheel, rail = self.sides
        along = motion.configuration.orientation(rail)[:, 0]
        across = cross(spot.normal, along)
        turns = [motion.angular_velocity[motion.configuration.body(frame.body)] for frame in (wheel, rail)]
        # The place of contact goes along with the wheel's centre, past both surfaces.
        passed = motion.point_velocity(wheel) - motion.velocity_at(rail, spot.arms[1]) - velocity / 2.0
        slip = jnp.stack([dot(velocity, along), dot(velocity, across), dot(turns[0] - turns[1], spot.normal)])
        pull, push, moment = self.creep.force(normal, dot(passed, along), slip)
        return pull * along + push * across, moment * spot.normal
