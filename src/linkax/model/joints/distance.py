import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.joints.table_joint import TableJoint, unturned
from linkax.model.numbers import Number, positive
from linkax.xla.arrays import Array, Scalar


class Distance(TableJoint):
    """A massless rod with a ball at each end, or a rope that stays taut, between two points.

    It keeps the origins of two frames `length` apart and has no coordinate. It carries no body: each body needs
    other joints that connect it to ground. Its reaction on the child is a force along the line between the points,
    towards the parent where the rod is pulled.

    **Arguments:** `name`, unique among joints and constraints; `parent`, `child`: a body (its
    reference frame), `body.at(...)`, or `lx.GROUND`; `length` [m].

    **Raises:** `ValueError` for a length that is not positive.
    """

    speed_units = ()
    angular_subspace = ()
    linear_subspace = ()
    locked_rotations = ()
    aligned_axes = ()
    locked_translations = ()
    combined_translations = (0, 1, 2)
    can_carry = False

    length: Scalar

    rotation = staticmethod(unturned)

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, length: Number) -> None:
        super().__init__(name, parent, child, "x")
        remedy = "it must be positive; to join two points, use lx.Spherical"
        self.length = positive(length, f"distance {name!r}: length [m]", remedy)

    @property
    def parameter(self) -> Scalar:
        return self.length

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[jax.Array, "0"]:
        return jnp.zeros(0, separation.dtype)

    @staticmethod
    def combined(
        rotations: Float[Array, " r"], translations: Float[Array, " t"], parameter: Scalar
    ) -> Float[jax.Array, ""]:
        return (jnp.sum(translations * translations) / parameter - parameter) / 2.0
