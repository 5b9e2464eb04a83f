"""Controllers and sensors with internal states."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx

from linkax.model.elements import Motion
from linkax.model.forces.force import AbstractForce, Load
from linkax.model.forces.internal_states import InternalState, States
from linkax.model.forces.joint_forces import AlongJoint
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, require_type
from linkax.model.terms import TermLike, term
from linkax.xla.arrays import Scalar


class PIDController(AlongJoint):
    """A controller of a joint's coordinate q: the torque P e + I ∫ e dt − D w, with e = target − q.

    w is the joint's speed through a first-order filter, τ ẇ = q̇ − w, so that steps of the target make no impulse. Its
    states are "integral", ∫ e dt [rad s or m s], and "speed", w [rad/s or m/s].

    **Arguments:**

    - `joint`: a name, or (name, index).
    - `target`: [rad or m], a number, or a function (t, motion) ↦ number; see `linkax.JointTorque`.
    - `proportional`: P [N m/rad or N/m]. `integral`: I [N m/(rad s) or N/(m s)]. `derivative`: D [N m s/rad or N s/m].
    - `filter_time`: τ [s].
    - `name`: see `linkax.AbstractForce`.

    An angle counts turns, see `linkax.JointSpring`.

    **Raises:** `ValueError` for a filter time that is not positive.
    """

    target: Scalar | Law
    proportional: Scalar
    integral: Scalar
    derivative: Scalar
    filter_time: Scalar

    def __init__(
        self,
        joint: TermLike,
        target: Number | Callable[[Any, Any], Number],
        *,
        proportional: Number,
        integral: Number = 0.0,
        derivative: Number = 0.0,
        filter_time: Number = 1e-2,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "PIDController")
        self.joint = term(joint, "PIDController")
        of = f"{self.display_name}:"
        self.target = number_or_law(target, (), f"{of} target [rad or m]")
        self.proportional = number(proportional, (), f"{of} proportional [N m/rad or N/m]")
        self.integral = number(integral, (), f"{of} integral [N m/(rad s) or N/(m s)]")
        self.derivative = number(derivative, (), f"{of} derivative [N m s/rad or N s/m]")
        self.filter_time = positive(filter_time, f"{of} filter_time [s]")

    @property
    def needs_coordinate(self) -> bool:
        return True

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {"integral": InternalState(0.0, "rad s or m s"), "speed": InternalState(0.0, "rad/s or m/s")}

    def error(self, t: Number, motion: Motion) -> Scalar:
        """Compute target − q [rad or m]."""
        return -motion.configuration.joint_displacement(self.joint, evaluated(self.target, t, motion))

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        faster = (motion.joint_rate(self.joint) - states["speed"]) / self.filter_time
        return {"integral": self.error(t, motion), "speed": faster}

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        proportional = self.proportional * self.error(t, motion)
        return proportional + self.integral * states["integral"] - self.derivative * states["speed"]


class FirstOrderSensor(AbstractForce):
    """A sensor, or filter, that follows a signal s with a delay: τ ẏ = s − y. It applies no load.

    Its state "output" is y, which `solution.states(name)["output"]` reads. A controller that acts on what a sensor says
    is an element with both states, see `linkax.AbstractForce`.

    **Arguments:**

    - `signal`: a function (t, motion) ↦ number; see `linkax.JointTorque`.
    - `time_constant`: τ [s]. `initial`: y at the start. `unit`, `scale`: of the signal, see `linkax.InternalState`.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a signal that is no function, and for a time constant that is not positive.
    """

    name: str | None = eqx.field(static=True)
    signal: Law
    time_constant: Scalar
    initial: Scalar
    scale: Scalar
    unit: str = eqx.field(static=True)

    def __init__(
        self,
        signal: Callable[[Any, Any], Number],
        time_constant: Number,
        *,
        initial: Number = 0.0,
        unit: str = "",
        scale: Number = 1.0,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "FirstOrderSensor")
        of = f"{self.display_name}:"
        self.signal = Law(require_type(signal, Callable, f"{of} signal", GIVE_FUNCTION), (), f"{of} signal")
        self.time_constant = positive(time_constant, f"{of} time_constant [s]")
        self.initial = number(initial, (), f"{of} initial")
        self.scale = positive(scale, f"{of} scale")
        self.unit = require_type(unit, str, f"{of} unit", 'give text, such as "rad"')

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {"output": InternalState(self.initial, self.unit, scale=self.scale)}

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        return {"output": (self.signal(t, motion) - states["output"]) / self.time_constant}

    def load(self, t: Number, motion: Motion, states: States) -> Load:
        return Load.none(motion.system)


GIVE_FUNCTION = "give a function (t, motion) -> number"
