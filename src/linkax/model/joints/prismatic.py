from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint, unturned
from linkax.xla.arrays import Array


class Prismatic(TableJoint):
    """A slide: the child moves along h¹ without turning.

    Coordinate: distance [m] of the child's frame from the parent's along h¹.
    """

    speed_units = ("m",)
    angular_subspace = ((0.0, 0.0, 0.0),)
    linear_subspace = ((1.0, 0.0, 0.0),)
    locked_rotations = ((1, 2), (0, 2), (0, 1))
    aligned_axes = (0, 1, 2)
    locked_translations = (1, 2)

    __init__ = TableJoint.__init__

    rotation = staticmethod(unturned)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[Array, "1"]:
        return separation[:1]
