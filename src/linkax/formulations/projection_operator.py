"""The projection operator onto the tangent space."""

import jax.numpy as jnp
from jaxtyping import Float

from linkax.formulations.classical import AbstractAcceleration, parameter
from linkax.linalg.right_inverse import by_svd
from linkax.model.numbers import Number
from linkax.xla.arrays import Array


class ProjectionOperator(AbstractAcceleration):
    """M_c v̇ = P f + M J⁺ γ with P = 1 − J⁺ J, M_c = M + P M − (P M)ᵀ, regular for any rank of J.

    Aghili and Piedbœuf, Multibody System Dynamics 10, 2003. Multipliers are of minimum norm.

    - `tolerance`: singular values of J below that much of the largest one count as zero.
    """

    tolerance: Number = parameter(1e-6, "tolerance of ProjectionOperator")

    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        back = by_svd(jacobian, self.tolerance)
        projector = jnp.eye(len(force), dtype=mass.dtype) - back @ jacobian
        projected = projector @ mass
        acceleration = jnp.linalg.solve(mass + projected - projected.T, projector @ force + mass @ (back @ gamma))
        return acceleration, back.T @ (mass @ acceleration - force)
