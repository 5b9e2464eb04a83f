"""Gears and racks whose axes may move."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from linkax.model.attached import Attached
from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.constraints.constraint import AbstractConstraint, checked_name
from linkax.model.numbers import Number, positive, require_bool, whole_number
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array, Scalar


class Gear(AbstractConstraint):
    """Two toothed wheels in mesh about parallel axes, the z axes of their frames, which may move: planetary gears.

    With θ₁, θ₂ the angles of the frames' x axes from the line of centres, right-handed about z of the first frame, it
    keeps z₁ θ₁ + z₂ θ₂ = 0, of an internal pair z₁ θ₁ − z₂ θ₂ = 0, up to whole teeth. Other constraints keep the wheels
    at their distance, and their axes parallel. For wheels on fixed axes, or on one carrier, `linkax.Coupling` does the
    same and counts turns. Its reaction is the torque on the first wheel [N m] about its own z axis.

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `first`, `second`: a body (its reference frame), `body.at(...)`, or `lx.GROUND`, at the centres of the wheels.
    - `teeth`: (z₁, z₂), numbers of teeth.
    - `internal`: whether one of the wheels is a ring with teeth inside.

    **Raises:** `ValueError` for numbers of teeth that are not whole and positive.
    """

    units = ("rad",)

    first: Frame
    second: Frame
    teeth: tuple[int, int] = eqx.field(static=True)
    internal: bool = eqx.field(static=True)

    def __init__(
        self, name: str, first: BodyOrFrame, second: BodyOrFrame, teeth: tuple[int, int], *, internal: bool = False
    ) -> None:
        self.name = checked_name(name, "gear")
        what = f"gear {name!r}"
        self.first, self.second = frame_of(first, f"{what}: first"), frame_of(second, f"{what}: second")
        if not isinstance(teeth, tuple) or len(teeth) != 2:
            raise ValueError(f"{what}: teeth are {teeth!r}; give two numbers, (z1, z2)")
        self.teeth = (whole_number(teeth[0], f"{what}: teeth"), whole_number(teeth[1], f"{what}: teeth"))
        self.internal = require_bool(internal, f"{what}: internal")

    def residual(self, t: Number, attached: Attached) -> Scalar:
        centres = attached.between(self.first, self.second)
        axis = attached.orientation(self.first)[:, 2]
        angles = [_angle(axis, centres, attached.orientation(frame)[:, 0]) for frame in (self.first, self.second)]
        of_first, of_second = self.teeth
        found = of_first * angles[0] + (-of_second if self.internal else of_second) * angles[1]
        return _within_period(found, 2.0 * jnp.pi) / of_first


class Rack(AbstractConstraint):
    """A pinion that rolls on a rack, without slip, where both may move.

    The pinion turns about the z axis of its frame, parallel to that of the rack's frame, whose x axis is along the
    rack, and is on its side of positive y. With s the place of its centre along the rack and θ the angle of its x axis
    from that of the rack, it keeps s + r θ = 0 up to whole teeth, r = teeth × module / 2. Other constraints keep it at
    its distance from the rack. Its reaction is the force on the pinion along the rack [N].

    **Arguments:** `name`: unique among joints and constraints; `pinion`, `rack`: a body (its reference frame),
    `body.at(...)`, or `lx.GROUND`; `teeth`: number of teeth of the pinion; `module` [m]: its pitch diameter for one
    tooth.

    **Raises:** `ValueError` for a number of teeth that is not whole and positive, and a module that is not positive.
    """

    pinion: Frame
    rack: Frame
    teeth: int = eqx.field(static=True)
    module: Scalar

    def __init__(self, name: str, pinion: BodyOrFrame, rack: BodyOrFrame, teeth: int, module: Number) -> None:
        self.name = checked_name(name, "rack")
        self.pinion, self.rack = frame_of(pinion, f"rack {name!r}: pinion"), frame_of(rack, f"rack {name!r}: rack")
        self.teeth = whole_number(teeth, f"rack {name!r}: teeth")
        self.module = positive(module, f"rack {name!r}: module [m]")

    def residual(self, t: Number, attached: Attached) -> Scalar:
        along, _, axis = attached.orientation(self.rack).T
        angle = _angle(axis, along, attached.orientation(self.pinion)[:, 0])
        rolled = dot(attached.between(self.rack, self.pinion), along) + self.teeth * self.module / 2.0 * angle
        return _within_period(rolled, jnp.pi * self.module)


def _angle(axis: Float[Array, "3"], start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[jax.Array, ""]:
    """The angle from one vector to another, right-handed about an axis of length one, in (−π, π]."""
    across = cross(axis, start)
    return jnp.arctan2(dot(across, end), dot(start, end))


def _within_period(number: Scalar, period: Scalar | float) -> Scalar:
    """Take whole periods off, without derivative."""
    return number - period * lax.stop_gradient(jnp.round(number / period))
