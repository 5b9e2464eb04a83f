"""Constraints besides those of cut joints: any of one's own, couplings of joints, drives."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.attached import Attached, BodyPose, Moving
from linkax.model.bodies import Frame
from linkax.model.elements import AbstractElement, Time
from linkax.model.functions import MISTAKES, Law, of_element
from linkax.model.names import ByName
from linkax.model.numbers import Number, number
from linkax.model.terms import Combination, Term, TermLike, term
from linkax.xla.arrays import Array, Scalar

# What a row of each unit is one of: 1, or a power of the mechanism's length.
POWERS_OF_LENGTH = {"": 0, "rad": 0, "m": 1, "m²": 2}


class AbstractConstraint(AbstractElement):
    """Equations g(t, q) = 0 between bodies and joints. To make your own, subclass it and define `residual`.

    JAX derives all else: the rows J = ∂g/∂q, the term γ of accelerations, and the forces of the multipliers. What
    it attaches to are the frames among its fields, and the joints that `joints` names, which go into the spanning tree.
    Its other fields that hold numbers are traced.

    `Solution.reaction` of its name is its multiplier μ, or an array of them, (n_t, k): a force [N] for a row in metres,
    a moment [N m] for one in radians. They act as the generalised force Jᵀμ, along growing g.

    A constraint on speeds that no constraint on places is behind, as of a skate or a wheel that rolls, is a `slip`:
    speeds that vanish. `units` are () then, unless there is a residual too, and its multipliers come last.

    - `units`: of the rows, one for each number of the residual: "m", "rad", "m²", or "" for a plain number.
    - `slip_units`: likewise of the slip, "m" for m/s.
    - `is_driven`: whether the residual depends on time.
    """

    _open = AbstractElement._open | {"units", "slip_units", "is_driven", "residual", "slip"}

    units: ClassVar[tuple[str, ...]] = ("m",)
    slip_units: ClassVar[tuple[str, ...]] = ()
    is_driven: ClassVar[bool] = False

    name: str = eqx.field(static=True)

    def residual(self, t: Time, attached: Attached) -> Scalar | Float[Array, " k"]:
        """Compute g at time t [s]: one number, or (k,), twice differentiable by JAX.

        **Arguments:** `attached`: where its bodies and joints are; see `linkax.Attached`.
        """
        raise ValueError(f"{self.display_name} defines no residual; define one, or say `units = ()` where it has none")

    def slip(self, t: Time, moving: Moving) -> Scalar | Float[Array, " k"]:
        """Compute speeds that vanish: one number, or (k,), linear in velocities, differentiable by JAX.

        **Arguments:** `moving`: how its bodies and joints move; see `linkax.Moving`.
        """
        raise ValueError(f"{self.display_name} defines no slip; define one, or leave slip_units out")

    @property
    def num_rows(self) -> int:
        """Number of its rows, those of slip included."""
        return len(self.units) + len(self.slip_units)

    @property
    def display_name(self) -> str:
        return f"{type(self).__name__.lower()} {self.name!r}"

    @property
    def frames(self) -> tuple[Frame, ...]:
        fields = [getattr(self, field.name) for field in dataclasses.fields(self)]
        leaves = jax.tree.leaves(fields, is_leaf=lambda leaf: isinstance(leaf, Frame))
        return tuple(leaf for leaf in leaves if isinstance(leaf, Frame))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints whose coordinates it reads."""
        return ()

    @property
    def terms(self) -> tuple[Term, ...]:
        return tuple(Term(name, None) for name in self.joints)

    def row_scales(self, length: Scalar, slides: Callable[[Term], bool]) -> list[Scalar]:
        """Compute one unit of each row in radians and lengths of the mechanism.

        **Arguments:** `length`: of the mechanism [m]; `slides`: whether the coordinate of a term is in metres.
        """
        return [length ** POWERS_OF_LENGTH[unit] for unit in (*self.units, *self.slip_units)]

    def attached(
        self, poses: Mapping[str, BodyPose], coordinates: Mapping[str, Array], quaternions: tuple[str, ...]
    ) -> Attached:
        """Make what the residual reads; what else it asks for is refused by name."""
        named = (ByName(poses, f"body of {self.display_name}"), ByName(coordinates, f"joint of {self.display_name}"))
        return Attached(*named, quaternions)

    def checked_residual(self, t: Time, attached: Attached) -> Float[Array, " k"]:
        """Compute the residual and check it.

        **Raises:** `ValueError` for a residual that raises, or has another shape than `units`.
        """
        return self._checked("residual", self.residual, self.units, t, attached)

    def checked_slip(self, t: Time, moving: Moving) -> Float[Array, " k"]:
        """Compute the slip and check it likewise."""
        return self._checked("slip", self.slip, self.slip_units, t, moving)

    def _checked(self, what, function, units, *arguments):
        _, attached = arguments
        dtype = jnp.result_type(*jax.tree.leaves(attached))
        if not units:
            return jnp.zeros(0, dtype)
        try:
            found = jnp.asarray(function(*arguments))
        except MISTAKES as error:
            raise of_element(self.display_name, what, error, function, arguments) from error
        count = len(units)
        if found.shape not in ((count,), () if count == 1 else (count,)):
            raise ValueError(
                f"{self.display_name}: its {what} has shape {found.shape}, and units {units} are {count}; give one "
                "unit for each of its numbers"
            )
        return found.reshape(count).astype(dtype)

    def check_residual(self, coordinates: Mapping[str, int]) -> None:
        """Evaluate residual and slip for their shapes, and for whether they depend on time.

        **Arguments:** `coordinates`: how many each of its joints has.

        **Raises:** `ValueError` as `checked_residual` does, and for a residual that reads t without `is_driven`.
        """
        unmoved = BodyPose(jnp.eye(3), jnp.zeros(3), jnp.zeros(3))
        poses = {frame.body: unmoved for frame in self.frames}
        moving = self.attached(poses, {name: jnp.zeros(coordinates[name]) for name in self.joints}, ()).still()
        rows = lambda t: (self.checked_residual(t, moving), self.checked_slip(t, moving))
        traced = jax.make_jaxpr(rows)(0.0).jaxpr
        (time,) = traced.invars
        reads = any(time is variable for step in traced.eqns for variable in step.invars)
        if reads and not self.is_driven:
            raise ValueError(f"{self.display_name}: its residual or slip reads t; say `is_driven = True` in its class")

    def held(self, t: Number, unless: Any = False) -> "AbstractConstraint":
        """Keep the residual of time t at all times, except where `unless`, which may be traced."""
        return HeldConstraint(self, t, unless) if self.is_driven else self


