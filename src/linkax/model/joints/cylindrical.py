import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint, hinged
from linkax.spatial.rotations import angle_about_first_axis
from linkax.xla.arrays import Array


class Cylindrical(TableJoint):
    """A sleeve on a shaft: the child turns about h¹ and slides along it.

    Coordinates: angle [rad] from the parent's h² to the child's, right-handed about h¹, and
    distance [m] of the child's frame from the parent's along h¹. Where the joint is cut the
    angle is in (−π, π].
    """

    speed_units = ("rad", "m")
    angular_subspace = ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    linear_subspace = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    locked_rotations = ((0, 2), (0, 1))
    aligned_axes = (0,)
    locked_translations = (1, 2)

    __init__ = TableJoint.__init__

    rotation = staticmethod(hinged)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "2"]:
        return jnp.stack([angle_about_first_axis(rotation), separation[0]])
