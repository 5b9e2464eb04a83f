"""Forces of contact at a given penetration: Hunt and Crossley's normal force, Brown and McPhee's friction."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.numbers import Number, namespace, number, positive, require, require_type, zero_or_more
from linkax.spatial.vectors import dot
from linkax.xla.arrays import Array, Scalar

NEWTON_STEPS = 10  # from Flores' approximation, a few more than double precision takes


class Friction(eqx.Module):
    """Dry friction, regularised: below `transition_speed` it is nearly viscous, so that what should stick creeps.

    At the speed v of sliding, with x = v / transition_speed, a normal force N has the friction

    N [dynamic tanh(4 x) + (static − dynamic) x / (x²/4 + 3/4)²] + viscous v tanh(4 N / viscous_force),

    smooth, with its peak of static × N at the transition speed. What rests under a load below it creeps at less than
    `transition_speed`; the smaller that is, the stiffer the motion. Brown and McPhee, A continuous velocity-based
    friction model for dynamics and control with physically meaningful parameters, Journal of Computational and
    Nonlinear Dynamics 11(5), 2016. Where things are to stick for long, take a simulator with rigid dry friction, such
    as MuJoCo.

    **Arguments:**

    - `dynamic`, `static`: coefficients of friction, zero or more; `static` is `dynamic` if left out.
    - `transition_speed`: at which it is largest [m/s].
    - `viscous`: [N s/m], and `viscous_force`: the normal force above which it acts in full [N].

    **Raises:** `ValueError` for a negative coefficient, a transition speed or force that is not positive, and for
    `viscous` without `viscous_force`.
    """

    dynamic: Scalar
    static: Scalar
    transition_speed: Scalar
    viscous: Scalar
    viscous_force: Scalar

    def __init__(
        self,
        dynamic: Number,
        static: Number | None = None,
        *,
        transition_speed: Number,
        viscous: Number | None = None,
        viscous_force: Number | None = None,
    ) -> None:
        if (viscous is None) != (viscous_force is None):
            raise ValueError(
                f"Friction: viscous is {viscous!r} and viscous_force is {viscous_force!r}; give both, or neither"
            )
        self.dynamic = zero_or_more(dynamic, "Friction: dynamic")
        self.static = self.dynamic if static is None else zero_or_more(static, "Friction: static")
        self.transition_speed = positive(transition_speed, "Friction: transition_speed [m/s]")
        self.viscous = zero_or_more(0.0 if viscous is None else viscous, "Friction: viscous [N s/m]")
        self.viscous_force = positive(1.0 if viscous_force is None else viscous_force, "Friction: viscous_force [N]")

    def force(self, normal: Scalar, sliding: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        """Compute the friction [N] on what slides at a velocity [m/s] under a normal force [N]."""
        square = dot(sliding, sliding) / self.transition_speed**2
        dry = self.dynamic * 4.0 * _tanh_ratio(16.0 * square)
        dry = dry + (self.static - self.dynamic) / (square / 4.0 + 0.75) ** 2
        viscous = self.viscous * jnp.tanh(4.0 * normal / self.viscous_force)
        return -(normal * dry / self.transition_speed + viscous) * sliding


def _tanh_ratio(square: Any) -> Any:
    """tanh(y) / y as a function of y², smooth at zero."""
    small = square < 1e-3
    y = jnp.sqrt(jnp.where(small, 1.0, square))
    series = 1.0 + square * (-1.0 / 3.0 + square * (2.0 / 15.0 + square * (-17.0 / 315.0 + square * 62.0 / 2835.0)))
    return jnp.where(small, series, jnp.tanh(y) / y)


class ContactLaw(eqx.Module):
    """The force between two bodies that touch, from how deep they penetrate and how fast.

    At a penetration δ its normal part is stiffness × δ^exponent × (1 + damping × dδ/dt), where that is not negative: it
    pushes, and never pulls. Hunt and Crossley, Coefficient of restitution interpreted as damping in vibroimpact,
    Journal of Applied Mechanics 42(2), 1975. Its elastic part is a potential energy; what damping and friction take is
    in `Solution.power` and `Solution.work`.

    `restitution` at `impact_speed` gives the damping. A body that hits an immobile one at that speed v₀, with no other
    force on it, leaves at restitution × v₀, whatever its mass, the stiffness and the exponent: d = damping × v₀ solves
    (1 + e) d = ln((1 + d) / (1 − e d)). Marhefka and Orin, A compliant contact model with nonlinear damping for
    simulation of robotic systems, IEEE Transactions on Systems, Man and Cybernetics A 29(6), 1999. Other formulas
    approximate this root: Hunt and Crossley's 3 (1 − e) / 2 for e near one, Flores' 8 (1 − e) / (5 e) for all e
    (Flores, Machado, Silva, Martins, On the continuous contact force models for soft materials in multibody dynamics,
    Multibody System Dynamics 25, 2011), which is 12 % off at e = 0.5, and up to 60 % where e is small. At other speeds
    restitution differs: with the same damping slow impacts lose less, as those of metals do.

    A contact lasts for about 3 (m / stiffness)^(2/5) v₀^(−1/5) with exponent 3/2, m the mass that meets it, and takes
    some 30 steps. It delays the motion by about this time, compared with a rigid stop of the same restitution: results
    are off in proportion to stiffness^(−2/5), half as far with one 5.7 times as large. Ten bounces from 1 m, of 1 kg on
    1e7 N/m^(3/2), end 0.04 s late. Where stops are hit rarely, `linkax.Impact` is exact and takes a step or two for an
    impact. Where many bodies touch at once, are stacked, or stick, take a simulator made for that, such as MuJoCo.

    **Arguments:**

    - `stiffness`: [N/m^exponent], or [N m/rad^exponent] at the stop of a hinge.
    - `exponent`: 1 or more; 3/2 (default) for bodies that touch at a point (Hertz), 1 for flat ones.
    - `damping`: [s/m] (or [s/rad]); or `restitution`, between 0 and 1, at `impact_speed` [m/s] (or [rad/s]). Without
      them no energy is lost.
    - `friction`: a `linkax.Friction`, for contacts between surfaces.

    **Raises:** `ValueError` for numbers outside of these ranges, for `damping` beside `restitution`, and for one of
    `restitution` and `impact_speed` without the other.
    """

    stiffness: Scalar
    exponent: Scalar
    damping: Scalar
    friction: Friction | None

    def __init__(
        self,
        stiffness: Number,
        exponent: Number = 1.5,
        *,
        damping: Number | None = None,
        restitution: Number | None = None,
        impact_speed: Number | None = None,
        friction: Friction | None = None,
    ) -> None:
        if (restitution is None) != (impact_speed is None) or (damping is not None and restitution is not None):
            raise ValueError(
                f"ContactLaw: damping is {damping!r}, restitution {restitution!r}, impact_speed {impact_speed!r}; give "
                "damping, or restitution and the impact_speed at which it holds"
            )
        self.stiffness = positive(stiffness, "ContactLaw: stiffness [N/m^exponent]")
        least = lambda x: x >= 1.0
        self.exponent = require(
            number(exponent, (), "ContactLaw: exponent"), least, "ContactLaw: exponent", "it must be 1 or more"
        )
        if restitution is not None:
            what, inside = "ContactLaw: restitution", lambda x: (x > 0.0) & (x < 1.0)
            remedy = "it must lie between 0 and 1; for no loss leave it out"
            ratio = require(number(restitution, (), what), inside, what, remedy)
            damping = _damping_ratio(ratio) / positive(impact_speed, "ContactLaw: impact_speed [m/s]")
        self.damping = zero_or_more(0.0 if damping is None else damping, "ContactLaw: damping [s/m]")
        if friction is not None:
            require_type(friction, Friction, "ContactLaw: friction", "give a linkax.Friction, or None")
        self.friction = friction

    def normal(self, depth: Scalar, rate: Scalar) -> Scalar:
        """Compute the normal force [N] at a penetration [m] that grows at a rate [m/s]; smooth where it is zero."""
        return self.stiffness * jnp.sign(depth) * jnp.abs(depth) ** self.exponent * (1.0 + self.damping * rate)

    def energy(self, depth: Scalar) -> Scalar:
        """Compute the elastic energy [J] at a penetration [m]; zero where there is none."""
        above = self.exponent + 1.0
        return self.stiffness * jnp.maximum(depth, 0.0) ** above / above

    def presses(self, depth: Scalar, rate: Scalar, unit: Scalar) -> Float[jax.Array, "..."]:
        """Positive where the normal force is: a switch; `unit`: a depth of magnitude one."""
        return jnp.minimum(depth / unit, 1.0 + self.damping * rate)


def _damping_ratio(restitution: Scalar) -> Scalar:
    """The root d of (1 + e) d = ln((1 + d) / (1 − e d)), by Newton's method from above."""
    e, xp = restitution, namespace(restitution)
    least = 1.5 * (1.0 - e)
    d = xp.minimum(1.6 * (1.0 - e) / e, 1.0 / e)
    for _ in range(NEWTON_STEPS):
        fall = xp.exp(-(1.0 + e) * d)
        value = (1.0 + d) * fall - 1.0 + e * d
        d = xp.maximum(d - value / (e + fall * (1.0 - (1.0 + e) * (1.0 + d))), least)
    return d
