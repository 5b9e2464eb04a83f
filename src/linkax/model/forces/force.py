"""Force elements, and gravity. Others are in `joint_forces`, `point_forces` and `ropes`."""

import abc
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import Frame
from linkax.model.elements import AbstractElement, Configuration, Motion, System, Time
from linkax.model.forces.internal_states import InternalState, States, by_name, joined_rates, shapes_of
from linkax.model.functions import MISTAKES, of_element
from linkax.model.numbers import Vector, number
from linkax.xla.arrays import Array, Scalar


class Load(NamedTuple):
    """Forces and moments that a force element applies.

    - `force`: on each body, at its centre of mass, in ground axes [N], shape (n_b, 3).
    - `moment`: on each body, about its centre of mass, in ground axes [N m], shape (n_b, 3).
    - `joint_force`: along each speed of the tree [N m or N], shape (n_v,).
    """

    force: Float[jax.Array, "bodies 3"]
    moment: Float[jax.Array, "bodies 3"]
    joint_force: Float[jax.Array, " speeds"]

    @staticmethod
    def none(system: System) -> "Load":
        """Make a load of zeros for `motion.system`."""
        vectors = jnp.zeros((system.topology.num_bodies, 3), system.dtype)
        return Load(vectors, vectors, jnp.zeros(system.topology.num_speeds, system.dtype))

    def plus(self, other: "Load") -> "Load":
        """Add another load."""
        return Load(*(a + b for a, b in zip(self, other, strict=True)))


GIVE_LOAD = "give a linkax.Load, made by motion.point_load, motion.joint_load or Load.none(motion.system)"


class AbstractForce(AbstractElement):
    """A force element. To make your own, subclass it and define `load`.

    A field `name: str = equinox.field(static=True)`, if it has one, is unique among joints, constraints and forces, and
    names it in `Solution.force`, `length` and `work`. Its other fields that hold numbers are traced. `motion` is a
    `linkax.Motion`: it tells where all bodies are and how they move at one instant, and makes loads on points and
    along joints. `motion.system` has the mechanism's numbers in the order of its bodies.

    A load with a kink or a jump needs a `switch`, which is zero there, and takes the side as a last argument:
    `load(t, motion, on)`. Steps then end at the switch, and derivatives are right across it.

    An element with internal states, such as a current, names them in `states`, and has `rates`. All functions of
    (t, motion) then take the values of the states next, {name: value}: `load(t, motion, states)`, and
    `potential_energy(configuration, states)`. They are integrated with the motion, see `Solution.states`.
    """

    _open = AbstractElement._open | {
        "states", "rates", "load", "switch", "has_switch", "strength", "potential_energy", "needs_coordinate",
        "conserves_energy", "exhausted",
    }  # fmt: skip

    @property
    def states(self) -> Mapping[str, InternalState]:
        """Internal states by name, each a `linkax.InternalState`; none by default."""
        return {}

    def rates(self, t: Time, motion: Motion, states: States, *args: Any) -> States:
        """Compute the rates of the internal states, {name: rate}, in their units per second."""
        raise ValueError(f"{self.display_name} has internal states, and no rates; define rates(t, motion, states)")

    @property
    def itself(self) -> "AbstractForce":
        """The element, also of one that is bound to its states."""
        return self

    @property
    def needs_coordinate(self) -> bool:
        """Whether it reads coordinates of its joints, besides their speeds."""
        return False

    @property
    def display_name(self) -> str:
        if name := given_name(self):
            return f"{type(self).__name__} {name!r}"
        return described(type(self).__name__, [repr(name) for name in self.joints] or named(self.frames))

    @property
    def conserves_energy(self) -> bool:
        """Whether all of its work is the fall of its potential energy, whatever its numbers."""
        return False

    def pressed_through(self, configuration: Configuration) -> Any:
        """Whether it has let bodies through each other, so that no motion leads on; never by default."""
        return False

    def exhausted(self, configuration: Configuration) -> str:
        """Say why no motion may lead on from a configuration, where a run has failed; an empty string by default."""
        return ""

    def strength(self, t: Time, motion: Motion, *args: Any) -> Any:
        """Compute what `Solution.force` reads: one number, or three in ground axes; takes what `load` takes.

        Springs, dampers and ropes have their pull [N], what acts along a joint its force on the child [N m or N].

        **Raises:** `ValueError` where an element does not define it.
        """
        raise ValueError(f"{self.display_name} does not say which force it has; define strength(t, motion) for it")

    @abc.abstractmethod
    def load(self, t: Time, motion: Motion, *args: Any, **kwargs: Any) -> Load:
        """Compute the load at time t [s].

        With a `switch` it takes a last argument `on`: whether the switch is positive. A step that adapts keeps `on`
        from where it begins, so that the load goes on smoothly a little past zero.
        """

    def switch(self, t: Time, motion: Motion, *args: Any) -> Scalar | None:
        """Compute a number that changes sign where the load has a kink or jumps; None for a smooth load.

        In any unit. The motion must go through zero there, and not be pushed back from both sides. Where the load is
        zero on one side, give there how far the motion is from it, and no rates, which hide it from long steps.
        """
        return None

    @property
    def has_switch(self) -> bool:
        """Whether its load has a kink or jumps; by default whether its class defines `switch`."""
        return type(self).switch is not AbstractForce.switch

    def separation(self, configuration: Configuration) -> Scalar | None:
        """How far it is from where it may act, in the unit of its switch; None where the switch alone tells.

        For elements whose switch is also negative where bodies part fast, which tells nothing of what is ahead.
        """
        return None

    def switched(self, t: Time, motion: Motion) -> Float[jax.Array, ""]:
        """Compute the switch and check it.

        **Raises:** `ValueError` for a switch that raises, or is not one number that depends on the motion.
        """
        try:
            found = self.switch(t, motion)
        except MISTAKES as error:
            raise self._ended("switch", error, self.switch, (t, motion)) from error
        if not isinstance(found, jax.Array) or found.shape != () or not jnp.issubdtype(found.dtype, jnp.floating):
            raise ValueError(
                f"{self.display_name}: its switch is {found!r}; give one number that depends on the motion"
            )
        return found

    def side(self, t: Time, motion: Motion) -> tuple[Any, ...]:
        """Compute what `load` takes besides t and motion: whether the switch is positive, where there is one."""
        return (self.switched(t, motion) > 0.0,) if self.has_switch else ()

    def applied(self, t: Time, motion: Motion, on: Any = None) -> Load:
        """Compute the load and check it; `on`: see `load`, by default whether the switch is positive now.

        **Raises:** `ValueError` for a load that raises, is no `Load`, or has parts of another shape or type; for an
        element with internal states, whose values are not known.
        """
        if self.states:
            raise ValueError(f"{self.display_name} has internal states, which only runs and their solutions know")
        side = self._held_side(t, motion, on)
        try:
            found = self.load(t, motion, *side)
        except MISTAKES as error:
            raise self._ended("load", error, self.load, (t, motion, *side)) from error
        whole = Load.none(motion.system)
        if not isinstance(found, Load):
            raise ValueError(f"{self.display_name}: its load is {found!r}; {GIVE_LOAD}")
        for name, part, right in zip(Load._fields, found, whole, strict=True):
            shape, dtype = jnp.shape(part), jnp.result_type(part)
            if shape != right.shape or not jnp.issubdtype(dtype, jnp.floating):
                raise ValueError(
                    f"{self.display_name}: {name} of its load has shape {shape} and type {dtype}, not {right.shape} "
                    f"and {right.dtype}; {GIVE_LOAD}"
                )
        return jax.tree.map(lambda part, right: jnp.asarray(part, right.dtype), found, whole)

    def state_rates(self, t: Time, motion: Motion, on: Any = None) -> Float[jax.Array, " n"]:
        """Compute the rates of all internal states and check them; none for an element without."""
        return jnp.zeros(0, motion.system.dtype)

    def _held_side(self, t, motion, on):
        return self.side(t, motion) if on is None or not self.has_switch else (on,)

    def _ended(self, what, error, function, arguments):
        """What to raise where the load, the switch or the rates have raised an error."""
        return of_element(self.display_name, what, error, function, arguments)

    def potential_energy(self, configuration: Configuration, *args: Any) -> Scalar:
        """Compute the potential energy [J]; zero for an element without one."""
        return jnp.zeros((), configuration.system.dtype)


