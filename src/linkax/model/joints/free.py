import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.joints.table_joint import TableJoint
from linkax.spatial.quaternions import from_rotation_matrix, rotation_matrix
from linkax.xla.arrays import Array


class Free(TableJoint):
    """No constraint: the child moves freely, and its motion is measured from the parent.

    Coordinates: unit quaternion (w, x, y, z) of the child's frame in the parent's, and the position
    [m] of its origin in the parent's frame. Speeds: angular velocity relative to the parent
    [rad/s], and velocity of the child's origin seen from the parent [m/s], both in axes of the
    parent's frame. Where the joint is cut, w ≥ 0.

    Between bodies that other joints hold, it only measures: `cut=True` keeps it out of the tree. Its coordinates can
    then be held, guessed and read like those of any joint:

    ```python
    arm, wrist = lx.rod("arm", length=1.0, mass=1.0), lx.rod("wrist", length=0.3, mass=0.2)
    joints = [
        lx.Revolute("shoulder", lx.GROUND, arm.at("base"), axis="z"),
        lx.Revolute("elbow", arm.at("tip"), wrist.at("base"), axis="z"),
        lx.Free("hand", lx.GROUND, wrist.at("tip"), cut=True),
    ]
    robot = lx.Mechanism([arm, wrist], joints)
    state = lx.assemble(robot, {("hand", 3): 0.8, ("hand", 4): 0.7})  # x and y; speeds count from 0
    ```
    """

    speed_units = ("rad", "rad", "rad", "m", "m", "m")
    has_quaternion = True
    angular_subspace = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), *3 * ((0.0, 0.0, 0.0),))
    linear_subspace = (*3 * ((0.0, 0.0, 0.0),), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    locked_rotations = ()
    aligned_axes = ()
    locked_translations = ()

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, *, cut: bool = False) -> None:
        super().__init__(name, parent, child, "x", cut=cut)

    @staticmethod
    def rotation(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
        return rotation_matrix(coordinates[:4])

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "7"]:
        return jnp.concatenate([from_rotation_matrix(rotation), separation])
