"""The constrained solve front by front, in time proportional to the number of loops that follow each other.

It does what `linkax.linalg.saddle_inverse.invert` does at once, in the order of an `elimination_plan`. A
column-pivoted QR of a front's rows splits its speeds, and what motions of the fronts before still affect it, into a
normal and a tangent space. The tangent space is turned so that few directions affect the speeds passed on; these go on
to the next front, and of the others the dynamics are solved. All turns are orthogonal in scales, so that nothing grows
from front to front, and ranks are found in any singular configuration.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from linkax.linalg.elimination_plan import EliminationPlan
from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.linalg.saddle_inverse import SaddleInverse, independent
from linkax.linalg.static_sparse import StaticSparse, constant_product
from linkax.linalg.triangular import cholesky_inverse, upper_inverse
from linkax.spatial.vectors import length
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import ratio


class Blocks(NamedTuple):
    """The entries of J and M by front; a front reads s speeds of its separator and p of its interior, in m rows.

    - `rows`: J, (k, m, s + p). `coupling`: M between separator and interior, (k, s, p). `own`: M of the interior, (k,
      p, p).
    """

    rows: Float[Array, "k m width"]
    coupling: Float[Array, "k s p"]
    own: Float[Array, "k p p"]


class BlockInverse(eqx.Module):
    """The inverse of [[M, −Jᵀ], [J, 0]] on the independent rows of J, by what each front passes on.

    Speeds, and forces along them, are in scales. Forwards go the load on the directions passed on and the part of the
    separator's speeds that is decided; backwards the motion along these directions and the force on the separator's
    speeds. Both are linear in what comes in and in the front's own f and γ.

    - `forwards`: (k, 2s, 2s + p + m). `backwards`: (k, 2s + p + m, 4s + p + m).
    - `last`: inverse of the metric of the directions after the last front, (s, s).
    - `rank`, (k,), `distance`, `definiteness`: see `linkax.linalg.saddle_inverse.SaddleInverse`.
    """

    plan: EliminationPlan = eqx.field(static=True)
    scales: Float[Array, " n"]
    forwards: Float[Array, "k passed known"]
    backwards: Float[Array, "k found inputs"]
    last: Float[Array, "s s"]
    rank: Int[Array, " k"]
    distance: Float[Array, ""]
    definiteness: Float[Array, ""]

    def apply(self, f: Float[Array, " n"], gamma: Float[Array, " m"]) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Solve for (a, λ)."""
        plan, kept = self.plan, self.last.shape[0]
        added = plan.interior_table.shape[1]
        own = _read(self.scales * f, plan.interior_table), _read(gamma, plan.row_table)
        nothing = jnp.zeros(2 * kept, f.dtype)

        def forwards(passed, front):
            matrix, (f, gamma) = front
            known = jnp.concatenate([f, passed, gamma])
            return matrix @ known, known

        passed, known = lax.scan(forwards, nothing, (self.forwards, own))
        along = self.last @ passed[:kept]

        def backwards(returned, front):
            matrix, known = front
            found = matrix @ jnp.concatenate([returned, known])
            return found[: 2 * kept], found[2 * kept :]

        returned = jnp.concatenate([jnp.zeros(kept, along.dtype), along])
        _, found = lax.scan(backwards, returned, (self.backwards, known), reverse=True)
        a = self.scales * _gathered(found[:, :added], plan.interior_table, f.shape[0])
        return a, _gathered(found[:, added:], plan.row_table, gamma.shape[0])


# Factors of the constrained solve, at once or front by front.
Factors = SaddleInverse | BlockInverse


def invert_by_blocks(
    blocks: Blocks,
    scales: Float[Array, " n"],
    tolerance: ScalarLike,
    plan: EliminationPlan,
    rank_nearby: Int[Array, " k"] | None = None,
) -> BlockInverse:
    """Invert like `linkax.linalg.saddle_inverse.invert`, front by front; `rank_nearby` of each front, (k,)."""
    blocks, scales = lax.stop_gradient((blocks, scales))
    kept_scales, added_scales = (_read(scales, table) for table in (plan.separator_table, plan.interior_table))
    absent = jnp.asarray(plan.interior_table < 0, scales.dtype)
    blocks = Blocks(
        rows=blocks.rows * jnp.concatenate([kept_scales, added_scales], axis=1)[:, None, :],
        coupling=blocks.coupling * kept_scales[:, :, None] * added_scales[:, None, :],
        own=blocks.own * added_scales[:, :, None] * added_scales[:, None, :] + jax.vmap(jnp.diag)(absent),
    )
    dtype, (fronts, rows, width), kept = scales.dtype, blocks.rows.shape, blocks.coupling.shape[1]
    known = jnp.full(fronts, min(rows, width)) if rank_nearby is None else rank_nearby
    here = _Here(kept, jnp.max(length(blocks.rows)), tolerance, rank_nearby is not None)
    begin = _Passed(jnp.zeros((kept, kept), dtype), jnp.eye(kept, dtype=dtype), jnp.ones(kept, dtype))
    passed, found = lax.scan(here.eliminate, begin, (blocks, jnp.asarray(plan.passed_on, dtype), known))
    last, definiteness = _definite(passed.metric, passed.size)
    return BlockInverse(
        plan=plan,
        scales=scales,
        forwards=found.forwards,
        backwards=found.backwards,
        last=last.T @ last,
        rank=found.rank,
        distance=jnp.min(found.distance),
        definiteness=jnp.minimum(definiteness, jnp.min(found.definiteness)),
    )


