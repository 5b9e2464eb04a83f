"""An actuator whose force is affine in a linear combination of coordinates and in its rate."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.elements import Motion
from linkax.model.forces.actuators import Control
from linkax.model.forces.force import AbstractForce, Load
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, Vector, number, real, require
from linkax.model.terms import Combination, CombinationLike, Term
from linkax.xla.arrays import Array, Scalar


class AffineActuator(AbstractForce):
    """An actuator along one joint, or along several: F = gain × control + b₀ + b₁ l + b₂ l̇, with the bias (b₀, b₁, b₂).

    Its length is l = Σ factor × coordinate over its transmission. F acts along each joint with factor × F on the child,
    and its opposite on the parent. This is MuJoCo's `general` actuator with affine gain and bias, on a joint or on a
    fixed tendon (MuJoCo, XML reference, actuator/general):

    - a motor has the gain 1, and no bias;
    - a position servo the gain P, and the bias (0, −P, −D);
    - a velocity servo the gain D, and the bias (0, 0, −D);
    - a spring with a damper along a fixed tendon the gain 0, and the bias (k × rest length, −k, −d).

    `Solution.force` reads F. It has no potential energy, even as a spring: all of its work is in `Solution.work`.
    Angles in l count turns, see `linkax.JointSpring`.

    **Arguments:**

    - `transmission`: {joint: factor}, or a joint's name, whose factor is one. For one of several coordinates the key
      is (joint, index).
    - `control`: a number, or a function (t, motion) ↦ number; see `linkax.JointTorque`.
    - `gain`: a number, or (g₀, g₁, g₂) for the gain g₀ + g₁ l + g₂ l̇.
    - `bias`: (b₀, b₁, b₂).
    - `force_range`: (lower, upper), which F stays within; None for no limits. Adaptive steps end where a limit is
      reached and where it is left.
    - `name`: see `linkax.AbstractForce`.

    With factors without unit and l in radians, F is in N m and b₁ in N m/rad, with l in metres in N and N/m.

    **Raises:** `ValueError` for a transmission without a factor that is not zero, for an upper limit that is not above
    the lower one, and by `linkax.Mechanism` for coordinates of a ball joint, which are part of a quaternion.
    """

    name: str | None = eqx.field(static=True)
    transmission: Combination
    control: Scalar | Law
    gain: Scalar | Float[Array, "3"]
    bias: Float[Array, "3"]
    force_range: Float[Array, "2"] | None

    def __init__(
        self,
        transmission: CombinationLike,
        control: Control = 0.0,
        *,
        gain: Number | Vector = 1.0,
        bias: Vector = (0.0, 0.0, 0.0),
        force_range: Vector | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "AffineActuator")
        self.transmission = Combination(transmission, "AffineActuator: transmission")
        of = f"{self.display_name}:"
        self.control = number_or_law(control, (), f"{of} control")
        gain = real(gain, f"{of} gain")
        self.gain = number(gain, (3,) if gain.ndim else (), f"{of} gain")
        self.bias = number(bias, (3,), f"{of} bias")
        self.force_range = None
        if force_range is not None:
            what, rises = f"{of} force_range", lambda ends: ends[0] < ends[1]
            self.force_range = require(
                number(force_range, (2,), what), rises, what, "the upper limit must be above the lower one"
            )

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.transmission.terms

    @property
    def needs_coordinate(self) -> bool:
        return True

    @property
    def has_switch(self) -> bool:
        return self.force_range is not None

    def _unlimited(self, t, motion):
        length = self.transmission.of(lambda along: motion.configuration.joint_displacement(along, 0.0))
        rate = self.transmission.of(motion.joint_rate)
        affine = lambda numbers: numbers[0] + numbers[1] * length + numbers[2] * rate
        gain = affine(self.gain) if self.gain.ndim else self.gain
        return gain * evaluated(self.control, t, motion) + affine(self.bias)

    def switch(self, t: Number, motion: Motion) -> Scalar:
        """Positive where F is within its limits."""
        assert self.force_range is not None
        lower, upper = self.force_range
        force = self._unlimited(t, motion)
        return jnp.minimum(force - lower, upper - force) / (upper - lower)

    def strength(self, t: Number, motion: Motion, on: Any = True) -> Scalar:
        force = self._unlimited(t, motion)
        if self.force_range is None:
            return force
        lower, upper = self.force_range
        return jnp.where(on, force, jnp.where(2.0 * force > lower + upper, upper, lower))

    def load(self, t: Number, motion: Motion, on: Any = True) -> Load:
        force, total = self.strength(t, motion, on), Load.none(motion.system)
        for along, factor in zip(self.transmission.terms, self.transmission.factors, strict=True):
            total = total.plus(motion.joint_load(along, factor * force))
        return total
