"""What a joint type defines."""

import abc
import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.elements import OpenToUsers
from linkax.model.functions import MISTAKES, of_element
from linkax.model.numbers import Axis, Constant, perpendicular_axes, require_bool, unit_axis, value
from linkax.model.terms import Term
from linkax.spatial.rotations import frame_about_axis
from linkax.spatial.vectors import length
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.tracing import concrete

ORTHONORMAL = 1e-8  # up to which axes count as such


@dataclasses.dataclass(frozen=True)
class RelativeMotion(abc.ABC):
    """The motion of a joint in the tree, as a pure function that JAX differentiates."""

    @property
    def has_quaternion(self) -> bool:
        """Whether its coordinates begin with a unit quaternion, see `AbstractJoint`."""
        return False

    @abc.abstractmethod
    def __call__(self, coordinates: Float[Array, " n"], parameters: Float[Array, " k"]) -> Float[jax.Array, "4 4"]:
        """Compute the child's frame in the parent's, in joint axes, (4, 4), see `linkax.spatial.screws`.

        Joints with the same motion may have fewer coordinates than others; their last ones are then given as zero.
        """


@dataclasses.dataclass(frozen=True)
class JointKind:
    """What a topology keeps of a joint in the tree that has a `RelativeMotion`, compared by value.

    Its attributes are those that other joints have as class attributes, see `linkax.model.joints.table_joint`.
    """

    name: str
    motion: RelativeMotion
    speed_units: tuple[str, ...]

    is_screw: ClassVar[bool] = False
    # Never cut, so without rows.
    combined_rotations: ClassVar[tuple[tuple[int, int], ...]] = ()
    combined_translations: ClassVar[tuple[int, ...]] = ()

    @property
    def __name__(self) -> str:
        """Its name, as of a class."""
        return self.name

    @property
    def has_quaternion(self) -> bool:
        """Whether its coordinates begin with a unit quaternion."""
        return self.motion.has_quaternion


