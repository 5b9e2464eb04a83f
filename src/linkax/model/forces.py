"""Force elements: what acts on a mechanism besides its joints."""

import abc
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import GROUND_NAME, BodyOrFrame, Frame, frame_of
from linkax.model.elements import AbstractElement, Configuration, Motion, System
from linkax.model.functions import Law, evaluated, number_or_law, raised
from linkax.model.numbers import Number, Vector, number, one_of, positive, zero_or_more
from linkax.model.terms import Term, TermLike, term
from linkax.spatial.vectors import dot
from linkax.xla.arrays import Array, Scalar

Axes = Literal["ground", "frame"]


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
        return _described(type(self).__name__, [repr(name) for name in self.joints] or _named(self.frames))

    @abc.abstractmethod
    def load(self, t: Number, motion: Motion) -> Load:
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


def _described(kind: str, of: list[str]) -> str:
    return f"{kind} on {' and '.join(of)}" if of else kind


def _named(frames: Iterable[Frame]) -> list[str]:
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


class _AlongJoint(AbstractForce):
    """A torque, or a force on a slide, along one speed of a joint, and its opposite on the parent."""

    joint: Term = eqx.field(static=True)

    @property
    def terms(self) -> tuple[Term, ...]:
        return (self.joint,)

    @abc.abstractmethod
    def torque_at(self, t: Number, motion: Motion) -> Scalar:
        """Along the joint, on the child [N m or N]."""

    def load(self, t: Number, motion: Motion) -> Load:
        return motion.joint_load(self.joint, self.torque_at(t, motion))


class JointTorque(_AlongJoint):
    """A torque [N m], or force [N] on a slide, along a joint; on the child, and its opposite on the parent.

    **Arguments:**

    - `joint`: a joint's name, or (name, index) for one of several speeds.
    - `torque`: a number, or a function (t, motion) ↦ number; what `motion` tells is in
      `linkax.Motion`. What the function reads is as for `linkax.Drive`.
    """

    torque: Scalar | Law

    def __init__(self, joint: TermLike, torque: Number | Callable[[Any, Any], Number]):
        self.joint = term(joint, "JointTorque")
        self.torque = number_or_law(torque, (), f"JointTorque on {self.joint.joint!r}: torque [N m or N]")

    def torque_at(self, t: Number, motion: Motion) -> Scalar:
        return evaluated(self.torque, t, motion)


class JointSpring(_AlongJoint):
    """A linear spring along a joint: −stiffness × (coordinate − free).

    At a joint that is cut (where all joints of a loop have springs, say) the angle is read in
    (−π, π] from `free`: the spring forgets whole turns.

    **Arguments:** `joint`: a name, or (name, index); `stiffness` [N m/rad or N/m]; `free`: the
    coordinate at which it is unstrained [rad or m].
    """

    stiffness: Scalar
    free: Scalar

    def __init__(self, joint: TermLike, stiffness: Number, free: Number = 0.0):
        self.joint = term(joint, "JointSpring")
        what = f"JointSpring on {self.joint.joint!r}"
        self.stiffness = number(stiffness, (), f"{what}: stiffness [N m/rad or N/m]")
        self.free = number(free, (), f"{what}: free [rad or m]")

    @property
    def needs_coordinate(self) -> bool:
        return True

    def torque_at(self, t: Number, motion: Motion) -> Scalar:
        return -self.stiffness * motion.configuration.joint_displacement(self.joint, self.free)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.stiffness * configuration.joint_displacement(self.joint, self.free) ** 2 / 2.0


class JointDamper(_AlongJoint):
    """Viscous damping along a joint: −damping × speed, `damping` in N m s/rad or N s/m."""

    damping: Scalar

    def __init__(self, joint: TermLike, damping: Number):
        self.joint = term(joint, "JointDamper")
        self.damping = number(damping, (), f"JointDamper on {self.joint.joint!r}: damping [N m s/rad or N s/m]")

    def torque_at(self, t: Number, motion: Motion) -> Scalar:
        return -self.damping * motion.joint_rate(self.joint)


class JointFriction(_AlongJoint):
    """Coulomb friction along a joint, regularised: −torque × tanh(speed / scale).

    Below `scale` [rad/s or m/s] it is nearly viscous, so that a joint at rest under a load creeps;
    at three scales it has 99.5 % of `torque` [N m or N]. The smaller the scale, the stiffer.

    **Raises:** `ValueError` for a negative torque, or a scale that is not positive.
    """

    torque: Scalar
    scale: Scalar

    def __init__(self, joint: TermLike, torque: Number, scale: Number):
        self.joint = term(joint, "JointFriction")
        what = f"JointFriction on {self.joint.joint!r}"
        self.torque = zero_or_more(torque, f"{what}: torque [N m or N]")
        self.scale = positive(scale, f"{what}: scale [rad/s or m/s]")

    def torque_at(self, t: Number, motion: Motion) -> Scalar:
        return -self.torque * jnp.tanh(motion.joint_rate(self.joint) / self.scale)