class HeldConstraint(AbstractConstraint):
    """A constraint at a time t at which it stays, except where `unless`."""

    constraint: AbstractConstraint
    t: Scalar
    unless: Any

    def __init__(self, constraint: AbstractConstraint, t: Number, unless: Any) -> None:
        self.name, self.constraint, self.t, self.unless = constraint.name, constraint, jnp.asarray(t), unless

    @property
    def units(self) -> tuple[str, ...]:
        return self.constraint.units

    @property
    def slip_units(self) -> tuple[str, ...]:
        return self.constraint.slip_units

    @property
    def is_driven(self) -> bool:
        return self.unless is not False

    @property
    def display_name(self) -> str:
        return self.constraint.display_name

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.constraint.frames

    @property
    def joints(self) -> tuple[str, ...]:
        return self.constraint.joints

    def residual(self, t: Number, attached: Attached) -> Scalar | Float[Array, " k"]:
        return self.constraint.residual(self._at(t), attached)

    def slip(self, t: Number, moving: Moving) -> Scalar | Float[Array, " k"]:
        return self.constraint.slip(self._at(t), moving)

    def _at(self, t):
        return self.t + jnp.where(self.unless, t - self.t, 0.0)


class CoordinateConstraint(AbstractConstraint):
    """A relation between coordinates of joints in the tree, those of its `terms`."""

    units = ("",)

    @property
    def joints(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(along.joint for along in self.terms))


class LinearConstraint(CoordinateConstraint):
    """A linear relation between coordinates of joints in the tree: their combination = right side."""

    combination: Combination

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.combination.terms

    @abc.abstractmethod
    def right_side(self, t: Number) -> Scalar:
        """Compute the right side at time t [s]."""

    def residual(self, t: Number, attached: Attached) -> Scalar:
        return self.combination.of(attached.coordinate) - self.right_side(t)

    def row_scales(self, length: Scalar, slides: Callable[[Term], bool]) -> list[Scalar]:
        return [self.combination.largest(lambda along: length if slides(along) else 1.0)]


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
        if not isinstance(coefficients, Mapping):
            raise ValueError(f"coupling {name!r}: coefficients are {coefficients!r}; give {{joint: factor, ...}}")
        self.combination = Combination(coefficients, f"coupling {name!r}: coefficients")
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

    is_driven = True

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
        self.combination = Combination({term(joint, what): 1.0}, what)
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

    def right_side(self, t: Number) -> Scalar:
        if self.motion is not None:
            return self.motion(t)
        assert self.speed is not None
        assert self.start is not None
        return self.start + self.speed * t


def checked_name(name: Any, what: str) -> str:
    """Check the name of a constraint."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"{what} name is {name!r}; give a non-empty string")
    return name
