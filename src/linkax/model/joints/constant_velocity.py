import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.joints.joint import AbstractJoint
from linkax.spatial.quaternions import from_rotation_vector, rotation_matrix
from linkax.xla.arrays import Array


class ConstantVelocity(AbstractJoint):
    """A homokinetic joint, such as Rzeppa's: it bends in any direction, and hands on turns about h¹ unchanged.

    Coordinates: the components [rad] along h² and h³ of the rotation vector that turns the parent's axes into the
    child's, which has none along h¹; its length is the angle between the shafts, below π.
    """

    speed_units = ("rad", "rad")

    __init__ = AbstractJoint.__init__

    def transform(self, coordinates: Float[Array, "2"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        still = jnp.zeros_like(coordinates[:1])
        bent = rotation_matrix(from_rotation_vector(jnp.concatenate([still, coordinates])))
        return bent, jnp.zeros(3, coordinates.dtype)
