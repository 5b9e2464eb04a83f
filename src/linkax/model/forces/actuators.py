"""Actuators with internal states: motors, gas springs. Hydraulic ones are in `hydraulics`."""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from linkax.model.bodies import BodyOrFrame
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.internal_states import InternalState, States
from linkax.model.forces.joint_forces import AlongJoint
from linkax.model.forces.point_forces import BetweenPoints, two_points
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, require, zero_or_more
from linkax.model.terms import TermLike, term
from linkax.xla.arrays import Scalar

Control = Number | Callable[[Any, Any], Number]  # what an actuator is asked for: a number, or a law (t, motion)


class DCMotor(AlongJoint):
    """A direct-current motor along a joint: L di/dt = u − R i − k ω, with the torque k i on the child.

    Its state is "current" [A].

    **Arguments:**

    - `joint`: a name, or (name, index).
    - `voltage`: u [V], a number, or a function (t, motion) ↦ number; see `linkax.JointTorque`.
    - `resistance`: R [Ω]. `inductance`: L [H]. `constant`: k [N m/A, or N/A on a slide], the torque of one ampere and
      the voltage of one rad/s; of a motor with a gear, times the gear's ratio. Its rotor is a `linkax.JointInertia`.
    - `current`: at the start [A]. `scale`: a typical current [A], see `linkax.InternalState`.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for an inductance or a scale that is not positive, and for a negative resistance.
    """

    voltage: Scalar | Law
    resistance: Scalar
    inductance: Scalar
    constant: Scalar
    current: Scalar
    scale: Scalar

    def __init__(
        self,
        joint: TermLike,
        voltage: Control,
        *,
        resistance: Number,
        inductance: Number,
        constant: Number,
        current: Number = 0.0,
        scale: Number = 1.0,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "DCMotor")
        self.joint = term(joint, "DCMotor")
        self.voltage = number_or_law(voltage, (), f"{self.display_name}: voltage [V]")
        self.resistance = zero_or_more(resistance, f"{self.display_name}: resistance [Ω]")
        self.inductance = positive(inductance, f"{self.display_name}: inductance [H]")
        self.constant = number(constant, (), f"{self.display_name}: constant [N m/A]")
        self.current = number(current, (), f"{self.display_name}: current [A]")
        self.scale = positive(scale, f"{self.display_name}: scale [A]")

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {"current": InternalState(self.current, "A", scale=self.scale)}

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        induced = self.constant * motion.joint_rate(self.joint)
        driving = evaluated(self.voltage, t, motion) - self.resistance * states["current"] - induced
        return {"current": driving / self.inductance}

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        return self.constant * states["current"]


class PneumaticSpring(BetweenPoints):
    """Gas in a cylinder that pushes two points apart: p = p₀ (μ V₀ / V)ⁿ, with V = A × (distance − closed).

    n is one for a gas that keeps its temperature, the ratio of its heat capacities (1.4 for air) for one that exchanges
    no heat. V₀ is the volume at `free_length`, where a sealed spring has the pressure p₀. The pull is −(p − ambient) A.

    Sealed, the spring conserves energy and has no state. With a `flow`, its state "amount" is μ, the gas over what it
    holds at the start.

    **Arguments:**

    - `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
    - `area`: A [m²]. `closed`: the distance at which no volume is left [m]. `free_length` [m], larger than `closed`.
    - `pressure`: p₀ [Pa], absolute. `ambient` [Pa]. `exponent`: n.
    - `flow`: rate of μ [1/s], a number, or a function (t, motion) ↦ number; None for a sealed spring.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a number outside of what it can be.
    """

    area: Scalar
    closed: Scalar
    free_length: Scalar
    pressure: Scalar
    ambient: Scalar
    exponent: Scalar
    flow: Scalar | Law | None

    def __init__(
        self,
        first: BodyOrFrame,
        second: BodyOrFrame,
        *,
        area: Number,
        free_length: Number,
        pressure: Number,
        closed: Number = 0.0,
        ambient: Number = 101325.0,
        exponent: Number = 1.4,
        flow: Control | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "PneumaticSpring")
        self.first, self.second = two_points("PneumaticSpring", first, second)
        of = f"{self.display_name}:"
        self.area = positive(area, f"{of} area [m²]")
        self.closed = zero_or_more(closed, f"{of} closed [m]")
        beyond, what = (lambda length: length > self.closed), f"{of} free_length [m]"
        self.free_length = require(number(free_length, (), what), beyond, what, "it must be larger than closed")
        self.pressure = positive(pressure, f"{of} pressure [Pa]")
        self.ambient = zero_or_more(ambient, f"{of} ambient [Pa]")
        self.exponent = positive(exponent, f"{of} exponent")
        self.flow = None if flow is None else number_or_law(flow, (), f"{of} flow [1/s]")

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {} if self.flow is None else {"amount": InternalState(1.0)}

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        assert self.flow is not None
        return {"amount": jnp.asarray(evaluated(self.flow, t, motion), motion.system.dtype)}

    @property
    def conserves_energy(self) -> bool:
        return self.flow is None

    def strength(self, t: Number, motion: Motion, *args: Any) -> Scalar:
        amount = args[0]["amount"] if args else 1.0
        pressure = self.pressure * (amount * self._compression(motion.configuration)) ** self.exponent
        return -(pressure - self.ambient) * self.area

    def potential_energy(self, configuration: Configuration, *args: Any) -> Scalar:
        if args:
            return super().potential_energy(configuration, *args)
        logarithm = jnp.log(self._compression(configuration))
        x = (self.exponent - 1.0) * logarithm
        near = jnp.abs(x) < SMALL
        growth = jnp.where(near, 1.0 + x / 2.0, jnp.expm1(x) / jnp.where(near, 1.0, x))
        expansion = self.area * (self.extent(configuration) - self.free_length)
        return self.pressure * self._free_volume * logarithm * growth + self.ambient * expansion

    @property
    def _free_volume(self):
        return self.area * (self.free_length - self.closed)

    def _compression(self, configuration):
        """V₀ / V."""
        return (self.free_length - self.closed) / (self.extent(configuration) - self.closed)


SMALL = 1e-8  # up to which a series of two terms is exact to rounding
