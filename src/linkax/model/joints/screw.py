import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.joints.table_joint import TableJoint, hinged
from linkax.model.numbers import Axis, Number, number, require
from linkax.spatial.rotations import angle_about_first_axis
from linkax.xla.arrays import Array, Scalar


class Screw(TableJoint):
    """A nut on a screw: the child turns about h¹ and advances along it by pitch × angle.

    Coordinate: angle [rad] from the parent's h² to the child's, right-handed about h¹. `pitch` [m/rad] is the
    advance for one radian, lead / 2π, positive for a right-handed thread. Cut, the joint may be on any turn of its
    thread, and its angle is in (−π, π].

    **Raises:** `ValueError` for a pitch of zero.
    """

    speed_units = ("rad",)
    angular_subspace = ((1.0, 0.0, 0.0),)
    linear_subspace = ((1.0, 0.0, 0.0),)
    is_screw = True
    locked_rotations = ((0, 2), (0, 1))
    aligned_axes = (0,)
    locked_translations = (1, 2)
    combined_rotations = ((1, 1), (2, 1))
    combined_translations = (0,)

    pitch: Scalar

    def __init__(
        self, name: str, parent: BodyOrFrame, child: BodyOrFrame, axis: Axis, pitch: Number, *, cut: bool = False
    ) -> None:
        super().__init__(name, parent, child, axis, cut=cut)
        what = f"joint {name!r}: pitch [m/rad]"
        self.pitch = require(number(pitch, (), what), lambda p: p != 0.0, what, "without advance, use lx.Revolute")

    @property
    def parameter(self) -> Scalar:
        return self.pitch

    rotation = staticmethod(hinged)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "1"]:
        return angle_about_first_axis(rotation)[None]

    @staticmethod
    def combined(
        rotations: Float[Array, " r"], translations: Float[Array, " t"], parameter: Scalar
    ) -> Float[jax.Array, ""]:
        angle = jnp.arctan2(rotations[1], rotations[0])
        turns = lax.stop_gradient(jnp.round((translations[0] / parameter - angle) / (2.0 * jnp.pi)))
        return translations[0] - parameter * (angle + 2.0 * jnp.pi * turns)