class _BetweenPoints(AbstractForce):
    """A force along the line between the origins of two frames."""

    first: Frame
    second: Frame

    @property
    def frames(self) -> tuple[Frame, ...]:
        return (self.first, self.second)

    @abc.abstractmethod
    def pull(self, motion: Motion) -> Float[Array, "3"]:
        """The force on the first point; its opposite acts on the second [N]."""

    def load(self, t: Number, motion: Motion) -> Load:
        force = self.pull(motion)
        return motion.point_load(self.first, force).plus(motion.point_load(self.second, -force))


def _unit(vector: Float[Array, "3"]) -> Float[jax.Array, "3"]:
    """The direction of a vector; zero for none."""
    square = dot(vector, vector)
    return jnp.where(square > 0.0, vector / jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


class Spring(_BetweenPoints):
    """A linear spring between two points; it pulls with stiffness × (distance − free_length).

    Where the points meet it has no direction, and a free length pushes nowhere.

    **Arguments:** `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`;
    `stiffness` [N/m]; `free_length` [m], zero or more.
    """

    stiffness: Scalar
    free_length: Scalar

    def __init__(self, first: BodyOrFrame, second: BodyOrFrame, stiffness: Number, free_length: Number = 0.0):
        self.first, self.second = _frames("Spring", first, second)
        self.stiffness = number(stiffness, (), f"{self.display_name}: stiffness [N/m]")
        self.free_length = zero_or_more(free_length, f"{self.display_name}: free_length [m]")

    def pull(self, motion: Motion) -> Float[Array, "3"]:
        along = motion.configuration.between(self.first, self.second)
        return self.stiffness * (along - self.free_length * _unit(along))

    def potential_energy(self, configuration: Configuration) -> Scalar:
        along = configuration.between(self.first, self.second)
        stretch = dot(along, _unit(along)) - self.free_length
        return self.stiffness * stretch**2 / 2.0


class Damper(_BetweenPoints):
    """Viscous damping between two points: pulls with `damping` [N s/m] × the rate of their distance.

    `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
    """

    damping: Scalar

    def __init__(self, first: BodyOrFrame, second: BodyOrFrame, damping: Number):
        self.first, self.second = _frames("Damper", first, second)
        self.damping = number(damping, (), f"{self.display_name}: damping [N s/m]")

    def pull(self, motion: Motion) -> Float[Array, "3"]:
        direction = _unit(motion.configuration.between(self.first, self.second))
        rate = dot(motion.point_velocity(self.second) - motion.point_velocity(self.first), direction)
        return self.damping * rate * direction


class _OnPoint(AbstractForce):
    """A vector on a point of a body, in ground axes or in those of the frame there."""

    point: Frame
    axes: Axes = eqx.field(static=True)

    def __init__(self, point: BodyOrFrame, axes: Axes):
        self.point = frame_of(point, f"{type(self).__name__}: point")
        if self.point.body == GROUND_NAME:
            raise ValueError(
                f"{self.display_name}: point is {point!r}, which nothing moves; give a point of another body"
            )
        self.axes = one_of(axes, ("ground", "frame"), f"{self.display_name}: axes")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return (self.point,)

    def _in_ground_axes(self, entry: Array | Law, t: Number, motion: Motion) -> Float[Array, "3"]:
        vector = evaluated(entry, t, motion)
        return motion.configuration.axes(self.point) @ vector if self.axes == "frame" else vector


class PointForce(_OnPoint):
    """A force on a point of a body.

    **Arguments:**

    - `point`: a body (its reference frame), or `body.at(...)`.
    - `force`: three numbers [N], or a function (t, motion) ↦ three numbers; see `JointTorque`.
    - `axes`: "ground" (default), or "frame": those of the frame at the point, which turn with it.
    """

    force: Float[Array, "3"] | Law

    def __init__(self, point: BodyOrFrame, force: Vector | Callable[[Any, Any], Vector], axes: Axes = "ground"):
        super().__init__(point, axes)
        self.force = number_or_law(force, (3,), f"{self.display_name}: force [N]")

    def load(self, t: Number, motion: Motion) -> Load:
        return motion.point_load(self.point, self._in_ground_axes(self.force, t, motion))


class PointMoment(_OnPoint):
    """A moment on a body; on a beam, on its section at the point.

    **Arguments:** like those of `PointForce`, with `moment`: three numbers [N m], or a function.
    """

    moment: Float[Array, "3"] | Law

    def __init__(self, point: BodyOrFrame, moment: Vector | Callable[[Any, Any], Vector], axes: Axes = "ground"):
        super().__init__(point, axes)
        self.moment = number_or_law(moment, (3,), f"{self.display_name}: moment [N m]")

    def load(self, t: Number, motion: Motion) -> Load:
        nothing = jnp.zeros(3, motion.system.dtype)
        return motion.point_load(self.point, nothing, self._in_ground_axes(self.moment, t, motion))


def _frames(kind: str, first: BodyOrFrame, second: BodyOrFrame) -> tuple[Frame, Frame]:
    ends = frame_of(first, f"{kind}: first point"), frame_of(second, f"{kind}: second point")
    if ends[0].body == ends[1].body:
        raise ValueError(f"{_described(kind, _named(ends[:1]))}: both points are on it; give points on two bodies")
    return ends
