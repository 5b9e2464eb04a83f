"""Hydraulic cylinders and rotary actuators, with the pressures in their chambers as internal states."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp

from linkax.model.bodies import BodyOrFrame
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.actuators import Control
from linkax.model.forces.force import AbstractForce
from linkax.model.forces.internal_states import InternalState, States
from linkax.model.forces.joint_forces import AlongJoint
from linkax.model.forces.point_forces import BetweenPoints, two_points
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, require, zero_or_more
from linkax.model.terms import TermLike, term
from linkax.xla.arrays import Scalar


class _Chambers(AbstractForce):
    """Two chambers of oil behind a proportional valve, which push to and fro along a coordinate, the extent."""

    opening: Scalar | Law
    area_a: Scalar
    area_b: Scalar
    closed: Scalar
    stroke: Scalar
    valve: Scalar
    supply: Scalar
    tank: Scalar
    bulk_modulus: Scalar
    dead_volume: Scalar
    leakage: Scalar
    damping: Scalar
    laminar: Scalar
    pressure_a: Scalar
    pressure_b: Scalar
    units: ClassVar[tuple[str, str, str]]  # of the extent, the areas, the damping

    def _set(
        self, opening, areas, closed, stroke, valve, supply, tank, bulk_modulus, dead_volume, leakage, damping, laminar,
        pressures,
    ):  # fmt: skip
        """Check and set all but the name and what it acts on."""
        of = f"{self.display_name}:"
        along, area, damper = self.units
        self.opening = number_or_law(opening, (), f"{of} opening")
        what = f"{of} areas [{area}]"
        both = require(number(areas, (2,), what), lambda x: (x > 0.0).all(), what, "they must be positive")
        self.area_a, self.area_b = both[0], both[1]
        self.closed = number(closed, (), f"{of} closed [{along}]")
        self.stroke = positive(stroke, f"{of} stroke [{along}]")
        self.valve = zero_or_more(valve, f"{of} valve [m³/s/√Pa]")
        self.tank = number(tank, (), f"{of} tank [Pa]")
        self.supply = positive(supply, f"{of} supply [Pa]")
        self.bulk_modulus = positive(bulk_modulus, f"{of} bulk_modulus [Pa]")
        self.dead_volume = positive(dead_volume, f"{of} dead_volume [m³]")
        self.leakage = zero_or_more(leakage, f"{of} leakage [m³/s/Pa]")
        self.damping = zero_or_more(damping, f"{of} damping [{damper}]")
        self.laminar = positive(laminar, f"{of} laminar [Pa]")
        begin = (self.tank, self.tank) if pressures is None else number(pressures, (2,), f"{of} pressures [Pa]")
        self.pressure_a, self.pressure_b = begin[0], begin[1]

    @abc.abstractmethod
    def extent_rate(self, motion: Motion) -> Scalar:
        """Compute the rate of the extent [m/s or rad/s]."""

    @property
    def states(self) -> Mapping[str, InternalState]:
        begin = {"a": self.pressure_a, "b": self.pressure_b}
        return {name: InternalState(pressure, "Pa", scale=self.supply) for name, pressure in begin.items()}

    def volumes(self, configuration: Configuration) -> dict[str, Scalar]:
        """Compute the volumes of the chambers with their lines, "a" and "b" [m³]."""
        x = self.extent(configuration) - self.closed
        return {
            "a": self.dead_volume + self.area_a * x,
            "b": self.dead_volume + self.area_b * (self.stroke - x),
        }

    def exhausted(self, configuration: Configuration) -> str:
        x, stroke = float(self.extent(configuration) - self.closed), float(self.stroke)
        if 0.0 <= x <= stroke:
            return ""
        end, past = ("closed", -x) if x < 0.0 else ("closed + stroke", x - stroke)
        along, *_ = self.units
        return (
            f"The piston of {self.display_name} is {past:.3g} {along} beyond its end, {end}, where no oil is left to "
            "compress; stop it within its stroke, by a linkax.JointLimit, a linkax.Contact or its valve."
        )

    def flows(self, t: Number, motion: Motion, states: States) -> dict[str, Scalar]:
        """Compute the oil that flows into each chamber through the valve, "a" and "b", and from "a" to "b" past the
        piston, "leakage" [m³/s].
        """
        opening = evaluated(self.opening, t, motion)
        onward, back = jnp.maximum(opening, 0.0), jnp.maximum(-opening, 0.0)

        def through(open_to_supply, open_to_tank, pressure):
            filled, drained = self._root(self.supply - pressure), self._root(pressure - self.tank)
            return self.valve * (open_to_supply * filled - open_to_tank * drained)

        return {
            "a": through(onward, back, states["a"]),
            "b": through(back, onward, states["b"]),
            "leakage": self.leakage * (states["a"] - states["b"]),
        }

    def _root(self, drop):
        """The root of a pressure drop with its sign, linear near zero."""
        return drop / (drop**2 + self.laminar**2) ** 0.25

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        flows, volumes = self.flows(t, motion, states), self.volumes(motion.configuration)
        speed = self.extent_rate(motion)
        gain = {
            "a": flows["a"] - flows["leakage"] - self.area_a * speed,
            "b": flows["b"] + flows["leakage"] + self.area_b * speed,
        }
        return {name: self.bulk_modulus * gain[name] / volumes[name] for name in gain}

    def thrust(self, motion: Motion, states: States) -> Scalar:
        """Compute the push towards a larger extent [N or N m]."""
        return states["a"] * self.area_a - states["b"] * self.area_b - self.damping * self.extent_rate(motion)


class HydraulicCylinder(_Chambers, BetweenPoints):
    """A double-acting hydraulic cylinder between two points, fed through a proportional valve.

    Chamber A pushes the points apart, chamber B, on the side of the rod, pulls them together; x is the distance of the
    points less `closed`, and p the pressure of a chamber:

    - V_A = V₀ + A_A x, V_B = V₀ + A_B (stroke − x), pull p_B A_B − p_A A_A + damping × ẋ.
    - V_A ṗ_A = β (Q_A − A_A ẋ − c (p_A − p_B)), V_B ṗ_B = β (Q_B + A_B ẋ + c (p_A − p_B)).
    - At an opening u > 0, Q_A = K u √(p_S − p_A) and Q_B = −K u √(p_B − p_T); at u < 0 supply and tank are exchanged.
      Roots are rounded within `laminar` of zero, where the flow turns.

    Its states are "a" and "b", the pressures of the chambers [Pa]. As u passes zero, flows have a kink. Jelali and
    Kroll, Hydraulic Servo-systems (2003), ch. 4. Along a joint: `linkax.HydraulicActuator`.

    **Arguments:**

    - `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
    - `opening`: of the valve, u from −1 to 1, a number, or a function (t, motion) ↦ number; see `linkax.JointTorque`.
    - `areas`: (A_A, A_B) [m²]. `closed`: the distance of the points at x = 0 [m]; `stroke`: the largest x [m].
    - `valve`: K [m³/s/√Pa], the flow at u = 1 over the root of the pressure drop. `supply`, `tank`: p_S, p_T [Pa].
    - `bulk_modulus`: β [Pa]. `dead_volume`: V₀ of each chamber with its lines [m³]. `leakage`: c [m³/s/Pa].
    - `damping`: of the seals [N s/m]. `laminar` [Pa].
    - `pressures`: (p_A, p_B) at the start [Pa]; by default that of the tank.
    - `name`: see `linkax.AbstractForce`.

    The piston may leave the stroke: nothing stops it, and beyond the dead volume no state is finite. Pressures may fall
    below zero, as oil without cavitation would.

    **Raises:** `ValueError` for a number outside of what it can be.
    """

    units = ("m", "m²", "N s/m")

    def __init__(
        self,
        first: BodyOrFrame,
        second: BodyOrFrame,
        opening: Control,
        *,
        areas: tuple[Number, Number],
        closed: Number,
        stroke: Number,
        valve: Number,
        supply: Number,
        tank: Number = 0.0,
        bulk_modulus: Number = 1.4e9,
        dead_volume: Number,
        leakage: Number = 0.0,
        damping: Number = 0.0,
        laminar: Number = 1e4,
        pressures: tuple[Number, Number] | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "HydraulicCylinder")
        self.first, self.second = two_points("HydraulicCylinder", first, second)
        closed = zero_or_more(closed, f"{self.display_name}: closed [m]")
        self._set(
            opening, areas, closed, stroke, valve, supply, tank, bulk_modulus, dead_volume, leakage, damping, laminar,
            pressures,
        )  # fmt: skip

    def extent_rate(self, motion: Motion) -> Scalar:
        return self.distance_rate(motion)

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        return -self.thrust(motion, states)


class HydraulicActuator(_Chambers, AlongJoint):
    """A hydraulic cylinder along a slide, or a rotary actuator on a hinge, fed through a proportional valve.

    It is a `linkax.HydraulicCylinder` whose x is the joint's coordinate less `closed`: chamber A pushes the child
    towards larger coordinates, with the force or torque p_A A_A − p_B A_B − damping × ẋ. On a hinge, areas are volumes
    for each radian.

    **Arguments:** those of `linkax.HydraulicCylinder`, with

    - `joint`: a name, or (name, index), in place of the points.
    - `areas`: (A_A, A_B) [m², or m³/rad]. `closed`: the coordinate at x = 0 [m or rad]. `stroke` [m or rad].
    - `damping` [N s/m or N m s/rad].

    **Raises:** `ValueError` for a number outside of what it can be.
    """

    units = ("m or rad", "m² or m³/rad", "N s/m or N m s/rad")

    def __init__(
        self,
        joint: TermLike,
        opening: Control,
        *,
        areas: tuple[Number, Number],
        closed: Number,
        stroke: Number,
        valve: Number,
        supply: Number,
        tank: Number = 0.0,
        bulk_modulus: Number = 1.4e9,
        dead_volume: Number,
        leakage: Number = 0.0,
        damping: Number = 0.0,
        laminar: Number = 1e4,
        pressures: tuple[Number, Number] | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "HydraulicActuator")
        self.joint = term(joint, "HydraulicActuator")
        self._set(
            opening, areas, closed, stroke, valve, supply, tank, bulk_modulus, dead_volume, leakage, damping, laminar,
            pressures,
        )  # fmt: skip

    @property
    def needs_coordinate(self) -> bool:
        return True

    def extent(self, configuration: Configuration) -> Any:
        return configuration.joint_displacement(self.joint, 0.0)

    def extent_rate(self, motion: Motion) -> Scalar:
        return motion.joint_rate(self.joint)

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        return self.thrust(motion, states)
