"""Forces along joints: torques on hinges, forces on slides, and their opposites on the parent."""

import abc
from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax.numpy as jnp

from linkax.model.elements import Configuration, Motion
from linkax.model.forces.force import AbstractForce, Load
from linkax.model.functions import Law, evaluated, number_or_law
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, zero_or_more
from linkax.model.terms import Term, TermLike, term
from linkax.xla.arrays import Scalar


class AlongJoint(AbstractForce):
    """A torque, or a force on a slide, along one speed of a joint; its opposite acts on the parent."""

    name: str | None = eqx.field(static=True)
    joint: Term = eqx.field(static=True)

    @property
    def terms(self) -> tuple[Term, ...]:
        return (self.joint,)

    @abc.abstractmethod
    def strength(self, t: Number, motion: Motion, *args: Any) -> Scalar:
        """Compute the torque or force along the joint, on the child [N m or N]."""

    def load(self, t: Number, motion: Motion, *args: Any) -> Load:
        return motion.joint_load(self.joint, self.strength(t, motion, *args))


class JointTorque(AlongJoint):
    """A torque [N m], or a force [N] on a slide, along a joint, on the child; its opposite acts on the parent.

    **Arguments:**

    - `joint`: a joint's name, or (name, index) for one of several speeds.
    - `torque`: a number, or a function (t, motion) ↦ number, where `motion` is a `linkax.Motion`. What the
      function may read is as for `linkax.Drive`.
    - `name`: see `linkax.AbstractForce`.
    """

    torque: Scalar | Law

    def __init__(
        self, joint: TermLike, torque: Number | Callable[[Any, Any], Number], *, name: str | None = None
    ) -> None:
        self.name = optional_name(name, "JointTorque")
        self.joint = term(joint, "JointTorque")
        self.torque = number_or_law(torque, (), f"{self.display_name}: torque [N m or N]")

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return evaluated(self.torque, t, motion)


class JointSpring(AlongJoint):
    """A linear spring along a joint: −stiffness × (coordinate − free).

    Its angle counts turns. Where its joint closes a loop, a massless body is put between the joint and its child for
    that.

    **Arguments:** `joint`: a name, or (name, index); `stiffness` [N m/rad or N/m]; `free`: the
    coordinate where it is unstrained [rad or m]; `name`, see `linkax.AbstractForce`.
    """

    stiffness: Scalar
    free: Scalar

    def __init__(self, joint: TermLike, stiffness: Number, free: Number = 0.0, *, name: str | None = None) -> None:
        self.name = optional_name(name, "JointSpring")
        self.joint = term(joint, "JointSpring")
        self.stiffness = number(stiffness, (), f"{self.display_name}: stiffness [N m/rad or N/m]")
        self.free = number(free, (), f"{self.display_name}: free [rad or m]")

    @property
    def needs_coordinate(self) -> bool:
        return True

    @property
    def conserves_energy(self) -> bool:
        return True

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return -self.stiffness * motion.configuration.joint_displacement(self.joint, self.free)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.stiffness * configuration.joint_displacement(self.joint, self.free) ** 2 / 2.0


class JointDamper(AlongJoint):
    """Viscous damping along a joint: −damping × speed.

    **Arguments:** `joint`: a name, or (name, index); `damping` [N m s/rad or N s/m]; `name`, see
    `linkax.AbstractForce`.
    """

    damping: Scalar

    def __init__(self, joint: TermLike, damping: Number, *, name: str | None = None) -> None:
        self.name = optional_name(name, "JointDamper")
        self.joint = term(joint, "JointDamper")
        self.damping = number(damping, (), f"{self.display_name}: damping [N m s/rad or N s/m]")

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return -self.damping * motion.joint_rate(self.joint)


class JointFriction(AlongJoint):
    """Coulomb friction along a joint, regularised: −torque × tanh(speed / scale).

    Below `scale` it is nearly viscous, so a joint at rest under a load creeps; at 3 × scale it has 99.5 % of
    `torque`. The smaller the scale, the stiffer the motion.

    **Arguments:** `joint`: a name, or (name, index); `torque` [N m or N]; `scale` [rad/s or m/s]; `name`,
    see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a negative torque, or a scale that is not positive.
    """

    torque: Scalar
    scale: Scalar

    def __init__(self, joint: TermLike, torque: Number, scale: Number, *, name: str | None = None) -> None:
        self.name = optional_name(name, "JointFriction")
        self.joint = term(joint, "JointFriction")
        self.torque = zero_or_more(torque, f"{self.display_name}: torque [N m or N]")
        self.scale = positive(scale, f"{self.display_name}: scale [rad/s or m/s]")

    def strength(self, t: Number, motion: Motion) -> Scalar:
        return -self.torque * jnp.tanh(motion.joint_rate(self.joint) / self.scale)


class JointInertia(AlongJoint):
    """Inertia of a geared rotor along a joint: it adds inertia × speed² / 2 to the kinetic energy, and no more.

    A rotor with moment of inertia J that turns n times as fast as its joint has the inertia n² J. Its gyroscopic
    moments, in proportion to n J, are left out, and its mass belongs to the body that carries it. MuJoCo calls this
    armature, Drake reflected inertia. The force −inertia × acceleration acts on the child along the joint, its opposite
    on the parent; the joint's reaction is what remains, as with other forces along joints.

    Along a turn of a ball or of a free joint it is exact only where all three turns have the same inertia. Where its
    joint closes a loop, a massless body is put between the joint and its child, so that the speed counts as others do.

    **Arguments:** `joint`: a name, or (name, index); `inertia` [kg m² or kg]; `name`, see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a negative inertia.
    """

    inertia: Scalar

    def __init__(self, joint: TermLike, inertia: Number, *, name: str | None = None) -> None:
        self.name = optional_name(name, "JointInertia")
        self.joint = term(joint, "JointInertia")
        self.inertia = zero_or_more(inertia, f"{self.display_name}: inertia [kg m² or kg]")

    @property
    def conserves_energy(self) -> bool:
        return True

    def strength(self, t: Number, motion: Motion) -> NoReturn:
        raise ValueError(
            f"{self.display_name} has a force that follows from accelerations; read -inertia * "
            f"solution.joint_acceleration({self.joint.joint!r})"
        )

    def load(self, t: Number, motion: Motion) -> Load:
        return Load.none(motion.system)
