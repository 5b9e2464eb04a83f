"""Force elements: what acts on a mechanism besides its joints."""

import abc
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import Frame
from linkax.model.elements import AbstractElement, Configuration, Motion, System
from linkax.model.functions import raised
from linkax.model.numbers import Number, Vector, number
from linkax.xla.arrays import Array, Scalar


class Load(NamedTuple):
    """What force elements apply.

    - `force`: on each body, at its centre of mass, in ground axes [N], shape (n_b, 3).
    - `moment`: on each body, about its centre of mass, in ground axes [N m], shape (n_b, 3).
    - `joint_force`: along each speed of the tree [N m or N], shape (n_v,).
    """

    force: Float[jax.Array, "bodies 3"]
    moment: Float[jax.Array, "bodies 3"]
    joint_force: Float[jax.Array, " speeds"]

    @staticmethod
    def none(system: System) -> "Load":
        vectors = jnp.zeros((system.topology.num_bodies, 3), system.dtype)
        return Load(vectors, vectors, jnp.zeros(system.topology.num_speeds, system.dtype))

    def plus(self, other: "Load") -> "Load":
        """Both together."""
        return Load(*(a + b for a, b in zip(self, other, strict=True)))


GIVE_LOAD = "give a linkax.Load, made by motion.point_load, motion.joint_load or Load.none(motion.system)"


class AbstractForce(AbstractElement):
    """A force element; a user's own is a subclass with a `load`.

    `motion` is a `linkax.Motion`: where all bodies are and how they move at one instant, and how
    loads on points and along joints are made. `motion.system` has the mechanism's numbers in the
    order of its bodies. Numbers that are fields are traced.

    One whose load has a kink or a jump has a `switch` too, which is zero there, and its load is told the side:
    `load(t, motion, on)`. Steps then end there, and derivatives are right across it.
    """

    @property
    def needs_coordinate(self) -> bool:
        """Whether it reads the coordinates of its joints, and not their speeds alone."""
        return False

    @property
    def display_name(self) -> str:
        return described(type(self).__name__, [repr(name) for name in self.joints] or named(self.frames))

    @abc.abstractmethod
    def load(self, t: Number, motion: Motion, *args: Any, **kwargs: Any) -> Load:
        """What the element applies at time t [s].

        Where it has a `switch`, a third argument `on` says whether that is positive. A step that adapts keeps it as it
        is where the step begins, so that the load goes on smoothly a little past zero.
        """

    def switch(self, t: Number, motion: Motion) -> Scalar | None:
        """A number whose sign changes where the load has a kink or jumps; of magnitude one, like a strain.

        The motion must go through zero there, and not be pushed back from both sides. None where there is none.
        """
        return None

    def switched(self, t: Number, motion: Motion) -> Float[jax.Array, ""]:
        """The switch, checked for what a user's own class may do wrong."""
        try:
            found = self.switch(t, motion)
        except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
            raise ValueError(f"{self.display_name}: its switch raises {raised(error)}") from error
        if not isinstance(found, jax.Array) or found.shape != () or not jnp.issubdtype(found.dtype, jnp.floating):
            raise ValueError(
                f"{self.display_name}: its switch is {found!r}; give one number that depends on the motion"
            )
        return found

    def applied(self, t: Number, motion: Motion, on: Any = None) -> Load:
        """The load, checked for what a user's own class may do wrong; `on`: see `load`, by default as it is."""
        side = ()
        if has_switch(self):
            side = (self.switched(t, motion) > 0.0 if on is None else on,)
        try:
            found = self.load(t, motion, *side)
        except (ArithmeticError, AttributeError, LookupError, TypeError) as error:
            raise ValueError(f"{self.display_name}: its load raises {raised(error)}") from error
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
        return found

    def potential_energy(self, configuration: Configuration) -> Scalar:
        """Potential energy [J]; zero for an element that has none."""
        return jnp.zeros((), configuration.system.dtype)


def has_switch(force: AbstractForce) -> bool:
    """Whether the load of a force element has a kink or jumps, see `AbstractForce.switch`."""
    return type(force).switch is not AbstractForce.switch


def described(kind: str, of: list[str]) -> str:
    return f"{kind} on {' and '.join(of)}" if of else kind


def named(frames: Iterable[Frame]) -> list[str]:
    return [f"body {frame.body!r}" for frame in frames]


class Gravity(AbstractForce):
    """Uniform gravity: `acceleration` of free fall in ground axes [m/s²], shape (3,)."""

    acceleration: Float[Array, "3"]

    def __init__(self, acceleration: Vector):
        self.acceleration = number(acceleration, (3,), "Gravity: acceleration [m/s²]")

    def load(self, t: Number, motion: Motion) -> Load:
        none = Load.none(motion.system)
        return none._replace(force=motion.system.mass[:, None] * self.acceleration)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        weights = configuration.system.mass[:, None] * self.acceleration
        return -jnp.sum(weights * configuration.world_center_of_mass())
