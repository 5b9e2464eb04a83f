import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint, hinged
from linkax.spatial.rotations import angle_about_first_axis
from linkax.xla.arrays import Array


class Planar(TableJoint):
    """A plate on a table: the child slides in the plane across h¹, and turns about h¹.

    Coordinates: angle [rad] from the parent's h² to the child's, right-handed about h¹, and the
    distances [m] of the child's frame from the parent's along the parent's h² and h³. Where the
    joint is cut the angle is in (−π, π].

    Between bodies of a planar mechanism that other joints hold, it only measures where `cut=True` keeps it out of the
    tree: `lx.Planar("pose", lx.GROUND, platform, axis="z", cut=True)` has the platform's angle, x and y as
    coordinates, to hold in `lx.assemble`, to guess, or to read by `solution.joint("pose")`.
    """

    speed_units = ("rad", "m", "m")
    angular_subspace = ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    linear_subspace = ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    locked_rotations = ((0, 2), (0, 1))
    aligned_axes = (0,)
    locked_translations = (0,)

    __init__ = TableJoint.__init__

    rotation = staticmethod(hinged)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        return jnp.stack([angle_about_first_axis(rotation), separation[1], separation[2]])
