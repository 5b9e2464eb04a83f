"""Column-pivoted QR by Householder reflections, in compiled loops.

Fixed shapes throughout, so that it serves under `jit` and `vmap`; the rank is for the caller to
read off the diagonal of R. Golub and Van Loan, Matrix Computations (4th ed.), algorithm 5.4.1,
but with the norms of the remaining columns computed anew in each step instead of updated, which
keeps the pivots right on graded and nearly dependent columns.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from linkax.xla.arrays import Array
from linkax.xla.derivatives import positive_or_one, ratio

# A CPU factorises so many matrices together, if they have so many entries; fewer are faster each by itself, and many
# more do not fit into its cache.
TOGETHER = 64
ENTRIES = 8192


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
    return _stacked(a)


@jax.custom_batching.custom_vmap
def _stacked(a):
    """Factorise (..., n, m): each `vmap` adds an axis in front."""
    outer, shape = a.shape[:-2], a.shape[-2:]
    if not outer:
        return _single(a)
    matrices = a.reshape(math.prod(outer), *shape)
    by_itself = jax.vmap(_single)
    if len(matrices) < TOGETHER or matrices.size < ENTRIES:
        found = by_itself(matrices)
    else:
        # Each of the many small operations of `_together` would be a kernel of its own on an accelerator.
        found = lax.platform_dependent(matrices, cpu=_in_parts, default=by_itself)
    return PivotedQR(*(factor.reshape(outer + factor.shape[1:]) for factor in found))


@_stacked.def_vmap
def _(_size, _batched, a):
    found = _stacked(a)
    return found, jax.tree.map(lambda _: True, found)


def _single(a):
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
        scale = ratio(2.0, size, 0.0)
        return work - (scale * reflector)[:, None] * (reflector @ work)[None, :], order

    work, order = jnp.concatenate([a, jnp.eye(n, dtype=a.dtype)], axis=1), places
    work, order = lax.fori_loop(0, min(n, m), reflect, (work, order))
    upper = rows[:, None] <= places[None, :]
    return PivotedQR(work[:, m:].T, jnp.where(upper, work[:, :m][:, order], 0.0), order)


def _in_parts(matrices):
    """Factorise (k, n, m), in equal parts of at least TOGETHER."""
    size, *shape = matrices.shape
    parts = size // TOGETHER
    filled = jnp.pad(matrices, ((0, -size % parts), (0, 0), (0, 0)))
    found = lax.map(_together, filled.reshape(parts, -1, *shape))
    return PivotedQR(*(factor.reshape(-1, *factor.shape[2:])[:size] for factor in found))


def _together(matrices):
    """Factorise (k, n, m) with k as the last axis, so that an operation on a row runs along memory.

    Loops over rows leave out those above the step's. They also keep XLA from fusing products into
    the sums that use them, which would compute them again for each element.
    """
    work = jnp.moveaxis(matrices, 0, -1)
    n, m, size = work.shape
    count = min(n, m)
    rows, places = jnp.arange(n)[:, None, None], jnp.arange(m)[:, None]

    def reflect(step, carry):
        work, reflectors, order, free = carry
        squares = _sum_of_rows(lambda index: _row(work, index) ** 2, step, n)[0]
        remaining = jnp.where(free, squares, -1.0)
        chosen, norm = jnp.argmax(remaining, axis=0), jnp.sqrt(jnp.max(remaining, axis=0))
        order = jnp.where(places == step, chosen, jnp.where(order == chosen, _row(order, step), order))
        head, column = _of_columns(_row(work, step), chosen[None]), _of_columns(work, chosen[None])
        # Half of the reflector's square; scaled to the length √2 it is v in I − v vᵀ.
        half = norm * (norm + jnp.abs(head))
        scale = jnp.where(half > 0.0, lax.rsqrt(positive_or_one(half)), 0.0)
        below = jnp.where(rows > step, column, 0.0)
        reflector = scale * jnp.where(rows == step, head + jnp.where(head < 0.0, -norm, norm), below)
        reflectors = _with_row(reflectors, reflector[None], step)
        # Read back, so that it is in memory, and not computed in each of the loops.
        return _reflected(work, _row(reflectors, step)[0], step), reflectors, order, free & (places != chosen)

    reflectors, order = jnp.zeros((count, n, 1, size), work.dtype), jnp.broadcast_to(places, (m, size))
    work, reflectors, order, _ = lax.fori_loop(0, count, reflect, (work, reflectors, order, order >= 0))

    def accumulate(done, q):
        step = count - 1 - done
        return _reflected(q, _row(reflectors, step)[0], step)

    identity = jnp.broadcast_to(jnp.eye(n, dtype=work.dtype)[:, :, None], (n, n, size))
    q = lax.fori_loop(0, count, accumulate, identity)
    r = jnp.where(rows <= places, _of_columns(work, order), 0.0)
    return PivotedQR(jnp.moveaxis(q, -1, 0), jnp.moveaxis(r, -1, 0), order.T)


def _row(array, index):
    return lax.dynamic_slice_in_dim(array, index, 1)


def _with_row(array, row, index):
    return lax.dynamic_update_slice_in_dim(array, row, index, 0)


def _of_columns(work, chosen):
    """Columns of each member, (n, m, k) and (c, k) to (n, c, k)."""
    return jnp.take_along_axis(work, chosen[None], axis=1, mode="promise_in_bounds")


def _sum_of_rows(row, first, n):
    return lax.fori_loop(first, n, lambda index, total: total + row(index), jnp.zeros_like(row(first)))


def _reflected(work, reflector, first):
    """(I − v vᵀ) A for (n, m, k) and (n, 1, k), where v is zero above row `first`."""
    n = len(work)
    along = _sum_of_rows(lambda index: _row(reflector, index) * _row(work, index), first, n)

    def change(index, work):
        return _with_row(work, _row(work, index) - _row(reflector, index) * along, index)

    return lax.fori_loop(first, n, change, work)
