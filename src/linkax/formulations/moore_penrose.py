"""Accelerations by the Moore-Penrose inverse of the loop rows in the mass metric."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jaxtyping import Float

from linkax.formulations.classical import AbstractAcceleration, AbstractCorrection, parameter
from linkax.linalg.right_inverse import by_gram_schmidt, by_svd
from linkax.model.numbers import Number
from linkax.xla.arrays import Array

INVERSES = {"svd": by_svd, "gram-schmidt": by_gram_schmidt}


def mass_orthogonal_inverse(
    mass: Float[Array, "n n"],
    jacobian: Float[Array, "m n"],
    inverse: Callable[[Array, Number], Array],
    tolerance: Number,
) -> Float[Array, "n m"]:
    """The right inverse of J whose columns are M-orthogonal to the tangent space: L⁻ᵀ (J L⁻ᵀ)⁺, M = L Lᵀ."""
    lower = jnp.linalg.cholesky(mass)
    weighted = solve_triangular(lower, jacobian.T, lower=True).T
    return solve_triangular(lower.T, inverse(weighted, tolerance))


class MoorePenrose(AbstractAcceleration):
    """The free acceleration and the smallest one, in the mass metric, that satisfies the rows.

    v̇ = a + M^(-1/2) B⁺ (γ − J a), a = M⁻¹ f, B = J M^(-1/2): Udwadia and Kalaba, Proceedings of the Royal
    Society A 439, 1992. Rows may be redundant, M must be positive definite. By "svd", multipliers are of
    minimum norm.

    - `inverse`: B⁺ by "svd", or by "gram-schmidt" on the rows of B, as in Neto and Ambrósio, Multibody System
      Dynamics 10, 2003.
    - `tolerance`: singular values below that much of the largest one, and rows of which less than that much of their
      length is left, count as zero.
    """

    inverse: Literal["svd", "gram-schmidt"] = eqx.field(static=True, default="svd")
    tolerance: Number = parameter(1e-6, "tolerance of MoorePenrose")

    def __check_init__(self):
        if self.inverse not in INVERSES:
            raise ValueError(f"inverse of MoorePenrose is {self.inverse!r}; known: {', '.join(map(repr, INVERSES))}")

    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        back = mass_orthogonal_inverse(mass, jacobian, INVERSES[self.inverse], self.tolerance)
        free = cho_solve(cho_factor(mass), force)
        added = back @ (gamma - jacobian @ free)
        return free + added, back.T @ (mass @ added)


class MassOrthogonalProjection(AbstractCorrection):
    """The smallest change in the mass metric: Blajer, Multibody System Dynamics 7, 2002.

    - `tolerance`: see `MoorePenrose`.
    """

    tolerance: Number = parameter(1e-6, "tolerance of MassOrthogonalProjection")

    def right_inverse(self, mass: Float[Array, "n n"], jacobian: Float[Array, "m n"]) -> Float[Array, "n m"]:
        return mass_orthogonal_inverse(mass, jacobian, by_svd, self.tolerance)
