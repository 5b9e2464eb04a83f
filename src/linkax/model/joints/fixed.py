import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.joints.table_joint import TableJoint, unturned
from linkax.xla.arrays import Array


class Fixed(TableJoint):
    """A weld: the child keeps its position and orientation on the parent. It has no coordinate."""

    speed_units = ()
    angular_subspace = ()
    linear_subspace = ()
    locked_rotations = ((1, 2), (0, 2), (0, 1))
    aligned_axes = (0, 1, 2)
    locked_translations = (0, 1, 2)

    rotation = staticmethod(unturned)

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, *, cut: bool = False) -> None:
        super().__init__(name, parent, child, "x", cut=cut)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "0"]:
        return jnp.zeros(0, separation.dtype)