class AbstractJoint(OpenToUsers):
    """A joint between a frame on a parent and a frame on a child body. To make your own, define `transform`.

    Both frames have the same orientation at coordinate zero. The joint's axes h¹, h², h³ are fixed in each of
    them, with h¹ along `axis`, given in the parent's frame; along "x" they are x, y, z. Coordinates and speeds are
    those of the child relative to the parent: turns first, then displacements.

    A joint type is a subclass with `speed_units` and a `transform`, from which JAX derives motion subspace and
    accelerations. Its fields that hold numbers are traced. Where it closes a loop, a massless body is put between it
    and its child, so that its coordinates count on. The reaction of a joint of one's own is all that it carries, its
    own force included.
    """

    # Units of the speeds, one for each: "rad" or "m" (per second).
    speed_units: ClassVar[tuple[str, ...]]
    # Coordinates begin with a unit quaternion, whose rate is the angular velocity of the first three speeds.
    has_quaternion: ClassVar[bool] = False
    _open = frozenset(
        {"speed_units", "has_quaternion", "can_carry", "transform", "length_estimate", "angular_subspace"}
        | {"linear_subspace", "name", "parent", "child", "axis", "second_axis", "cut"}
    )
    _elsewhere: ClassVar[str] = (
        "; its motion and loads are read by its name, as in solution.joint(name) and solution.reaction(name), and a "
        "torque or force along it is a linkax.JointTorque"
    )
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

    @abc.abstractmethod
    def transform(self, coordinates: Float[Array, " n"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Compute the child's frame in the parent's at coordinates [rad or m], twice differentiable by JAX.

        It may read the fields of its own class. With `has_quaternion` the first four coordinates are a unit quaternion
        (w, x, y, z), and the first three speeds its angular velocity in joint axes of the parent.

        **Returns:** its axes as columns, (3, 3), and its origin [m], (3,), both in joint axes of the parent.
        """

    @property
    def num_coordinates(self) -> int:
        """Number of coordinates: one for each speed, and one more with a quaternion."""
        return len(self.speed_units) + self.has_quaternion

    @property
    def kind(self) -> "type[AbstractJoint] | JointKind":
        """What a topology keeps of this joint: its class, where that says all, or a `JointKind`."""
        return JointKind(type(self).__name__, Transform.of(self), self.speed_units)

    @property
    def driven_by(self) -> tuple[Term, ...] | None:
        """Terms whose coordinates move it, in the order that its `motion` reads; None where only its own do."""
        return None

    @property
    def parameters(self) -> Float[Array, " k"] | None:
        """Numbers that its `motion` needs."""
        return own_numbers(self)

    @property
    def length_estimate(self) -> ScalarLike:
        """Estimate of how far it takes the child from the parent [m]; by default at coordinates of one."""
        return length(self.transform(self._at_one())[1])

    def check_transform(self) -> None:
        """Evaluate the transform.

        **Raises:** `ValueError` for one that raises, has another shape, or axes that are not orthonormal.
        """
        what, at = f"joint {self.name!r}", self._at_one()
        try:
            rotation, position = self.transform(at)
            shapes = jnp.shape(rotation), jnp.shape(position)
        except MISTAKES as error:
            raise of_element(what, "transform", error, self.transform, (at,)) from error
        if shapes != ((3, 3), (3,)):
            raise ValueError(f"{what}: its transform returns shapes {shapes}; give axes (3, 3) and an origin (3,)")
        known = concrete(rotation)
        if known is not None and not np.allclose(known.T @ known, np.eye(3), atol=ORTHONORMAL):
            raise ValueError(
                f"{what}: its transform returns axes {known.tolist()} at coordinates {np.asarray(at).tolist()}, which "
                "are not orthonormal; give those of a rotation, as columns"
            )

    def _at_one(self):
        """Coordinates of one, a quaternion of length one."""
        ones = jnp.ones(self.num_coordinates)
        return ones.at[:4].set(0.5) if self.has_quaternion else ones

    def frames(self) -> tuple[Float[Array, "3 3"], Float[Array, "3 3"]]:
        """Return h¹, h², h³ as columns, in the parent's and in the child's body axes."""
        second = None if self.second_axis is None else value(self.second_axis)
        axes = frame_about_axis(value(self.axis), second)
        return value(self.parent.rotation) @ axes, value(self.child.rotation) @ axes

    @property
    def angular_subspace(self) -> tuple[tuple[float, float, float], ...]:
        """Axes about which it can turn its child, in joint axes, as columns; by default any."""
        return tuple(map(tuple, np.eye(3)))

    @property
    def linear_subspace(self) -> tuple[tuple[float, float, float], ...]:
        """Directions in which it can move its child, likewise."""
        return tuple(map(tuple, np.eye(3)))


# What each joint has, besides what its own class adds.
COMMON = tuple(field.name for field in dataclasses.fields(AbstractJoint))


@dataclasses.dataclass(frozen=True)
class Transform(RelativeMotion):
    """The motion of a joint by its `transform`; parameters are the numbers among the fields of its own class.

    - `of_type`: its class. `static`: the names and values of fields that are no pytrees.
    - `structure`, `fixed`: the other fields as a pytree, and its leaves that are no numbers.
    - `shapes`: of the leaves that are numbers, None for others.
    """

    of_type: type[AbstractJoint]
    static: tuple[tuple[str, Any], ...]
    structure: Any
    fixed: tuple[Any, ...]
    shapes: tuple[tuple[int, ...] | None, ...]

    @property
    def has_quaternion(self) -> bool:
        return self.of_type.has_quaternion

    @staticmethod
    def of(joint: AbstractJoint) -> "Transform":
        """Take it from a joint."""
        static = tuple(_own_fields(joint, static=True).items())
        leaves, structure = jax.tree.flatten(_own_fields(joint, static=False))
        fixed = tuple(None if _is_number(leaf) else leaf for leaf in leaves)
        shapes = tuple(np.shape(leaf) if _is_number(leaf) else None for leaf in leaves)
        return Transform(type(joint), static, structure, fixed, shapes)

    def __call__(self, coordinates: Float[Array, " n"], parameters: Float[Array, " k"]) -> Float[jax.Array, "4 4"]:
        leaves, start = [], 0
        for fixed, shape in zip(self.fixed, self.shapes, strict=True):
            size = 0 if shape is None else int(np.prod(shape))
            leaves.append(fixed if shape is None else parameters[start : start + size].reshape(shape))
            start += size
        joint = object.__new__(self.of_type)
        for name, entry in (*self.static, *jax.tree.unflatten(self.structure, leaves).items()):
            object.__setattr__(joint, name, entry)
        rotation, position = (jnp.asarray(part, coordinates.dtype) for part in joint.transform(coordinates))
        found = jnp.eye(4, dtype=coordinates.dtype)
        return found.at[:3, :3].set(rotation).at[:3, 3].set(position)


def _own_fields(joint, static):
    """Fields of a joint's own class, by name: those that are static, or those that are pytrees."""
    own = [field for field in dataclasses.fields(joint) if field.name not in COMMON]
    return {field.name: getattr(joint, field.name) for field in own if field.metadata.get("static", False) == static}


def own_numbers(joint: AbstractJoint) -> Float[Array, " k"]:
    """Numbers among the fields of a joint's own class, in one array."""
    numbers = filter(_is_number, jax.tree.leaves(_own_fields(joint, static=False)))
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(jnp.asarray(leaf)) for leaf in numbers)])


def _is_number(leaf):
    return isinstance(leaf, float) or eqx.is_inexact_array(leaf)
