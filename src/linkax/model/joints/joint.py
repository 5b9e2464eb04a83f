"""What every joint type says of itself."""

import abc
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from linkax.model.bodies import GROUND, Frame, Ground, RigidBody
from linkax.model.numbers import Constant, unit_axis, value
from linkax.spatial.rotations import frame_about_axis


class AbstractJoint(eqx.Module):
    """A joint between a frame on a parent and a frame on a child body.

    The two frames coincide in orientation at coordinate zero. The joint's axes h¹, h², h³ are
    fixed in each of them, h¹ along `axis`, which is given in the parent's frame. Coordinates
    and speeds are those of the child relative to the parent.

    A joint type is this class with its static facts filled in. In the spanning tree it moves
    the child by `rotation` and `displacement`, both in joint axes, with speeds along
    `angular_subspace` and `linear_subspace`. Cut, it locks `locked_rotations` and
    `locked_translations` (Table 1 of the paper), and `measure` reads its coordinates.
    """

    # Units of the coordinates, one for each: "rad" or "m".
    coordinate_units: ClassVar[tuple[str, ...]]
    # Columns of the motion subspace in joint axes, angular and linear part.
    angular_subspace: ClassVar[tuple[tuple[float, float, float], ...]]
    linear_subspace: ClassVar[tuple[tuple[float, float, float], ...]]
    # Pairs (i, j), counted from 0, of axes that stay orthogonal: parent's hⁱ and child's hʲ.
    locked_rotations: ClassVar[tuple[tuple[int, int], ...]]
    # Axes, counted from 0, that point the same way on both; locked rotations alone allow a flip.
    aligned_axes: ClassVar[tuple[int, ...]]
    # Axes of the parent, counted from 0, along which the frames do not separate.
    locked_translations: ClassVar[tuple[int, ...]]

    name: str = eqx.field(static=True)
    parent: Frame
    child: Frame
    axis: Constant | Float[Array, "3"]
    cut: bool = eqx.field(static=True)

    def __init__(self, name: str, parent, child, axis, *, cut: bool = False):
        """**Arguments:**

        - `name`: unique in the mechanism.
        - `parent`, `child`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`.
        - `axis`: h¹ in the parent's frame: "x", "-y", …, three numbers (both part of the
          structure), or a JAX array (traced). Need not be normalised.
        - `cut`: keep this joint out of the spanning tree; it must close a loop.
        """
        if not isinstance(name, str) or not name:
            raise ValueError(f"joint name is {name!r}; give a non-empty string")
        self.name = name
        self.parent = _frame(parent, f"joint {name!r}: parent")
        self.child = _frame(child, f"joint {name!r}: child")
        if self.parent.body == self.child.body:
            raise ValueError(f"joint {name!r} connects body {self.parent.body!r} with itself; give two bodies")
        self.axis = unit_axis(axis, f"joint {name!r}: axis")
        self.cut = bool(cut)

    @property
    def num_coordinates(self) -> int:
        """Number of coordinates, and of speeds."""
        return len(self.coordinate_units)

    def frames(self):
        """The joint's axes as columns, in the parent's and in the child's body axes."""
        axes = frame_about_axis(value(self.axis))
        return value(self.parent.rotation) @ axes, value(self.child.rotation) @ axes

    @staticmethod
    @abc.abstractmethod
    def rotation(coordinates: Float[Array, " n"]) -> Float[Array, "3 3"]:
        """Axes of the child's frame in those of the parent's, as columns."""

    @staticmethod
    @abc.abstractmethod
    def displacement(coordinates: Float[Array, " n"]) -> Float[Array, "3"]:
        """Origin of the child's frame from that of the parent's, in joint axes [m]."""

    @staticmethod
    @abc.abstractmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[Array, " n"]:
        """Coordinates from the child's axes and origin, both in joint axes of the parent."""


def _frame(place, what) -> Frame:
    if isinstance(place, Ground):
        return GROUND.at([0.0, 0.0, 0.0])
    if isinstance(place, RigidBody):
        return place.at([0.0, 0.0, 0.0])
    if isinstance(place, Frame):
        return place
    raise ValueError(f"{what} is {place!r}; give a body, body.at(...), or lx.GROUND")
