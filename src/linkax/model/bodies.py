"""Rigid bodies and the frames on them."""

import abc
import copy
from collections.abc import Iterable, Mapping
from typing import Any, Literal, cast, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import (
    Constant,
    Matrix,
    Number,
    Vector,
    listed,
    namespace,
    number,
    numbers_of,
    one_of,
    require,
    require_type,
    rotation_matrix,
    value,
    zero_or_more,
)
from linkax.model.shapes import Shape, turned
from linkax.xla.arrays import Array, Scalar
from linkax.xla.tracing import concrete

GROUND_NAME = "ground"
OfInertia = Literal["box", "ellipsoid"]


class Frame(eqx.Module):
    """A frame fixed to a body, made by `body.at(...)`.

    - `body`: the name of the body.
    - `offset`: its origin in the body's reference frame [m], shape (3,), or (..., 3) of a batch of mechanisms.
    - `rotation`: its axes as columns, in the body's axes, shape (3, 3).
    """

    body: str = eqx.field(static=True)
    offset: Float[Array, "*batch 3"]
    rotation: Constant | Float[Array, "3 3"]


class AbstractBody(eqx.Module):
    """A body that joints and forces attach to."""

    @property
    @abc.abstractmethod
    def reference(self) -> Frame:
        """Its reference frame, for which the body itself stands where a frame is expected."""


class Ground(AbstractBody):
    """The fixed world, `lx.GROUND`. Joints attach to it, and nothing moves it."""

    @property
    def name(self) -> str:
        """The name that no other body may have."""
        return GROUND_NAME

    @property
    def reference(self) -> Frame:
        return self.at([0.0, 0.0, 0.0])

    def at(self, offset: Vector, rotation: Matrix | None = None) -> Frame:
        """Make a frame fixed to the ground.

        **Arguments:**

        - `offset`: [x, y, z] of its origin [m].
        - `rotation`: its axes as columns, in ground axes, shape (3, 3) (default: parallel).
        """
        return Frame(
            GROUND_NAME,
            number(offset, (3,), "offset of a frame on the ground"),
            rotation_matrix(rotation, "rotation of a frame on the ground"),
        )


GROUND = Ground()

BodyOrFrame = AbstractBody | Frame  # what a user may attach to: a body stands for its reference frame


