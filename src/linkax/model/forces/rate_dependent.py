"""Friction and viscoelasticity that remember: LuGre's bristles, Maxwell's dashpot."""

from collections.abc import Mapping

import jax.numpy as jnp

from linkax.model.bodies import BodyOrFrame
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.internal_states import InternalState, States
from linkax.model.forces.joint_forces import AlongJoint
from linkax.model.forces.point_forces import BetweenPoints, two_points
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, require, zero_or_more
from linkax.model.terms import TermLike, term
from linkax.xla.arrays import Scalar


class LuGreFriction(AlongJoint):
    """Friction along a joint with stiction: the mean deflection z of bristles, ż = v − |v| z / z₀(v).

    The torque is −(σ₀ z + σ₁ ż + σ₂ v), with σ₀ z₀(v) = F_C + (F_S − F_C) exp(−(v / v_S)²). At rest under less than F_S
    the joint moves elastically, and does not creep away as with `linkax.JointFriction`; sliding steadily it has
    Stribeck's curve. Canudas de Wit, Olsson, Åström and Lischinsky, IEEE Transactions on Automatic Control 40, 1995.

    Its state is "deflection", z [rad or m]. Bristles are fast: √(σ₀ / m) chooses the steps where it is large.

    **Arguments:**

    - `joint`: a name, or (name, index).
    - `coulomb`: F_C [N m or N]. `static`: F_S [N m or N], no smaller. `stribeck_speed`: v_S [rad/s or m/s].
    - `stiffness`: σ₀ [N m/rad or N/m]. `damping`: σ₁ [N m s/rad or N s/m]. `viscous`: σ₂, likewise.
    - `deflection`: z at the start [rad or m].
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a number outside of what it can be.
    """

    coulomb: Scalar
    static: Scalar
    stribeck_speed: Scalar
    stiffness: Scalar
    damping: Scalar
    viscous: Scalar
    deflection: Scalar

    def __init__(
        self,
        joint: TermLike,
        *,
        coulomb: Number,
        static: Number,
        stribeck_speed: Number,
        stiffness: Number,
        damping: Number = 0.0,
        viscous: Number = 0.0,
        deflection: Number = 0.0,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "LuGreFriction")
        self.joint = term(joint, "LuGreFriction")
        of = f"{self.display_name}:"
        self.coulomb = positive(coulomb, f"{of} coulomb [N m or N]")
        no_less = lambda force: force >= self.coulomb
        what = f"{of} static [N m or N]"
        self.static = require(number(static, (), what), no_less, what, "it must be no smaller than coulomb")
        self.stribeck_speed = positive(stribeck_speed, f"{of} stribeck_speed [rad/s or m/s]")
        self.stiffness = positive(stiffness, f"{of} stiffness [N m/rad or N/m]")
        self.damping = zero_or_more(damping, f"{of} damping [N m s/rad or N s/m]")
        self.viscous = zero_or_more(viscous, f"{of} viscous [N m s/rad or N s/m]")
        self.deflection = number(deflection, (), f"{of} deflection [rad or m]")

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {"deflection": InternalState(self.deflection, "rad or m", scale=self.static / self.stiffness)}

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        speed = motion.joint_rate(self.joint)
        sliding = self.coulomb + (self.static - self.coulomb) * jnp.exp(-((speed / self.stribeck_speed) ** 2))
        return {"deflection": speed - self.stiffness * jnp.abs(speed) / sliding * states["deflection"]}

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        bristles = self.damping * self.rates(t, motion, states)["deflection"]
        return -(self.stiffness * states["deflection"] + bristles + self.viscous * motion.joint_rate(self.joint))


class MaxwellElement(BetweenPoints):
    """A spring in series with a damper, between two points: under a constant distance its pull relaxes to zero.

    The pull is F = stiffness × (distance − free_length − y), with ẏ = F / damping. With a `linkax.Spring` at its side
    it is the standard linear solid, with several of them a generalised Maxwell model. Its state is "creep", the
    damper's extension y [m]; its potential energy is that of its spring.

    **Arguments:** `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`; `stiffness` [N/m];
    `damping` [N s/m]; `free_length` [m]; `creep`: y at the start [m]; `scale`: a typical creep [m], see
    `linkax.InternalState`; `name`, see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a number outside of what it can be.
    """

    stiffness: Scalar
    damping: Scalar
    free_length: Scalar
    creep: Scalar
    scale: Scalar

    def __init__(
        self,
        first: BodyOrFrame,
        second: BodyOrFrame,
        stiffness: Number,
        damping: Number,
        free_length: Number = 0.0,
        *,
        creep: Number = 0.0,
        scale: Number = 1.0,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "MaxwellElement")
        self.first, self.second = two_points("MaxwellElement", first, second)
        of = f"{self.display_name}:"
        self.stiffness = number(stiffness, (), f"{of} stiffness [N/m]")
        self.damping = positive(damping, f"{of} damping [N s/m]")
        self.free_length = zero_or_more(free_length, f"{of} free_length [m]")
        self.creep = number(creep, (), f"{of} creep [m]")
        self.scale = positive(scale, f"{of} scale [m]")

    @property
    def states(self) -> Mapping[str, InternalState]:
        return {"creep": InternalState(self.creep, "m", scale=self.scale)}

    def rates(self, t: Number, motion: Motion, states: States) -> States:
        return {"creep": self.strength(t, motion, states) / self.damping}

    def strength(self, t: Number, motion: Motion, states: States) -> Scalar:
        return self.stiffness * self._stretch(motion.configuration, states)

    def potential_energy(self, configuration: Configuration, states: States) -> Scalar:
        return self.stiffness * self._stretch(configuration, states) ** 2 / 2.0

    def _stretch(self, configuration, states):
        return self.extent(configuration) - self.free_length - states["creep"]
