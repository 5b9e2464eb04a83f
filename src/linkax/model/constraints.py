"""Constraints besides those of cut joints: gears, ropes over sheaves, drives."""

import abc
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.elements import AbstractElement
from linkax.model.functions import Law, held_unless
from linkax.model.numbers import Number, number, require
from linkax.model.terms import Term, TermLike, term
from linkax.xla.arrays import Array, Scalar


class AbstractConstraint(AbstractElement):
    """One equation, value = right side. `Solution.reaction` of its name is its multiplier."""

    name: str = eqx.field(static=True)

    @property
    def display_name(self) -> str:
        return f"{type(self).__name__.lower()} {self.name!r}"

    @property
    def is_driven(self) -> bool:
        """Whether the right side depends on time."""
        return False

    @abc.abstractmethod
    def right_side(self, t: Number) -> Scalar:
        """Compute the right side at time t [s]."""

    def held(self, t: Number, unless: Any = False) -> "AbstractConstraint":
        """Keep the right side of time t at all times, except where `unless`, which may be traced."""
        return self


class LinearConstraint(AbstractConstraint):
    """A linear relation between coordinates of joints in the tree: Σ coefficient × coordinate = right side.

    - `related`: the terms of these coordinates.
    """

    related: tuple[Term, ...] = eqx.field(static=True)
    coefficients: Float[Array, " n"]

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.related


class Coupling(LinearConstraint):
    """A linear relation between joint coordinates, such as gears, a rack, or a rope over sheaves.

    `Coupling("gears", {"pinion": 2.0, "wheel": 1.0})` keeps 2 × pinion + wheel = 0. Its joints are in the spanning
    tree, so angles count whole turns. Its reaction is one number μ, and acts along each joint with coefficient × μ
    [N m or N].

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `coefficients`: {joint: factor of its coordinate [rad or m]}. For one of several coordinates the key is
      (joint, index), counted like the joint's speeds.
    - `offset`: the right side.

    **Raises:** `ValueError` without coefficients, or where all are zero.
    """

    offset: Scalar

    def __init__(
        self,
        name: str,
        coefficients: Mapping[str, Number] | Mapping[TermLike, Number],
        offset: Number = 0.0,
    ) -> None:
        self.name = checked_name(name, "coupling")
        if not isinstance(coefficients, Mapping) or not coefficients:
            raise ValueError(f"coupling {name!r}: coefficients are {coefficients!r}; give {{joint: factor, ...}}")
        self.related = tuple(term(key, f"coupling {name!r}") for key in coefficients)
        what = f"coupling {name!r}: coefficients"
        factors = number(list(coefficients.values()), (len(coefficients),), what)
        remedy = "all are zero; give a factor that is not zero"
        self.coefficients = require(factors, lambda x: (x != 0.0).any(), what, remedy)
        self.offset = number(offset, (), f"coupling {name!r}: offset")

    def right_side(self, t: Number) -> Scalar:
        return self.offset


class Drive(LinearConstraint):
    """A joint's coordinate as a given function of time, or at constant speed.

    `Drive("motor", "bearing", speed=6.0, start=0.3)` turns `bearing` at 6 rad/s, from 0.3 rad at t = 0.
    `Drive("motor", "bearing", lambda t: 0.3 * jnp.sin(t))` swings it. Its reaction, `solution.reaction("motor")`,
    is the driving torque [N m], or force [N] on a slide, along the joint; that of the joint itself has no such part.

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `joint`: a joint's name, or (name, index) for one of several coordinates, counted like speeds.
    - `motion`: t [s] ↦ coordinate [rad or m], twice differentiable by JAX. JAX arrays that it closes over are
      traced; all else that it reads is structure, and must not change later.
    - `speed`: [rad/s or m/s], in place of `motion`. `start`: the coordinate at t = 0 [rad or m], zero by default. Both
      are numbers of the mechanism: new ones compile nothing.

    **Raises:** `ValueError` for a function that does not return one number, for a wrong number, for neither `motion`
    nor `speed`, and for both.
    """

    motion: Law | None
    speed: Scalar | None
    start: Scalar | None

    def __init__(
        self,
        name: str,
        joint: TermLike,
        motion: Callable[[Any], Number] | None = None,
        *,
        speed: Number | None = None,
        start: Number | None = None,
    ) -> None:
        self.name = checked_name(name, "drive")
        what = f"drive {name!r}"
        self.related = (term(joint, what),)
        self.coefficients = np.ones(1)
        self.motion = self.speed = self.start = None
        if motion is None and speed is None:
            raise ValueError(f"{what} has no motion; give a function of time, lambda t: ..., or speed=")
        if motion is None:
            self.speed = number(speed, (), f"{what}: speed")
            self.start = number(0.0 if start is None else start, (), f"{what}: start")
            return
        if not callable(motion):
            raise ValueError(f"{what}: motion is {motion!r}; give a function of time, lambda t: ..., or speed=")
        for other, entry in (("speed", speed), ("start", start)):
            if entry is not None:
                raise ValueError(f"{what}: {other} is {entry!r}, and motion a function; give one of both")
        self.motion = Law(motion, (), what)
        jax.eval_shape(self.motion, jnp.zeros(()))

    @property
    def is_driven(self) -> bool:
        return True

    def right_side(self, t: Number) -> Scalar:
        if self.motion is not None:
            return self.motion(t)
        assert self.speed is not None
        assert self.start is not None
        return self.start + self.speed * t

    def held(self, t: Number, unless: Any = False) -> "Drive | Coupling":
        if unless is not False:
            return Drive(self.name, self.terms[0], held_unless(self.right_side, t, unless))
        return Coupling(self.name, {self.terms[0]: 1.0}, self.right_side(t))


def checked_name(name: Any, what: str) -> str:
    """Check the name of a constraint."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"{what} name is {name!r}; give a non-empty string")
    return name
