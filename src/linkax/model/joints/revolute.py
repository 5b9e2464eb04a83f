import jax
from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint, hinged
from linkax.spatial.rotations import angle_about_first_axis
from linkax.xla.arrays import Array


class Revolute(TableJoint):
    """A hinge: the child turns about h¹.

    Coordinate: angle [rad] from the parent's h² to the child's, right-handed about h¹; in (−π, π] where the
    joint is cut.
    """

    speed_units = ("rad",)
    angular_subspace = ((1.0, 0.0, 0.0),)
    linear_subspace = ((0.0, 0.0, 0.0),)
    locked_rotations = ((0, 2), (0, 1))
    aligned_axes = (0,)
    locked_translations = (0, 1, 2)

    __init__ = TableJoint.__init__

    rotation = staticmethod(hinged)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "1"]:
        return angle_about_first_axis(rotation)[None]
