"""Speeds that the loops allow, with some of them held; in a singular configuration on a branch of the motion."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.configuration import Configuration, configure
from linkax.equations.loops import rate
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.linalg.saddle_inverse import invert
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.closing import CLOSED
from linkax.simulation.start.initial_state import ON_BRANCH
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import nearest_solution, rank_tolerance
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import materialise, positive_or_one, pushforward, ratio
from linkax.xla.tracing import jit_inline, without_derivatives
from scalarjit import scalarised

TURNS = 30  # of Newton's method: from close to where y² = x² is flat, each but halves the way
BESIDE = 1e-2
SEEN_ULPS = 100.0  # of rows that are not rounding alone
STARTS = 12  # from which other branches are looked for
SPREAD = 4.0  # of these, next to the speeds asked
APART = 1e-3  # of the largest speed: what tells branches apart


class _Asked(eqx.Module):
    """The equations for speeds, over `scale`: rows @ v = right (loops, and speeds held), and v on a branch."""

    split: ConstraintSplit
    rows: Array
    right: Array
    scale: Array

    def rest(self, v: Float[Array, " n_v"]) -> Float[Array, " n"]:
        """The residual of the equations at speeds v."""
        return jnp.concatenate([self.right - self.rows @ v, -self.split.off_branch(v, self.scale)])

    @property
    def system(self) -> System:
        return self.split.configuration.system

    def slopes(self, v: Float[Array, " n_v"]) -> Float[Array, "n n_v"]:
        return -jax.jacfwd(self.rest)(v)

    def next_to(self, v: Float[Array, " n_v"], tolerance: Scalar | None = None) -> Float[Array, " n_v"]:
        """The speeds nearest to v that satisfy the rows, on a branch or not."""
        return nearest_solution(self.system, v, self.rows, self.right, tolerance)

    def smallest(self) -> Float[Array, " n_v"]:
        """The smallest speeds that satisfy the rows."""
        return self.next_to(jnp.zeros_like(self.system.scales))

    def missed(self, v: Float[Array, " n_v"]) -> Float[Array, ""]:
        """The largest miss of the rows."""
        return largest(self.right - self.rows @ v)

    def aside(self, count: int) -> Float[Array, "{count} n_v"]:
        """Other speeds that satisfy the rows, on a branch or not, (count, n_v)."""
        anywhere = SPREAD * np.random.default_rng(0).normal(size=(count, len(self.system.scales)))
        return jax.vmap(self.next_to)(jnp.asarray(anywhere, self.right.dtype) * self.system.scales)

    def least(self) -> tuple[Float[Array, " n_v"], Bool[Array, ""]]:
        """The smallest speeds that satisfy the rows; close to a singular configuration those on the branch of the
        position.

        Also whether other branches may cross there, between which the position does not decide.
        """
        least, scales = self.smallest(), self.system.scales
        within = self.next_to(jnp.zeros_like(scales), SEEN_ULPS * jnp.finfo(scales.dtype).eps)
        off = jax.vmap(self.off_branch)(jnp.stack([within, self.aside(1)[0]]))
        told = (self.missed(within) <= CLOSED) & (off[0] <= BESIDE)
        told_apart = told & (self.system.fastest(within - least) > APART * self.system.fastest(within))
        moves = largest(self.right) > 0.0
        return jnp.where(told, within, least), moves & (off[1] > BESIDE) & jnp.logical_not(told_apart)

    def off_branch(self, v: Float[Array, " n_v"]) -> Float[Array, ""]:
        """How far speeds are from a branch, over the square of the largest."""
        off = self.split.seen(self.split.off_branch(v, self.scale), self.split.driven(v, self.scale))
        return ratio(largest(off), self.system.fastest(v) ** 2, 0.0)


@eqx.filter_custom_jvp
def _on_branch(asked, v):
    """Find speeds on a branch by Newton steps from a little beside v, which may lie just between two branches."""
    beside = BESIDE * jnp.sum(asked.split.inverse.basis, axis=1)
    off = asked.off_branch(v) > ON_BRANCH * rank_tolerance(v.dtype)
    # As many each time: with a loop that ends sooner XLA (jaxlib 0.10) finds no callbacks in the rest of the program.
    return lax.fori_loop(0, TURNS, lambda _, v: _turn(asked, v), v + jnp.where(off, beside, 0.0))


@jit_inline
def _turn(asked, v):
    return v + nearest_solution(asked.system, jnp.zeros_like(v), asked.slopes(v), asked.rest(v))


@_on_branch.def_jvp
def _on_branch_jvp(primals, tangents):
    """Tangent by the implicit function theorem, to any order: the Newton steps have no derivative."""
    (asked, begin), (change, begins) = primals, tangents
    v = _on_branch(asked, begin)
    opens = pushforward(lambda asked: asked.rest(v), (asked,), (change,))[1]
    return v, nearest_solution(asked.system, materialise(v, begins), asked.slopes(v), opens)


def _asked(configuration, held):
    system = configuration.system
    split = ConstraintSplit.of(configuration, rank_tolerance(system.dtype))
    right = jnp.concatenate([rate(configuration), held.flat()])
    scale = lax.stop_gradient(positive_or_one(jnp.maximum(largest(right), split.slowest())))
    of_held = lambda v: held.speeds(move(configuration, v))
    rows = jnp.concatenate([split.jacobian, held.slopes(of_held, system.topology, system.dtype)])
    return _Asked(split, rows, right / scale, scale)


class FoundSpeeds(NamedTuple):
    """Speeds that the loops allow, with those of some joints held. Only `v` has derivatives.

    - `v`: speeds, (n_v,). `misses`: how far the smallest speeds that the loops allow are from those held, by joint.
    - `off_branch`: how far v are from a branch, relative to themselves. `undecided`: whether branches may cross.
    """

    v: Float[Array, " n_v"]
    misses: JointValues
    off_branch: Float[Array, ""]
    undecided: Bool[Array, ""]


@jit_inline
def smallest_speeds(configuration: Configuration, held: JointValues) -> FoundSpeeds:
    """Find the smallest speeds with those of some joints held: where the rank of J is constant, all lie on a branch."""
    asked = _asked(configuration, held)
    v = asked.smallest()
    off = jax.vmap(asked.off_branch)(jnp.stack([v, asked.aside(1)[0]]))
    on_branch = (jnp.max(off) <= ON_BRANCH * rank_tolerance(v.dtype)) & (asked.missed(v) <= CLOSED)
    return _found(asked, held, v, v, off[0], (largest(asked.right) > 0.0) & jnp.logical_not(on_branch))


@jit_inline
def speeds_on_branch(configuration: Configuration, held: JointValues) -> FoundSpeeds:
    """Find the smallest speeds with those of some joints held, or, near them, speeds on a branch of the motion.

    Speeds satisfy J v = b, and γ(v, v) is in the range of J; where the rank of J is constant, the
    smallest do.
    """
    asked = _asked(configuration, held)
    least, undecided = asked.least()
    v = _on_branch(asked, least)
    return _found(asked, held, least, v, asked.off_branch(v), undecided)


@jit_inline
def speeds_again(
    configuration: Configuration, held: JointValues, v: Float[Array, " n_v"], branches: bool
) -> Float[Array, " n_v"]:
    """Find the speeds v again, (n_v,), for their derivatives."""
    asked = _asked(configuration, held)
    return asked.scale * (_on_branch(asked, v / asked.scale) if branches else asked.smallest())


def _found(asked, held, least, v, off_branch, undecided):
    given = asked.scale * v
    asked, least, v, off_branch = without_derivatives((asked, least, v, off_branch))
    # What the loops leave of them: a row that is nearly none opens little, and yet may allow no motion at all.
    split, scale = asked.split, asked.scale
    opened = split.jacobian @ least - asked.right[: split.jacobian.shape[0]]
    reached = held.speeds(move(split.configuration, scale * (least - split.inverse.normal @ opened)))
    misses = jax.tree.map(jnp.subtract, reached, held)
    return FoundSpeeds(given, misses, jnp.maximum(off_branch, asked.missed(v)), undecided)


@scalarised
def other_speeds(
    mechanism: Mechanism, held: JointValues, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> tuple[Float[Array, "k n_v"], Bool[Array, " k"]]:
    """Speeds on other branches than v, with those of joints held: candidates, (k, n_v), and which of them are valid."""
    configuration = configure(system_of(mechanism, q.dtype), t, q)
    asked = _asked(configuration, held)
    tolerance = rank_tolerance(q.dtype)

    def found(begin):
        other = _on_branch(asked, begin)
        off = jnp.maximum(asked.off_branch(other), asked.missed(other))
        # Speeds beside it on its own branch differ, too, where more than what is asked can move.
        decided = invert(None, asked.slopes(other), asked.system.scales, tolerance).rank == len(v)
        apart = asked.system.fastest(asked.scale * other - v) > APART * asked.system.fastest(v)
        return asked.scale * other, (off <= ON_BRANCH * tolerance) & decided & apart

    return lax.map(found, asked.aside(STARTS))
