"""The inverse of the saddle-point system M a = f + Jᵀλ, J a = γ, for any rank of J.

A column-pivoted QR of the metric-weighted Jacobian, A P = Q R with A = L⁻¹Jᵀ and W = L Lᵀ, splits the space of speeds
into a normal space, which the constraints decide, and a tangent space, which the dynamics decide. From it follow the
four blocks of the inverse, a = T f + G γ, λ = S γ − Gᵀ f, for accelerations and corrections alike.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.linalg.static_sparse import assembled
from linkax.linalg.triangular import cholesky_inverse, cholesky_inverse_by_elimination, upper_inverse
from linkax.spatial.vectors import length
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import positive_or_one, ratio
from linkax.xla.tracing import jit_inline

Islands = Sequence[tuple[tuple[int, ...], tuple[int, ...]]]  # rows and columns of each


class SaddleInverse(NamedTuple):
    """The inverse of [[W, −Jᵀ], [J, 0]] on the r independent rows of J: a = T f + G γ, λ = S γ − Gᵀ f.

    With B = L⁻ᵀ and Pᵣ the first r columns of P:

    - `tangent` T = (B Q₂)(B Q₂)ᵀ, (n, n); in another mass matrix M than W, B Q₂ ((B Q₂)ᵀ M B Q₂)⁻¹ (B Q₂)ᵀ, see
      `with_mass`.
    - `normal` G = B Q₁ R₁₁⁻ᵀ Pᵣᵀ, (n, m): a right inverse of J. `compliance` S = Pᵣ R₁₁⁻¹ R₁₁⁻ᵀ Pᵣᵀ − D, (m, m).
    - `basis` B Q₂: tangent space, (n, n), zero columns where the normal space is.
    - `rank` r: number of independent rows; of each island by `invert_apart`.
    - `distance` d = |R_rr| / |R₁₁|, r the rank here or that of the neighbourhood where it is known; falls to zero in a
      singular configuration. One without rows.
    - `definiteness`: of W: the smallest of the squared diagonal of its Cholesky factor over its own diagonal, or over
      the rounding of the largest where that is more; rounding or not a number where the mass matrix is singular on the
      tangent space.
    """

    tangent: Float[Array, "n n"]
    normal: Float[Array, "n m"]
    compliance: Float[Array, "m m"]
    basis: Float[Array, "n n"]
    rank: Int[Array, "*islands"]
    distance: Float[Array, ""]
    definiteness: Float[Array, ""]

    def apply(self, f: Float[Array, " n"], gamma: Float[Array, " m"]) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Solve for (a, λ)."""
        a = self.tangent @ f + self.normal @ gamma
        return a, self.compliance @ gamma - self.normal.T @ f


@jit_inline
def invert(
    weight: Float[Array, "n n"] | None,
    jacobian: Float[Array, "m n"],
    scales: Float[Array, " n"],
    tolerance: ScalarLike,
    rank_nearby: Int[Array | np.integer, ""] | int | None = None,
) -> SaddleInverse:
    """Split the space of speeds by J and invert the saddle-point system on it.

    **Arguments:**

    - `weight`: M for the mass metric, positive definite on the tangent space, (n, n); or None
      for the identity metric, which measures speeds in their scales.
    - `jacobian`: J, (m, n), of any rank, redundant and zero rows included.
    - `scales`: one unit of each speed, (n,), so that radians and metres compare.
    - `tolerance`: τ; a row is independent where |R_kk| > τ max(|R₁₁|, 1).
    - `rank_nearby`: the rank at the states around, where it is known; it is larger than the rank
      of a J that is singular. No more rows than that are taken for independent: off the loops,
      rows that the loops make dependent differ by as much as the loops are open.
    """
    weight, jacobian, scales = lax.stop_gradient((weight, jacobian, scales))
    rows, n = jacobian.shape
    dtype, jacobian = jacobian.dtype, jacobian * scales[None, :]
    added = jnp.zeros(rows, dtype)
    to_metric, definiteness = jnp.eye(n, dtype=dtype), jnp.ones((), dtype)
    if weight is not None:
        metric, added = _metric(weight, jacobian, scales, tolerance)
        to_metric, definiteness = _lower_inverse(metric)
    if rows == 0:
        tangent, nothing = to_metric.T * scales[:, None], jnp.zeros((n, 0), dtype)
        return SaddleInverse(
            tangent @ tangent.T, nothing, nothing[:0], tangent, jnp.zeros((), int), jnp.ones((), dtype), definiteness
        )

    weighted, scale = _scaled(to_metric, jacobian)
    q, r, order = pivoted_qr(weighted)
    count = min(n, rows)
    active, distance = independent(r, tolerance, rank_nearby)
    identity = jnp.eye(count, dtype=dtype)
    triangle = jnp.where(active[:, None] & active[None, :], r[:, :count][:count], identity)
    # Undo the permutation and the scale of the rows, and the units of the speeds.
    chosen = order[:count]
    on_rows = jnp.where(active[:, None], upper_inverse(triangle), 0.0) * scale[chosen][:, None]
    rows_inverse = (jnp.arange(rows)[:, None] == chosen).astype(dtype) @ on_rows
    basis = scales[:, None] * (to_metric.T @ q)
    is_normal = jnp.zeros(n, bool).at[:count].set(active)
    tangent = jnp.where(is_normal, 0.0, basis)
    return SaddleInverse(
        tangent=tangent @ tangent.T,
        normal=jnp.where(is_normal, basis, 0.0)[:, :count] @ rows_inverse.T,
        compliance=rows_inverse @ rows_inverse.T - jnp.diag(added),
        basis=tangent,
        rank=jnp.sum(active),
        distance=distance,
        definiteness=definiteness,
    )


