"""Joints whose motion and rows are tabulated: the paper's Table 1."""

import abc
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.joints.joint import AbstractJoint, RelativeMotion
from linkax.spatial.rotations import rotation_about_first_axis
from linkax.xla.arrays import Array, Scalar, ScalarLike


class TableJoint(AbstractJoint):
    """A joint with a motion subspace that is constant, or nearly so, and rows of its own where it is cut.

    In the spanning tree it turns the child by `rotation` and moves it along `linear_subspace`, both in joint axes. Cut,
    it locks `locked_rotations` and `locked_translations` (Table 1 of the paper), and `measure` reads its coordinates. A
    type without numbers of its own sets `__init__ = AbstractJoint.__init__`; otherwise type checkers take its fields
    for arguments.
    """

    # Columns of the motion subspace in joint axes of the parent, angular and linear part. With an
    # `angular_subspace_at` the angular part is that at coordinate zero.
    angular_subspace: ClassVar[tuple[tuple[float, float, float], ...]]
    linear_subspace: ClassVar[tuple[tuple[float, float, float], ...]]
    # Whether the linear part is multiplied by `parameter`.
    is_screw: ClassVar[bool] = False
    # Angular part of a joint whose axes turn with its own coordinates: (coordinates) -> (n, 3).
    angular_subspace_at: ClassVar[Callable[[Array], jax.Array] | None] = None
    # All of the motion of a joint that moves with other coordinates than its own, see `RelativeMotion`.
    motion: ClassVar[RelativeMotion | None] = None
    # Pairs (i, j), counted from 0, of axes that stay orthogonal: parent's hⁱ and child's hʲ.
    locked_rotations: ClassVar[tuple[tuple[int, int], ...]]
    # Axes, counted from 0, that point the same way on both; locked rotations alone allow a flip.
    aligned_axes: ClassVar[tuple[int, ...]]
    # Axes of the parent, counted from 0, along which the frames do not separate.
    locked_translations: ClassVar[tuple[int, ...]]
    # One row more, of h₁ⁱ·h₂ʲ for these pairs and h₁ⁱ·s/ℓ for these axes together, by `combined`.
    combined_rotations: ClassVar[tuple[tuple[int, int], ...]] = ()
    combined_translations: ClassVar[tuple[int, ...]] = ()

    __init__ = AbstractJoint.__init__

    @property
    def kind(self) -> "type[TableJoint]":
        return type(self)

    @property
    def parameters(self) -> None:
        return None

    @property
    def length_estimate(self) -> ScalarLike:
        return 0.0

    @property
    def parameter(self) -> ScalarLike:
        """A length [m] that its rows or its motion need, such as a screw's pitch [m/rad]."""
        return 0.0

    def transform(self, coordinates: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        along = np.array(self.linear_subspace).reshape(-1, 3)
        moved = coordinates[self.has_quaternion * 1 :] @ along
        return self.rotation(coordinates), moved * self.parameter if self.is_screw else moved

    @staticmethod
    @abc.abstractmethod
    def rotation(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
        """Compute the child's axes in those of the parent, as columns, from the coordinates."""

    @staticmethod
    @abc.abstractmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[Array, " n"]:
        """Read the coordinates from the child's axes and origin, both in joint axes of the parent."""

    @staticmethod
    def combined(
        rotations: Float[Array, " r"], translations: Float[Array, " t"], parameter: Scalar
    ) -> Float[jax.Array, ""]:
        """Combine h₁ⁱ·h₂ʲ and h₁ⁱ·s/ℓ into one row; `parameter` is the joint's own, in units of ℓ."""
        raise NotImplementedError


def hinged(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
    """Rotate about h¹ by the first coordinate."""
    return rotation_about_first_axis(coordinates[0])


def unturned(coordinates: Float[Array, " n"]) -> Float[jax.Array, "3 3"]:
    """Do not rotate."""
    return jnp.eye(3, dtype=coordinates.dtype)