class RigidBody(AbstractBody):
    """A rigid body, described in its own reference frame.

    **Arguments:**

    - `name`: unique in the mechanism.
    - `mass`: [kg], zero or more.
    - `center_of_mass`: [m], shape (3,).
    - `inertia`: inertia tensor about the centre of mass [kg m²], shape (3, 3), or its diagonal, shape (3,). A single
      number is the moment about z of a flat body, which is all that counts where it moves in the x-y plane; the other
      two are then half of it.
    - `frames`: named points `{"tip": [x, y, z]}` [m], for `body.at("tip")`.
    - `shape`: how it is drawn: "box" or "ellipsoid", of this mass and inertia; a list of `linkax.Shape`; None: by its
      joints and frames.

    **Raises:** `ValueError` for a mass that is negative or not finite, and for an inertia tensor that no body has: one
    that is not symmetric, with a negative principal moment, or with one larger than the sum of the others.
    """

    name: str = eqx.field(static=True)
    mass: Scalar
    center_of_mass: Float[Array, "3"]
    inertia: Float[Array, "3 3"]
    frames: dict[str, Float[Array, "3"]]
    shape: OfInertia | tuple[Shape, ...] | None = eqx.field(static=True)
    drawn_at: Float[Array, "3"] | None

    def __init__(
        self,
        name: str,
        mass: Number,
        center_of_mass: Vector = (0.0, 0.0, 0.0),
        inertia: Number | Matrix = (0.0, 0.0, 0.0),
        frames: Mapping[str, Vector] | None = None,
        *,
        shape: OfInertia | Iterable[Shape] | None = None,
    ) -> None:
        self.name = body_name(name)
        self.mass = zero_or_more(mass, f"body {name!r}: mass [kg]")
        self.center_of_mass = number(center_of_mass, (3,), f"body {name!r}: center_of_mass [m]")
        what, moments = f"body {name!r}: inertia [kg m²]", cast(Matrix, inertia)
        self.inertia = inertia_tensor(_of_flat(inertia, what) if _depth(inertia) == 0 else moments, what)
        frames = {} if frames is None else frames
        require_type(frames, Mapping, f"body {name!r}: frames", 'give {"tip": [x, y, z]}')
        self.frames = {
            self._label(label): number(offset, (3,), f"body {name!r}: frame {label!r} [m]")
            for label, offset in frames.items()
        }
        self.shape = _drawn_as(shape, f"body {name!r}: shape")
        self.drawn_at = None

    def _label(self, label: Any) -> str:
        if not isinstance(label, str) or not label:
            raise ValueError(f"body {self.name!r}: name of a frame is {label!r}; give a non-empty string")
        return label

    @property
    def reference(self) -> Frame:
        return self.at([0.0, 0.0, 0.0])

    def at(self, where: str | Vector, rotation: Matrix | None = None) -> Frame:
        """Make a frame on this body.

        **Arguments:**

        - `where`: its origin, a name in `frames` or [x, y, z] in the body's reference frame [m].
        - `rotation`: its axes as columns, in the body's axes, shape (3, 3) (default: parallel).

        **Raises:** `ValueError` for an unknown name, and for axes that are not orthonormal and right-handed.
        """
        if isinstance(where, str):
            if where not in self.frames:
                names = ", ".join(map(repr, self.frames)) or "none"
                raise ValueError(
                    f"body {self.name!r} has no frame {where!r}; its named frames: {names}; or give [x, y, z]"
                )
            offset = self.frames[where]
        else:
            offset = number(where, (3,), f"offset of a frame on body {self.name!r} [m]")
        return Frame(self.name, offset, rotation_matrix(rotation, f"rotation of a frame on body {self.name!r}"))

    def placed(self, position: Vector, orientation: Matrix | None = None) -> "RigidBody":
        """The same body as it stands in the world in one configuration, in which a model is drawn, as CAD knows it.

        Its reference frame is then parallel to the world's in that configuration. Where all bodies of a joint are
        placed, `at_world` gives its frames, its axis is one in the world, and its coordinates are zero as drawn:

        ```python
        arm = lx.rod("arm", length=1.0, mass=1.0).placed([0.0, 0.0, 2.0])
        fork = lx.box("fork", [0.1, 0.2, 0.3], mass=2.0).placed([1.0, 0.5, 2.0])
        pin = lx.Revolute("pin", arm.at_world([1.0, 0.0, 2.0]), fork.at_world([1.0, 0.0, 2.0]), axis="y")
        ```

        **Arguments:** `position`: of the origin of its reference frame [m]; `orientation`: the axes of this frame as
        columns, in ground axes, shape (3, 3) (default: parallel).
        """
        what = f"body {self.name!r}: %s in the world"
        found = copy.copy(self)
        placed: dict[str, Any] = {"drawn_at": number(position, (3,), what % "position" + " [m]")}
        if orientation is not None:
            turn = value(rotation_matrix(orientation, what % "orientation"))
            placed["center_of_mass"] = turn @ self.center_of_mass
            placed["inertia"] = turn @ self.inertia @ turn.T
            placed["frames"] = {label: turn @ offset for label, offset in self.frames.items()}
            placed["shape"] = turned(self.shape, turn) if isinstance(self.shape, tuple) else self.shape
        for name, entry in placed.items():
            object.__setattr__(found, name, entry)
        return found

    def at_world(self, point: Vector, rotation: Matrix | None = None) -> Frame:
        """Make a frame on this body from where it is in the world as the body is `placed`.

        **Arguments:** `point`: its origin [m], shape (3,); `rotation`: its axes as columns, in ground axes.

        **Raises:** `ValueError` for a body that is not placed.
        """
        what = f"body {self.name!r}: a point in the world [m]"
        if self.drawn_at is None:
            raise ValueError(f"{what} is {point!r}, but its place is not known; give it by body.placed(position)")
        return self.at(number(point, (3,), what) - self.drawn_at, rotation)


