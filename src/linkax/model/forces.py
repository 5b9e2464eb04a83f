"""Force elements: what acts on a mechanism besides its joints."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.model.numbers import number


class Load(NamedTuple):
    """What force elements apply.

    - `force`: on each body, at its centre of mass, in ground axes [N], shape (n_b, 3).
    - `moment`: on each body, about its centre of mass, in ground axes [N m], shape (n_b, 3).
    - `joint_force`: along each speed of the tree [N m or N], shape (n_v,).
    """

    force: Float[Array, "n_b 3"]
    moment: Float[Array, "n_b 3"]
    joint_force: Float[Array, " n_v"]

    @staticmethod
    def none(system) -> "Load":
        vectors = jnp.zeros((system.topology.num_bodies, 3), system.dtype)
        return Load(vectors, vectors, jnp.zeros(system.topology.num_coordinates, system.dtype))


class AbstractForce(eqx.Module):
    """A force element; a user's own is a subclass.

    `motion` is a `linkax.equations.Motion`, all bodies' poses and twists at one instant, and
    `motion.system` the mechanism's numbers in the order of its bodies.
    """

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints whose coordinate this element acts along; they go into the spanning tree."""
        return ()

    @abc.abstractmethod
    def load(self, t, motion) -> Load:
        """What the element applies at time t [s]."""

    def potential_energy(self, configuration):
        """Potential energy [J]; zero for an element that has none."""
        return jnp.zeros((), configuration.system.dtype)


class Gravity(AbstractForce):
    """Uniform gravity: `acceleration` of free fall in ground axes [m/s²], shape (3,)."""

    acceleration: Float[Array, "3"]

    def __init__(self, acceleration):
        self.acceleration = number(acceleration, (3,), "Gravity: acceleration [m/s²]")

    def load(self, t, motion):
        none = Load.none(motion.system)
        return none._replace(force=motion.system.mass[:, None] * self.acceleration)

    def potential_energy(self, configuration):
        weights = configuration.system.mass[:, None] * self.acceleration
        return -jnp.sum(weights * configuration.world_center_of_mass())


class JointTorque(AbstractForce):
    """A constant torque [N m], or force [N] on a slide, along a joint with one coordinate.

    It acts on the child, and its opposite on the parent.
    """

    joint: str = eqx.field(static=True)
    torque: Float[Array, ""]

    def __init__(self, joint: str, torque):
        if not isinstance(joint, str):
            raise ValueError(f"JointTorque: joint is {joint!r}; give the name of a joint")
        self.joint = joint
        self.torque = number(torque, (), f"JointTorque on {joint!r}: torque [N m or N]")

    @property
    def joints(self):
        return (self.joint,)

    def load(self, t, motion):
        topology = motion.system.topology
        along = np.zeros(topology.num_coordinates)
        along[topology.coordinates[self.joint]] = 1.0
        none = Load.none(motion.system)
        return none._replace(joint_force=self.torque * jnp.asarray(along, motion.system.dtype))