def _metric(weight, jacobian, scales, tolerance):
    """W = M + JᵀDJ in scales, positive definite where M is so on the tangent space only, and the diagonal of D."""
    weight, size = weight * scales[:, None] * scales[None, :], length(jacobian)
    # A row of rounding alone would add as much as any other, and is left out.
    square = jnp.where(size > tolerance * jnp.maximum(jnp.max(size, initial=0.0), 1.0), size**4, 0.0)
    # A row that moves massless bodies alone, but for rounding, takes the largest mass that there is.
    moves = jnp.where(jnp.abs(jacobian) > tolerance * size[:, None], jacobian, 0.0)
    moved = jnp.sum(moves**2 * jnp.diagonal(weight), axis=1)
    moved = jnp.where(moved > 0.0, moved, jnp.max(jnp.diagonal(weight), initial=0.0) * size**2)
    added = ratio(moved, square, 0.0)
    return weight + (jacobian.T * added) @ jacobian, added


def _scaled(to_metric, jacobian):
    """A = L⁻¹Jᵀ with columns rescaled to the norms of J's rows, and the factors of that."""
    weighted = to_metric @ jacobian.T
    scale = ratio(length(jacobian), length(weighted, axis=0), 1.0)
    return weighted * scale, scale


def independent(
    r: Float[Array, "n m"],
    tolerance: ScalarLike,
    rank_nearby: Int[Array | np.integer, ""] | int | None,
    largest: Float[Array, ""] | None = None,
) -> tuple[Bool[Array, " k"], Float[Array, ""]]:
    """Find the independent rows among the pivots of R, and the distance d.

    **Arguments:** `largest`: |R₁₁| of the whole, where `r` is that of a part.
    """
    diagonal = jnp.abs(jnp.diagonal(r))
    largest = diagonal[0] if largest is None else largest
    places = jnp.arange(len(diagonal))
    active = diagonal > tolerance * jnp.maximum(largest, 1.0)
    if rank_nearby is not None:
        active = active & (places < rank_nearby)
    last = (jnp.sum(active) if rank_nearby is None else rank_nearby) - 1
    smallest = jnp.sum(jnp.where(places == last, diagonal, 0.0))
    return active, jnp.where(last >= 0, ratio(smallest, largest, 0.0), 1.0)


def singularity_distance(
    weight: Float[Array, "n n"] | None,
    jacobian: Float[Array, "m n"],
    scales: Float[Array, " n"],
    tolerance: ScalarLike,
    islands: Islands,
    rank_nearby: Int[Array, " k"] | None = None,
) -> Float[Array, ""]:
    """`SaddleInverse.distance` of `invert_apart`, with derivatives as long as the pivots stay; none where d is zero."""
    each = _over_islands(_distance, weight, jacobian, scales, tolerance, islands, rank_nearby)
    return jnp.min(jnp.concatenate([jnp.ones(1, jacobian.dtype), *(found for *_, found in each)]))


def _distance(weight, jacobian, scales, tolerance, rank_nearby):
    (rows, n), jacobian = jacobian.shape, jacobian * scales[None, :]
    if rows == 0:
        return jnp.ones((), jacobian.dtype)
    to_metric = jnp.eye(n, dtype=jacobian.dtype)
    if weight is not None:
        to_metric, _ = cholesky_inverse_by_elimination(_metric(weight, jacobian, scales, tolerance)[0])
    weighted, _ = _scaled(to_metric, jacobian)
    _, r, order = pivoted_qr(lax.stop_gradient(weighted))
    active, found = independent(r, tolerance, rank_nearby)
    columns = weighted[:, order[: len(active)]]

    def orthogonalise(k, carry):
        """Take column k, of length |R_kk|, off those after it."""
        columns, sizes = carry
        size = jnp.where(active[k], length(jnp.where(active[k], columns[:, k], 1.0), axis=0), 1.0)
        along = jnp.where(active[k], columns[:, k] / size, 0.0)
        return columns - jnp.outer(along, along @ columns), sizes.at[k].set(size)

    _, sizes = lax.fori_loop(0, len(active), orthogonalise, (columns, jnp.ones(len(active), columns.dtype)))
    last = jnp.sum(active) - 1
    is_known = (last >= 0) & ((last + 1 == rank_nearby) if rank_nearby is not None else True)
    return jnp.where(is_known, sizes[last] / sizes[0], found)


