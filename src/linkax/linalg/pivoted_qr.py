"""Column-pivoted QR by Householder reflections, in one compiled loop.

Fixed shapes throughout, so that it serves under `jit` and `vmap`; the rank is for the caller to
read off the diagonal of R. Golub and Van Loan, Matrix Computations (4th ed.), algorithm 5.4.1,
but with the norms of the remaining columns computed anew in each step instead of updated, which
keeps the pivots right on graded and nearly dependent columns.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


class PivotedQR(NamedTuple):
    """A[:, order] = Q R, with the diagonal of R falling in magnitude.

    - `q`: orthogonal, (n, n). `r`: upper trapezoidal, (n, m). `order`: permutation, (m,).
    """

    q: Float[Array, "n n"]
    r: Float[Array, "n m"]
    order: Int[Array, " m"]


def pivoted_qr(a: Float[Array, "n m"]) -> PivotedQR:
    """Factorise a matrix of any shape, with dependent or zero columns too.

    Not to be differentiated: at a rank change, and for wide matrices, the factors have no
    derivative. Differentiate what is solved with them (`linkax.linalg.constrained_solve`).
    """
    n, m = a.shape
    rows, places = jnp.arange(n), jnp.arange(m)

    def reflect(step, carry):
        work, order = carry
        below = jnp.where(rows[:, None] >= step, work[:, :m], 0.0)
        remaining = jnp.where(places >= step, jnp.sum(below * below, axis=0)[order], -1.0)
        place = jnp.argmax(remaining)
        chosen, passed = order[place], order[step]
        order = jnp.where(places == place, passed, jnp.where(places == step, chosen, order))
        column = below[:, chosen]
        head = column[step]
        norm = jnp.sqrt(remaining[place])
        reflector = jnp.where(rows == step, head + jnp.where(head < 0.0, -norm, norm), column)
        size = jnp.sum(reflector * reflector)
        scale = jnp.where(size > 0.0, 2.0 / jnp.where(size > 0.0, size, 1.0), 0.0)
        return work - (scale * reflector)[:, None] * (reflector @ work)[None, :], order

    work, order = jnp.concatenate([a, jnp.eye(n, dtype=a.dtype)], axis=1), places
    work, order = lax.fori_loop(0, min(n, m), reflect, (work, order))
    upper = rows[:, None] <= places[None, :]
    return PivotedQR(work[:, m:].T, jnp.where(upper, work[:, :m][:, order], 0.0), order)
