from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame
from linkax.model.curves import SplineCurve
from linkax.model.functions import Law
from linkax.model.joints.joint import AbstractJoint
from linkax.model.numbers import Vector, number, one_of
from linkax.spatial.vectors import cross, length
from linkax.xla.arrays import Array

Follows = Literal["point", "tangent"]


class CurveJoint(AbstractJoint):
    """A slide along a curve: a bead on a wire, a trolley on a bent rail.

    Coordinate: the parameter u of the curve [m], of a `linkax.SplineCurve` about its length. The speed along the curve
    is |r'(u)| u̇.

    **Arguments:**

    - `name`, `parent`, `child`, `cut`: see `linkax.AbstractJoint`.
    - `curve`: r, u ↦ position in the parent's frame [m], (3,): a `linkax.SplineCurve`, or a function, three times
      differentiable by JAX. What it may read is as for `linkax.Drive`.
    - `follows`: "point" (default): the child keeps its orientation on the parent. "tangent": its x axis is along the
      curve, its y axis as near to `up` as it can be.
    - `up`: in the parent's frame, (3,), nowhere along the curve; default z.
    """

    speed_units = ("m",)

    curve: SplineCurve | Law
    follows: Follows = eqx.field(static=True)
    up: Float[Array, "3"]

    def __init__(
        self,
        name: str,
        parent: BodyOrFrame,
        child: BodyOrFrame,
        curve: SplineCurve | Callable[[Any], Vector],
        *,
        follows: Follows = "point",
        up: Vector = (0.0, 0.0, 1.0),
        cut: bool = False,
    ) -> None:
        super().__init__(name, parent, child, "x", cut=cut)
        what = f"joint {name!r}"
        if not isinstance(curve, SplineCurve) and not callable(curve):
            raise ValueError(f"{what}: curve is {curve!r}; give a linkax.SplineCurve, or a function of u")
        self.curve = curve if isinstance(curve, SplineCurve) else Law(curve, (3,), f"{what}: curve [m]")
        jax.eval_shape(self.curve, jnp.zeros(()))
        self.follows = one_of(follows, get_args(Follows), f"{what}: follows")
        self.up = number(up, (3,), f"{what}: up")

    @property
    def length_estimate(self) -> Any:
        return self.curve.parameters[-1] / 2.0 if isinstance(self.curve, SplineCurve) else super().length_estimate

    def transform(self, coordinates: Float[Array, "1"]) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        (u,) = coordinates
        if self.follows == "point":
            return jnp.eye(3, dtype=coordinates.dtype), self.curve(u)
        place, along = jax.jvp(self.curve, (u,), (jnp.ones_like(u),))
        tangent = along / length(along)
        aside = cross(tangent, self.up)
        aside = aside / length(aside)
        return jnp.stack([tangent, cross(aside, tangent), aside], axis=1), place
