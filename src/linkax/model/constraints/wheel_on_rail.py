"""Keep a wheel on a rail."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.attached import Attached, Moving
from linkax.model.bodies import BodyOrFrame, Frame
from linkax.model.constraints.constraint import AbstractConstraint, checked_name
from linkax.model.forces.wheel_rail import Profile, WheelRailPair
from linkax.model.numbers import Number, Vector, one_of
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array, Scalar

Slip = Literal["along", "across"]


class WheelOnRail(AbstractConstraint):
    """A wheel that stays on a rail, both with any profile, and rolls or slides on it.

    It touches where the surfaces are nearest, wherever the wheel is, and however it yaws and rolls. It does not lift
    off, and touches in one place; for more, and for creep, take `linkax.WheelRailContact`. A wheelset of which both
    wheels have no slip across the rails cannot move: leave `across` to one of them.

    Its reaction is the force on the wheel [N]: the normal force, then those along and across the rail that `no_slip`
    asks for, x along the rail's frame, and y, on the left of it, in the plane of contact.

    **Arguments:** `name`: unique among joints and constraints; `wheel`, `rail`, `radius`, `height`, `span`: as for
    `linkax.WheelRailContact`; `no_slip`: directions in which it rolls without slip, out of "along" and "across".

    **Raises:** `ValueError` as `linkax.WheelRailContact` does, and for other words in `no_slip`.
    """

    pair: WheelRailPair
    no_slip: tuple[Slip, ...] = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        wheel: BodyOrFrame,
        rail: BodyOrFrame,
        *,
        radius: Profile,
        height: Profile,
        span: Vector,
        no_slip: tuple[Slip, ...] = (),
    ) -> None:
        self.name = checked_name(name, "WheelOnRail")
        what = f"WheelOnRail {name!r}"
        self.pair = WheelRailPair(wheel, rail, radius, height, span, what)
        if not isinstance(no_slip, tuple):
            raise ValueError(f'{what}: no_slip is {no_slip!r}; give a tuple out of "along" and "across"')
        words = {one_of(word, ("along", "across"), f"{what}: a word of no_slip") for word in no_slip}
        self.no_slip = tuple(word for word in ("along", "across") if word in words)

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.pair.frames

    @property
    def slip_units(self) -> tuple[str, ...]:
        return len(self.no_slip) * ("m",)

    @property
    def display_name(self) -> str:
        return f"WheelOnRail {self.name!r}"

    def residual(self, t: Number, attached: Attached) -> Scalar:
        return self.pair.spot(attached).gap

    def slip(self, t: Number, moving: Moving) -> Float[Array, " k"]:
        spot, along = self.pair.spot(moving), moving.orientation(self.pair.rail)[:, 0]
        of_wheel, of_rail = (
            moving.velocity_at(frame, arm) for frame, arm in zip(self.pair.frames, spot.arms, strict=True)
        )
        directions = {"along": along, "across": cross(spot.normal, along)}
        return jnp.stack([dot(of_wheel - of_rail, directions[word]) for word in self.no_slip])
