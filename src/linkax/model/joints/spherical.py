import jax
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.joints.table_joint import TableJoint
from linkax.spatial.quaternions import from_rotation_matrix, rotation_matrix
from linkax.xla.arrays import Array


class Spherical(TableJoint):
    """A ball and socket: the child turns freely about the common origin of both frames.

    Coordinates: unit quaternion (w, x, y, z) of the child's frame in the parent's, (1, 0, 0, 0)
    where the two coincide. Speeds: angular velocity of the child relative to the parent [rad/s],
    in axes of the parent's frame. Where the joint is cut, w ≥ 0.
    """

    speed_units = ("rad", "rad", "rad")
    has_quaternion = True
    angular_subspace = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    linear_subspace = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    locked_rotations = ()
    aligned_axes = ()
    locked_translations = (0, 1, 2)

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, *, cut: bool = False) -> None:
        super().__init__(name, parent, child, "x", cut=cut)

    @staticmethod
    def rotation(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
        return rotation_matrix(coordinates)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "4"]:
        return from_rotation_matrix(rotation)