def _drawn_as(shape: Any, what: str) -> OfInertia | tuple[Shape, ...] | None:
    if isinstance(shape, str):
        return one_of(shape, get_args(OfInertia), what)
    remedy = 'give "box", "ellipsoid", or a list of lx.Shape'
    return None if shape is None else tuple(listed(shape, Shape, what, remedy)) or None


def body_name(name: Any) -> str:
    """Check the name of a body."""
    if not isinstance(name, str) or not name:
        raise ValueError(f"body name is {name!r}; give a non-empty string")
    if name == GROUND_NAME:
        raise ValueError(f"body {name!r}: this name belongs to lx.GROUND; choose another")
    return name


def frame_of(place: BodyOrFrame, what: str) -> Frame:
    """Return the frame that a body, `body.at(...)` or the ground stands for; `what` names it in errors."""
    if isinstance(place, AbstractBody):
        return place.reference
    if isinstance(place, Frame):
        return place
    raise ValueError(f"{what} is {place!r}; give a body, body.at(...), or lx.GROUND")


def _depth(entry: Any) -> int:
    """Count the dimensions of an array, or of nested lists of numbers that may be traced."""
    if isinstance(entry, list | tuple):
        return 1 + (_depth(entry[0]) if entry else 0)
    return np.ndim(entry)


def _of_flat(moment: Any, what: str) -> list[Scalar]:
    """Principal moments of a flat body from that about z."""
    moment = number(moment, (), what)
    return [moment / 2.0, moment / 2.0, moment]


def inertia_tensor(inertia: Matrix, what: str) -> Float[Array, "3 3"]:
    """Check an inertia tensor, (3, 3), given as a whole or by its diagonal; `what` names it in errors."""
    diagonal = _depth(inertia) == 1
    tensor = number(inertia, (3,) if diagonal else (3, 3), what)
    if diagonal:
        tensor = tensor * np.eye(3)
    tensor = require(tensor, _is_symmetric, what, "it must be symmetric")
    moments = _principal_moments(tensor, diagonal)
    sizes = "" if concrete(moments) is None else f" {moments.tolist()}"
    remedy = (
        f"no body has it: its principal moments{sizes} must not be negative, and the largest must not exceed the sum "
        "of the others (triangle inequality); check units, and that it is taken about the centre of mass"
    )
    largest = (moments[0] + moments[1]) * (1.0 + 1e-9) + 1e-12 * abs(moments).max()
    return require(tensor, lambda _: moments[2] <= largest, what, remedy)


def _is_symmetric(tensor: Array) -> Any:
    return abs(tensor - tensor.T).max() <= 1e-12 * abs(tensor).max()


def _principal_moments(tensor: Array, diagonal: bool) -> Float[Array, "3"]:
    """Principal moments in rising order, without derivative."""
    tensor = numbers_of(tensor)
    xp = namespace(tensor)
    return xp.sort(xp.diagonal(tensor)) if diagonal else xp.linalg.eigvalsh(tensor / 2.0 + tensor.T / 2.0)


def point_mass(name: str, mass: Number) -> RigidBody:
    """Make a point of `mass` [kg] at the origin of its frame, without rotational inertia.

    **Raises:** `ValueError` for a negative mass.
    """
    return RigidBody(name, mass)


def box(name: str, size: Vector, mass: Number) -> RigidBody:
    """Make a uniform box, with its reference frame at its centre.

    **Arguments:** `name`: unique in the mechanism; `size`: its extent along x, y, z [m], shape (3,); `mass` [kg].

    **Raises:** `ValueError` for a size that is not positive, and for a negative mass.
    """
    what = f"box {name!r}: size [m]"
    size = require(number(size, (3,), what), lambda metres: (metres > 0.0).all(), what, "all must be positive")
    mass = number(mass, (), f"body {name!r}: mass [kg]")
    squares = size * size
    return RigidBody(name, mass, inertia=mass / 12 * (squares.sum() - squares), shape="box")