def in_fronts(plan: EliminationPlan, weight: StaticSparse, jacobian: StaticSparse) -> Blocks:
    """Read the entries of M and J of each front."""
    kept, added = plan.separator_table, plan.interior_table
    return Blocks(
        rows=_blocks(jacobian, plan.row_table, plan.table),
        coupling=_blocks(weight, kept, added),
        own=_blocks(weight, added, added),
    )


def with_identity_metric(blocks: Blocks, plan: EliminationPlan, scales: Float[Array, " n"]) -> Blocks:
    """Replace M by the identity metric, which measures speeds in their scales."""
    own = jax.vmap(jnp.diag)(jnp.where(plan.interior_table < 0, 0.0, _read(scales, plan.interior_table) ** -2))
    return Blocks(blocks.rows, jnp.zeros_like(blocks.coupling), own)


class SaddlePointInFronts(eqx.Module):
    """The matrix [[M, −Jᵀ], [J, 0]], as a function of (a, λ) in one vector, (n,) and (m,) of `sizes`."""

    blocks: Blocks
    plan: EliminationPlan = eqx.field(static=True)
    sizes: tuple[int, int] = eqx.field(static=True)

    def __call__(self, unknowns: Float[Array, " k"]) -> Float[Array, " k"]:
        blocks, (table, rows), (n, m) = self.blocks, (self.plan.table, self.plan.row_table), self.sizes
        coupled = jnp.pad(blocks.coupling, ((0, 0), (0, 0), (blocks.coupling.shape[1], 0)))
        own = jnp.concatenate([jnp.swapaxes(blocks.coupling, 1, 2), blocks.own], axis=2)
        weight = jnp.concatenate([coupled, own], axis=1)
        a, multipliers = _read(unknowns[:n], table), _read(unknowns[n:], rows)
        force = _times(weight, a) - _times(jnp.swapaxes(blocks.rows, 1, 2), multipliers)
        along = constant_product(self.plan.read_table.ravel() == np.arange(n)[:, None], force.reshape(-1))
        return jnp.concatenate([along, _gathered(_times(blocks.rows, a), rows, m)])


class _Passed(NamedTuple):
    """What a front passes on: separator speeds along each direction, (s, s), their metric, its size without loss."""

    along: Float[Array, "s s"]
    metric: Float[Array, "s s"]
    size: Float[Array, " s"]


class _Eliminated(NamedTuple):
    forwards: Float[Array, "passed known"]
    backwards: Float[Array, "found inputs"]
    rank: Int[Array, ""]
    distance: Float[Array, ""]
    definiteness: Float[Array, ""]


