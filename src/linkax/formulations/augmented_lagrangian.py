"""The augmented Lagrangian formulation, index 1."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Float

from linkax.formulations.classical import AbstractAcceleration, parameter
from linkax.model.numbers import Number, whole_number
from linkax.xla.arrays import Array


class AugmentedLagrangian(AbstractAcceleration):
    """Penalties on the loop rows, and sweeps that make up for what they leave of J v̇ = γ open.

    (M + Jᵀ S J) v̇ₖ₊₁ = M v̇ₖ + Jᵀ S γ from M v̇₀ = f; λₖ₊₁ = λₖ − S (J v̇ₖ₊₁ − γ). Bayo, García de Jalón and
    Serna, Computer Methods in Applied Mechanics and Engineering 71, 1988; who stabilise as Baumgarte does, with
    α = μΩ, β = Ω, most often Ω = 10 1/s and μ = 1. Rows may be redundant.

    - `penalty`: S over the largest diagonal entry of M; its rounding needs double precision.
    - `sweeps`: how often, one or more; one is the penalty method.
    """

    penalty: Number = parameter(1e7, "penalty of AugmentedLagrangian")
    sweeps: int = eqx.field(static=True, default=10)

    def __check_init__(self):
        whole_number(self.sweeps, "sweeps of AugmentedLagrangian")

    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        size = self.penalty * jnp.max(jnp.diagonal(mass))
        factor = cho_factor(mass + size * jacobian.T @ jacobian)
        # The first sweep needs M v̇₀ alone, so M may be singular.
        first = cho_solve(factor, force + size * jacobian.T @ gamma)

        def sweep(_, carry):
            # The equation above less (M + JᵀSJ) v̇ₖ, so that rounding falls with what is left open.
            acceleration, multipliers = carry
            acceleration = acceleration - cho_solve(factor, size * jacobian.T @ (jacobian @ acceleration - gamma))
            return acceleration, multipliers - size * (jacobian @ acceleration - gamma)

        return lax.fori_loop(1, self.sweeps, sweep, (first, -size * (jacobian @ first - gamma)))
