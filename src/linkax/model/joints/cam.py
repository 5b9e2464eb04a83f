from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.curves import PeriodicSpline
from linkax.model.functions import Law
from linkax.model.joints.joint import AbstractJoint
from linkax.model.numbers import Number, zero_or_more
from linkax.spatial.vectors import length
from linkax.xla.arrays import Array, Scalar


class Cam(AbstractJoint):
    """A disc cam and the roller, or the edge, of its follower, in the plane across z of the cam's frame.

    The roller stays on the cam: nothing lifts it off. Its `reaction` tells where it would, as a force on the follower
    towards the cam. The follower is led by other joints.

    Coordinates: the polar angle φ of the point of contact on the cam, and the angle of the follower's frame from the
    cam's, both right-handed about z [rad]. They count turns, also where the joint closes a loop.

    **Arguments:**

    - `name`, `cut`: see `linkax.AbstractJoint`. `cam`, `follower`: a body (its reference frame), or `body.at(...)`: the
      cam's axis, and the centre of the roller, or the edge.
    - `profile`: φ ↦ radius of the cam [m]: a `linkax.PeriodicSpline`, or a periodic function, three times
      differentiable by JAX. What it may read is as for `linkax.Drive`.
    - `roller_radius`: [m], zero (default) for an edge. It must be smaller than the cam's radius of curvature where the
      cam is hollow.

    **Raises:** `ValueError` for a profile that does not return one number, and a negative radius.
    """

    speed_units = ("rad", "rad")

    profile: PeriodicSpline | Law
    roller_radius: Scalar

    def __init__(
        self,
        name: str,
        cam: BodyOrFrame,
        follower: BodyOrFrame,
        profile: PeriodicSpline | Callable[[Any], Number],
        roller_radius: Number = 0.0,
        *,
        cut: bool = False,
    ) -> None:
        super().__init__(name, cam, follower, "x", cut=cut)
        what = f"joint {name!r}"
        if not callable(profile):
            raise ValueError(
                f"{what}: profile is {profile!r}; give a linkax.PeriodicSpline, or a function of the angle"
            )
        is_spline = isinstance(profile, PeriodicSpline)
        self.profile = profile if is_spline else Law(profile, (), f"{what}: profile [m]")
        jax.eval_shape(self.profile, jnp.zeros(()))
        self.roller_radius = zero_or_more(roller_radius, f"{what}: roller_radius [m]")

    def transform(self, coordinates: Float[Array, "2"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        polar, turn = coordinates
        surface = lambda angle: self.profile(angle) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        place, along = jax.jvp(surface, (polar,), (jnp.ones_like(polar),))
        outward = jnp.stack([along[1], -along[0]]) / length(along)
        x, y = place + self.roller_radius * outward
        c, s, zero, one = jnp.cos(turn), jnp.sin(turn), jnp.zeros_like(turn), jnp.ones_like(turn)
        turned = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
        return turned, jnp.stack([x, y, zero])