class _Here(NamedTuple):
    """The number of separator speeds, the length of the longest row, and how independent rows are told."""

    kept: int
    size: Float[Array, ""]
    tolerance: ScalarLike
    is_known: bool

    def eliminate(
        self, passed: _Passed, front: tuple[Blocks, Float[Array, "s width"], Int[Array, ""]]
    ) -> tuple[_Passed, _Eliminated]:
        """Eliminate one front: y are the directions passed on and the interior speeds."""
        blocks, onward, rank = front
        kept, (rows, width) = self.kept, blocks.rows.shape
        added, count, dtype = width - kept, min(rows, width), blocks.rows.dtype
        of_kept = blocks.rows[:, :kept]
        reads = jnp.concatenate([of_kept @ passed.along, blocks.rows[:, kept:]], axis=1)
        moves = jnp.concatenate([onward[:, :kept] @ passed.along, onward[:, kept:]], axis=1)
        coupling = passed.along.T @ blocks.coupling
        metric = jnp.block([[passed.metric, coupling], [coupling.T, blocks.own]])
        size = jnp.concatenate([passed.size, jnp.diagonal(blocks.own)])

        q, r, order = pivoted_qr(reads.T)
        active, distance = independent(r, self.tolerance, rank if self.is_known else None, self.size)
        identity = jnp.eye(count, dtype=dtype)
        triangle = jnp.where(active[:, None] & active[None, :], r[:count, :count], identity)
        chosen = (order[:count, None] == jnp.arange(rows)).astype(dtype)
        # n = P (γ - ...): motion in the normal space that rows ask for.
        asked = upper_inverse(triangle).T @ jnp.where(active[:, None], chosen, 0.0)
        # Normal directions last, so that turning the others leaves them as they are.
        q, asked = q[:, ::-1], asked[::-1]
        places = jnp.arange(width)
        is_normal = places >= width - jnp.sum(active)
        basis = q @ pivoted_qr(jnp.where(is_normal[:, None], 0.0, (moves @ q).T)).q
        passes = (places < kept) & ~is_normal
        stays = (places >= kept) & ~is_normal
        moves = moves @ basis
        metric = basis.T @ metric @ basis
        inside = jnp.where(stays[:, None] & stays[None, :], metric, jnp.diag(jnp.where(stays, 0.0, 1.0)))
        size = size @ basis**2
        root, definiteness = _definite(inside, jnp.where(stays, size, 1.0))
        solved = jnp.where(stays[:, None] & stays[None, :], root.T @ root, 0.0)
        to_stay = solved @ metric  # A H: what staying directions do when others move

        # Each by what it depends on, in columns: f, the load and the decided speeds passed on, γ. Loads need no γ, the
        # normal space neither f nor loads.
        of_normal, ahead = metric[:, width - count :], ((0, 0), (added + kept, 0))
        of_loads = jnp.concatenate([basis[kept:].T, basis[:kept].T, -basis[kept:].T @ blocks.coupling.T], axis=1)
        normally = jnp.concatenate([-asked @ of_kept, asked], axis=1)
        remaining = jnp.pad(of_loads, ((0, 0), (0, rows))) - jnp.pad(of_normal @ normally, ahead)
        staying = solved @ remaining
        on = jnp.where(passes[:kept, None], remaining[:kept] - metric[:kept] @ staying, 0.0)
        asks = jnp.pad(onward[:, :kept], ((0, 0), (0, rows))) + moves[:, width - count :] @ normally
        forwards = jnp.concatenate([on, jnp.pad(asks, ahead)])

        # The same, and before that the force on the speeds passed on, and the motion along directions passed on.
        onwards = jnp.where(passes[:kept], jnp.eye(width, kept, dtype=dtype) - to_stay[:, :kept], 0.0)
        along_normal = jnp.pad(normally, ((width - count, 0), (added + kept, 0)))
        motion = jnp.concatenate([onwards, staying + along_normal], axis=1)
        held = of_normal.T @ motion - jnp.pad(of_loads[width - count :], ((0, 0), (kept, rows)))
        multipliers = asked.T @ jnp.concatenate([-moves[:, width - count :].T, held], axis=1)
        y = jnp.pad(basis @ motion, ((0, 0), (kept, 0)))
        others = ((0, 0), (0, y.shape[1] - kept))
        back = jnp.pad(onward[:, :kept].T, others) + of_kept.T @ multipliers - blocks.coupling @ y[kept:]
        backwards = jnp.concatenate([back, y, multipliers])

        passes = passes[:kept]
        condensed = metric[:kept, :kept] - metric[:kept] @ to_stay[:, :kept]
        both = passes[:, None] & passes[None, :]
        following = _Passed(
            along=jnp.where(passes, moves[:, :kept], 0.0),
            metric=jnp.where(both, condensed, jnp.diag(jnp.where(passes, 0.0, 1.0))),
            size=jnp.where(passes, size[:kept], 1.0),
        )
        return following, _Eliminated(forwards, backwards, jnp.sum(active), distance, definiteness)


def _times(matrices, vectors):
    return jnp.sum(matrices * vectors[:, None, :], axis=-1)


def _definite(metric, size):
    """L⁻¹ of a metric L Lᵀ, and min L_kk² / size_k: one without cancellation, zero for a singular metric."""
    root, diagonal = cholesky_inverse(metric)
    return root, jnp.min(ratio(diagonal**2, size, 0.0), initial=1.0)


def _read(values, table):
    """Read values (n,) at the indices of a table, zero at −1."""
    return jnp.concatenate([values, jnp.zeros(1, values.dtype)])[table]  # -1 and beyond the end


def _blocks(matrix, down, across):
    down, across = down[:, :, None], across[:, None, :]
    return jnp.where((down >= 0) & (across >= 0), matrix.at(down, across), 0.0)


def _gathered(found, table, size):
    """Put values of fronts, (k, p), in the order of a table's indices; zero for what it does not name."""
    source = np.full(size, table.size)
    source[table[table >= 0]] = np.flatnonzero(table.ravel() >= 0)
    return _read(found.reshape(-1), source)