class Bound(AbstractForce):
    """A force element at values of its internal states, (n,): to the equations of motion, one without any."""

    element: AbstractForce
    values: Float[Array, " n"]

    @property
    def itself(self) -> AbstractForce:
        return self.element

    @property
    def named(self) -> States:
        """The values by the names of the states."""
        return by_name(shapes_of(self.element.states), self.values)

    @property
    def display_name(self) -> str:
        return self.element.display_name

    @property
    def conserves_energy(self) -> bool:
        return self.element.conserves_energy

    @property
    def has_switch(self) -> bool:
        return self.element.has_switch

    def extent(self, configuration: Configuration) -> Any:
        return self.element.extent(configuration)

    def strength(self, t: Time, motion: Motion, *args: Any) -> Any:
        return self.element.strength(t, motion, self.named, *args)

    def load(self, t: Time, motion: Motion, *args: Any) -> Load:
        return self.element.load(t, motion, self.named, *args)

    def switch(self, t: Time, motion: Motion) -> Scalar | None:
        return self.element.switch(t, motion, self.named)

    def separation(self, configuration: Configuration) -> Scalar | None:
        return self.element.separation(configuration)

    def pressed_through(self, configuration: Configuration) -> Any:
        return self.element.pressed_through(configuration)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.element.potential_energy(configuration, self.named)

    def state_rates(self, t: Time, motion: Motion, on: Any = None) -> Float[jax.Array, " n"]:
        arguments = t, motion, *self._held_side(t, motion, on)
        try:
            found = self.element.rates(t, motion, self.named, *arguments[2:])
        except MISTAKES as error:
            raise self._ended("rates", error, self.element.rates, arguments) from error
        return joined_rates(self.element.states, found, self.display_name, motion.system.dtype)

    def _ended(self, what, error, function, arguments):
        t, motion, *side = arguments
        return super()._ended(what, error, getattr(self.element, what), (t, motion, self.named, *side))


def given_name(force: AbstractForce) -> str | None:
    """The name that a force element was given."""
    return getattr(force, "name", None)


def described(kind: str, of: list[str]) -> str:
    """Name an element in errors by its kind and what it acts on."""
    return f"{kind} on {' and '.join(of)}" if of else kind


def named(frames: Iterable[Frame]) -> list[str]:
    """Name the bodies of frames in errors."""
    return [f"body {frame.body!r}" for frame in frames]


class Gravity(AbstractForce):
    """Uniform gravity.

    **Arguments:** `acceleration`: that of free fall, in ground axes [m/s²], shape (3,).
    """

    acceleration: Float[Array, "3"]

    def __init__(self, acceleration: Vector) -> None:
        self.acceleration = number(acceleration, (3,), "Gravity: acceleration [m/s²]")

    @property
    def conserves_energy(self) -> bool:
        return True

    def load(self, t: Time, motion: Motion) -> Load:
        none = Load.none(motion.system)
        return none._replace(force=motion.system.mass[:, None] * self.acceleration)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        weights = configuration.system.mass[:, None] * self.acceleration
        return -jnp.sum(weights * configuration.world_center_of_mass())
