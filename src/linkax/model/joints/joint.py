"""What a joint type defines."""

import abc
import dataclasses
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.numbers import Axis, Constant, perpendicular_axes, require_bool, unit_axis, value
from linkax.model.terms import Term
from linkax.spatial.rotations import frame_about_axis, rotation_about_first_axis
from linkax.xla.arrays import Array, Scalar, ScalarLike


@dataclasses.dataclass(frozen=True)
class RelativeMotion(abc.ABC):
    """The motion of a joint in the tree, as a pure function that JAX differentiates."""

    @abc.abstractmethod
    def __call__(self, coordinates: Float[Array, " n"], parameters: Float[Array, " k"]) -> Float[jax.Array, "4 4"]:
        """Compute the child's frame in the parent's, in joint axes, (4, 4), see `linkax.spatial.screws`.

        Joints with the same motion may have fewer coordinates than others; their last ones are then given as zero.
        """


@dataclasses.dataclass(frozen=True)
class JointKind:
    """What a topology keeps of a joint in the tree that has a `RelativeMotion`, compared by value.

    Its attributes are those that other joints have as class attributes, see `AbstractJoint`.
    """

    name: str
    motion: RelativeMotion
    speed_units: tuple[str, ...]

    has_quaternion: ClassVar[bool] = False
    is_screw: ClassVar[bool] = False
    # Never cut, so without rows.
    combined_rotations: ClassVar[tuple[tuple[int, int], ...]] = ()
    combined_translations: ClassVar[tuple[int, ...]] = ()

    @property
    def __name__(self) -> str:
        """Its name, as of a class."""
        return self.name


class AbstractJoint(eqx.Module):
    """A joint between a frame on a parent and a frame on a child body.

    Both frames have the same orientation at coordinate zero. The joint's axes h¹, h², h³ are fixed in each of
    them, with h¹ along `axis`, given in the parent's frame. Coordinates and speeds are those of the child relative to
    the parent: turns first, then displacements.

    A joint type is a subclass that fills in the class attributes. In the spanning tree it turns the child by
    `rotation` and moves it along `linear_subspace`, both in joint axes. Cut, it locks `locked_rotations` and
    `locked_translations` (Table 1 of the paper), and `measure` reads its coordinates. A type without numbers of its
    own sets `__init__ = AbstractJoint.__init__`; otherwise type checkers take its fields for arguments.
    """

    # Units of the speeds, one for each: "rad" or "m" (per second).
    speed_units: ClassVar[tuple[str, ...]]
    # Coordinates begin with a unit quaternion, whose rate is the angular velocity of the first three speeds.
    has_quaternion: ClassVar[bool] = False
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
    # False for a type that only closes loops.
    can_carry: ClassVar[bool] = True

    name: str = eqx.field(static=True)
    parent: Frame
    child: Frame
    axis: Constant | Float[Array, "3"]
    second_axis: Constant | Float[Array, "3"] | None
    cut: bool = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        parent: BodyOrFrame,
        child: BodyOrFrame,
        axis: Axis,
        *,
        second_axis: Axis | None = None,
        cut: bool = False,
    ) -> None:
        """**Arguments:**

        - `name`: unique in the mechanism.
        - `parent`, `child`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
        - `axis`: h¹ in the parent's frame: a name "x", "-y", … or three numbers, which are structure, or a JAX
          array, which is traced. Its length is any but zero.
        - `second_axis`: h², given likewise, at a right angle to h¹. By default, where h¹ is a coordinate axis, h²
          is the next one in cyclic order: z for y, -z for -y.
        - `cut`: keep this joint out of the spanning tree; it must close a loop.

        **Raises:** `ValueError` for an empty name, one body as both, an axis of length zero, and axes that are not
        at a right angle.
        """
        if not isinstance(name, str) or not name:
            raise ValueError(f"joint name is {name!r}; give a non-empty string")
        self.name = name
        self.parent = frame_of(parent, f"joint {name!r}: parent")
        self.child = frame_of(child, f"joint {name!r}: child")
        if self.parent.body == self.child.body:
            raise ValueError(f"joint {name!r} connects body {self.parent.body!r} with itself; give two bodies")
        self.axis = unit_axis(axis, f"joint {name!r}: axis")
        self.second_axis = None
        if second_axis is not None:
            what = f"joint {name!r}: second_axis"
            self.axis, self.second_axis = perpendicular_axes(self.axis, second_axis, what)
        self.cut = require_bool(cut, f"joint {name!r}: cut")

    @property
    def num_coordinates(self) -> int:
        """Number of coordinates: one for each speed, and one more with a quaternion."""
        return len(self.speed_units) + self.has_quaternion

    @property
    def kind(self) -> "type[AbstractJoint] | JointKind":
        """What a topology keeps of this joint: its class, or a `JointKind`."""
        return type(self)

    @property
    def driven_by(self) -> tuple[Term, ...] | None:
        """Terms whose coordinates move it, in the order that its `motion` reads; None where only its own do."""
        return None

    @property
    def parameters(self) -> Float[Array, " k"] | None:
        """Numbers that its `motion` needs."""
        return None

    @property
    def length_estimate(self) -> ScalarLike:
        """Estimate of how far its `motion` takes the child from the parent [m]."""
        return 0.0

    @property
    def parameter(self) -> Scalar | None:
        """A length [m] that its rows or its motion need, such as a screw's pitch [m/rad], or None."""
        return None

    def frames(self) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Return h¹, h², h³ as columns, in the parent's and in the child's body axes."""
        second = None if self.second_axis is None else value(self.second_axis)
        axes = frame_about_axis(value(self.axis), second)
        return value(self.parent.rotation) @ axes, value(self.child.rotation) @ axes

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
