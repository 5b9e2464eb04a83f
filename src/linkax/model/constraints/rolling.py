"""Constraints on speeds: a skate, discs and balls that roll without slip."""

import abc

from jaxtyping import Float

from linkax.model.attached import Attached, Moving
from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.constraints.constraint import AbstractConstraint, checked_name
from linkax.model.numbers import Number, positive
from linkax.spatial.vectors import dot, length
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio


class Skate(AbstractConstraint):
    """An edge that moves along itself only: of a skate, a knife, a wheel that does not tip.

    The origin of its frame has no speed along the frame's y axis, relative to another body. It holds no place, so it
    takes a degree of freedom from speeds alone. Its reaction is the force on it along y [N].

    **Arguments:** `name`: unique among joints and constraints; `edge`: a body (its reference frame), or `body.at(...)`,
    with x along the edge; `ground`: the body on which it moves, by default the world, `lx.GROUND`.
    """

    units = ()
    slip_units = ("m",)

    edge: Frame
    ground: Frame

    def __init__(self, name: str, edge: BodyOrFrame, ground: BodyOrFrame) -> None:
        self.name = checked_name(name, "skate")
        self.edge, self.ground = frame_of(edge, f"skate {name!r}: edge"), frame_of(ground, f"skate {name!r}: ground")

    def slip(self, t: Number, moving: Moving) -> Scalar:
        across = moving.orientation(self.edge)[:, 1]
        below = moving.velocity_at(self.ground, moving.between(self.ground, self.edge))
        return dot(moving.point_velocity(self.edge) - below, across)


class _Rolling(AbstractConstraint):
    """A body that touches a plane in one point, where the two have the same velocity."""

    slip_units = ("m", "m")

    body: Frame
    plane: Frame
    radius: Scalar

    def __init__(self, name: str, body: BodyOrFrame, plane: BodyOrFrame, radius: Number) -> None:
        what = type(self).__name__
        self.name = checked_name(name, what)
        self.body, self.plane = frame_of(body, f"{what} {name!r}: body"), frame_of(plane, f"{what} {name!r}: plane")
        self.radius = positive(radius, f"{what} {name!r}: radius [m]")

    @abc.abstractmethod
    def contact(self, attached: Attached) -> Float[Array, "3"]:
        """Compute the vector from the body's centre to the point that touches, in ground axes [m]."""

    def residual(self, t: Number, attached: Attached) -> Scalar:
        touching = attached.between(self.plane, self.body) + self.contact(attached)
        return dot(touching, attached.orientation(self.plane)[:, 2])

    def slip(self, t: Number, moving: Moving) -> Float[Array, "2"]:
        contact = self.contact(moving)
        of_body = moving.velocity_at(self.body, contact)
        of_plane = moving.velocity_at(self.plane, moving.between(self.plane, self.body) + contact)
        return (of_body - of_plane) @ moving.orientation(self.plane)[:, :2]


class RollingDisc(_Rolling):
    """A thin disc that rolls on a plane without slip, and stays on it.

    Its reaction is the force on it in the axes of the plane [N]: normal, along x, along y. It touches with its edge,
    in any attitude but lying flat, where the point of contact is not one.

    **Arguments:** `name`: unique among joints and constraints; `body`: the disc, a body (its reference frame) or
    `body.at(...)` at its centre, with z along its axis; `plane`: z = 0 of a body's frame, `body.at(...)` or
    `lx.GROUND`, with the disc on the side of positive z; `radius` [m].

    **Raises:** `ValueError` for a radius that is not positive.
    """

    def contact(self, attached: Attached) -> Float[Array, "3"]:
        normal, axis = attached.orientation(self.plane)[:, 2], attached.orientation(self.body)[:, 2]
        down = dot(normal, axis) * axis - normal
        return self.radius * ratio(down, length(down))


class RollingSphere(_Rolling):
    """A ball that rolls on a plane without slip, and stays on it.

    It may spin about the normal. Its reaction is the force on it in the axes of the plane [N]: normal, along x, along
    y.

    **Arguments:** as for `linkax.RollingDisc`; `body` is the ball, with the frame at its centre.

    **Raises:** `ValueError` for a radius that is not positive.
    """

    def contact(self, attached: Attached) -> Float[Array, "3"]:
        return -self.radius * attached.orientation(self.plane)[:, 2]
