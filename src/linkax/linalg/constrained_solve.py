"""The constrained solve M a = f + Jᵀλ, J a = γ, for any rank of J, and its derivative."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float

from linkax.linalg.block_elimination import Factors
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline


class SaddlePoint(eqx.Module):
    """The matrix [[M, −Jᵀ], [J, 0]], as a function of (a, λ) in one vector."""

    mass: Float[Array, "n n"]
    jacobian: Float[Array, "m n"]

    def __call__(self, unknowns: Float[Array, " k"]) -> Float[Array, " k"]:
        a, multipliers = jnp.split(unknowns, [self.mass.shape[0]])
        return jnp.concatenate([self.mass @ a - self.jacobian.T @ multipliers, self.jacobian @ a])


@jit_inline
def constrained_solve(
    inverse: Factors,
    mass: Float[Array, "n n"],
    jacobian: Float[Array, "m n"],
    f: Float[Array, " n"],
    gamma: Float[Array, " m"],
    refinements: int = 1,
    product: Callable[[Array], Array] | None = None,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Solve M a = f + Jᵀλ, J a = γ, differentiably in M, J, f and γ, in both modes, to any order.

    Derivatives are solves of the same system with right-hand sides df − dM a + dJᵀλ and dγ − dJ a; nothing is
    differentiated through the pivoting. They hold where the rank of J does not change.

    **Arguments:** `inverse`: of this system or one nearby; each of `refinements` steps of iterative refinement
    multiplies the error by the distance between the two; `product`: multiplies with the system's matrix, where there is
    a quicker way than `SaddlePoint`.

    **Returns:** a, (n,), and λ, (m,); with dependent rows a and Jᵀλ are unique, λ is one of many.
    """
    n, forwards = mass.shape[0], SaddlePoint(mass, jacobian)
    product = forwards if product is None else product

    def nearby(right):
        return jnp.concatenate(inverse.apply(right[:n], right[n:]))

    def solve(_, right):
        unknowns = nearby(right)
        for _ in range(refinements):
            unknowns = unknowns + nearby(right - product(unknowns))
        return unknowns

    def transpose_solve(_, right):
        # The transpose of [[M, -Jᵀ], [J, 0]] differs by the signs of its second row and column.
        flip = jnp.concatenate([jnp.ones(n, right.dtype), -jnp.ones(len(right) - n, right.dtype)])
        return flip * solve(None, flip * right)

    # One vector, not a pair: JAX transposes such a solve only where all of its right side is linear.
    unknowns = lax.custom_linear_solve(forwards, jnp.concatenate([f, gamma]), solve, transpose_solve)
    return unknowns[:n], unknowns[n:]