def invert_apart(
    weight: Float[Array, "n n"] | None,
    jacobian: Float[Array, "m n"],
    scales: Float[Array, " n"],
    tolerance: ScalarLike,
    islands: Islands,
    rank_nearby: Int[Array, " k"] | None = None,
) -> SaddleInverse:
    """Invert each island (rows, columns) of a system that falls apart by itself, like `invert`.

    Islands of one shape are inverted in one batch. `rank_nearby` is given, and `rank` returned, for each island, (k,);
    `distance` and `definiteness` are the smallest.
    """
    (m, n), dtype = jacobian.shape, jacobian.dtype
    if len(islands) == 1:
        found = invert(weight, jacobian, scales, tolerance, None if rank_nearby is None else rank_nearby[0])
        return found._replace(rank=found.rank[None])
    groups = list(_over_islands(invert, weight, jacobian, scales, tolerance, islands, rank_nearby))
    of_all = lambda part: jnp.concatenate([getattr(found, part) for *_, found in groups])
    together = lambda shape, parts: assembled(
        shape, [((down[:, :, None], across[:, None, :]), block) for down, across, block in parts], dtype
    )
    return SaddleInverse(
        tangent=together((n, n), [(columns, columns, found.tangent) for _, _, columns, found in groups]),
        normal=together((n, m), [(columns, rows, found.normal) for _, rows, columns, found in groups]),
        compliance=together((m, m), [(rows, rows, found.compliance) for _, rows, _, found in groups]),
        basis=together((n, n), [(columns, columns, found.basis) for _, _, columns, found in groups]),
        rank=of_all("rank")[np.argsort(np.concatenate([index for index, *_ in groups]))],
        distance=jnp.min(of_all("distance"), initial=1.0),
        definiteness=jnp.min(of_all("definiteness"), initial=1.0),
    )


def _over_islands(function, weight, jacobian, scales, tolerance, islands, rank_nearby):
    """Map a function over islands, those of one shape in a batch.

    **Yields:** indices, rows and columns of such islands, and what the function gives.
    """
    groups = {}
    for index, (rows, columns) in enumerate(islands):
        groups.setdefault((len(rows), len(columns)), []).append((index, rows, columns))
    for members in groups.values():
        index, rows, columns = (np.array(part, dtype=int) for part in zip(*members, strict=True))
        across, down, up = columns[:, None, :], columns[:, :, None], rows[:, :, None]
        blocks = None if weight is None else weight[down, across]
        ranks = None if rank_nearby is None else rank_nearby[index]
        inputs = blocks, jacobian[up, across], scales[columns], tolerance, ranks
        axes = [None if blocks is None else 0, 0, 0, None, None if ranks is None else 0]
        yield index, rows, columns, jax.vmap(function, in_axes=axes)(*inputs)


def with_mass(inverse: SaddleInverse, mass: Float[Array, "n n"]) -> SaddleInverse:
    """Replace W by a mass matrix M on the same split; M needs to be definite on the tangent space alone."""
    mass = lax.stop_gradient(mass)
    basis = inverse.basis
    projected, is_empty = basis.T @ mass @ basis, jnp.sum(basis**2, axis=0) == 0.0
    largest = jnp.max(jnp.diagonal(projected), initial=0.0)
    empty = jnp.diag(jnp.where(is_empty, positive_or_one(largest), 0.0))
    to_basis, definiteness = _lower_inverse(projected + empty)
    root = to_basis @ basis.T
    tangent = root.T @ root
    normal = inverse.normal - tangent @ (mass @ inverse.normal)
    compliance = inverse.normal.T @ mass @ normal
    return inverse._replace(tangent=tangent, normal=normal, compliance=compliance, definiteness=definiteness)


def _lower_inverse(matrix):
    """L⁻¹ of a positive definite matrix L Lᵀ, and its definiteness (see `SaddleInverse`)."""
    inverse, diagonal = cholesky_inverse(matrix)
    own = jnp.diagonal(matrix)
    # A point mass that turns about itself has an inertia of rounding squared.
    own = jnp.maximum(own, jnp.finfo(own.dtype).eps * jnp.max(own, initial=0.0))
    return inverse, jnp.min(ratio(diagonal**2, own, 0.0), initial=1.0)
