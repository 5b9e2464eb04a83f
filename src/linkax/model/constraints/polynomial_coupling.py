"""Couple coordinates of joints by a polynomial."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.attached import Attached
from linkax.model.constraints.constraint import CoordinateConstraint, checked_name
from linkax.model.numbers import Number, Vector, is_finite, real, require
from linkax.model.terms import Combination, CombinationLike, Term
from linkax.xla.arrays import Array, Scalar


class PolynomialCoupling(CoordinateConstraint):
    """A joint's coordinate y as a polynomial of another one x: y = a₀ + a₁ x + … + aₙ xⁿ.

    `PolynomialCoupling("knee", "slide", "hinge", [0.0, 0.02, 0.1])` keeps slide = 0.02 hinge + 0.1 hinge². Both may be
    linear combinations. It is MuJoCo's `equality/joint` or `equality/tendon` with `polycoef`. Where a₀ and a₁ are
    enough, take `linkax.Coupling`.

    Its joints are in the spanning tree, so angles count whole turns. Its reaction is one number μ; it acts along y
    with μ [N m or N], along x with −μ times the polynomial's slope.

    **Arguments:**

    - `name`: unique among joints and constraints.
    - `joint`, `of`: y and x [rad or m], each a joint's name or {joint: factor} for Σ factor × coordinate. For one of
      several coordinates the key is (joint, index), counted like the joint's speeds.
    - `coefficients`: (a₀, a₁, …, aₙ), two or more.

    **Raises:** `ValueError` for fewer than two coefficients, and for combinations without a factor that is not zero.
    """

    joint: Combination
    of: Combination
    coefficients: Float[Array, " n"]

    def __init__(self, name: str, joint: CombinationLike, of: CombinationLike, coefficients: Vector) -> None:
        self.name = checked_name(name, "PolynomialCoupling")
        self.joint = Combination(joint, f"{self.display_name}: joint")
        self.of = Combination(of, f"{self.display_name}: of")
        what = f"{self.display_name}: coefficients"
        found = real(coefficients, what)
        if found.ndim != 1 or found.size < 2:
            raise ValueError(f"{what} have shape {found.shape}; give (a₀, a₁, ...), two or more")
        self.coefficients = require(found, is_finite, what, "they must be finite")

    @property
    def display_name(self) -> str:
        return f"PolynomialCoupling {self.name!r}"

    @property
    def terms(self) -> tuple[Term, ...]:
        return tuple(dict.fromkeys([*self.joint.terms, *self.of.terms]))

    def residual(self, t: Number, attached: Attached) -> Scalar:
        x, *lower, polynomial = self.of.of(attached.coordinate), *self.coefficients
        for coefficient in reversed(lower):  # Horner's rule
            polynomial = polynomial * x + coefficient
        return self.joint.of(attached.coordinate) - polynomial

    def row_scales(self, length: Scalar, slides: Callable[[Term], bool]) -> list[Scalar]:
        unit = lambda along: length if slides(along) else 1.0
        return [jnp.maximum(self.joint.largest(unit), jnp.abs(self.coefficients[1]) * self.of.largest(unit))]
