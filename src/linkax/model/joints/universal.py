import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint
from linkax.spatial.rotations import compose, rotation_about_first_axis
from linkax.xla.arrays import Array


class Universal(TableJoint):
    """A Cardan joint: the child turns about the parent's h¹, and then about its own h².

    Coordinates: the two angles [rad], right-handed about h¹ and h², in (−π, π] where
    the joint is cut. No pair of angles is singular.
    """

    speed_units = ("rad", "rad")
    angular_subspace = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    linear_subspace = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    locked_rotations = ((0, 1),)
    aligned_axes = ()
    locked_translations = (0, 1, 2)

    __init__ = TableJoint.__init__

    @staticmethod
    def rotation(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
        c, s = jnp.cos(coordinates[1]), jnp.sin(coordinates[1])
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        about_second = jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
        return compose(rotation_about_first_axis(coordinates[0]), about_second)

    @staticmethod
    def angular_subspace_at(coordinates: Float[Array, "2"]) -> Float[jax.Array, "2 3"]:
        c, s = jnp.cos(coordinates[0]), jnp.sin(coordinates[0])
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        return jnp.stack([one, zero, zero, zero, c, s]).reshape(2, 3)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "2"]:
        first = jnp.arctan2(rotation[2, 1], rotation[1, 1])
        return jnp.stack([first, jnp.arctan2(rotation[0, 2], rotation[0, 0])])
