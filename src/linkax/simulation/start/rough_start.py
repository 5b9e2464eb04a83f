"""Where the search for closed loops begins, when a guess says roughly where bodies are in the world.

Levenberg-Marquardt from several starts at once, and the best of what they reach. (Marquardt, Journal of the Society for
Industrial and Applied Mathematics 11, 1963.)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.coordinates import retract, speeds
from linkax.model.topology import Topology
from linkax.simulation.start.closing import LONGEST_STEP, LoopClosure
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import strains_of
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from scalarjit import scalarised

STARTS = 24
STEPS, LAST_STEPS = 60, 20
LOOSE = 1e-2  # weight of coordinates that are not given, next to the loops and to those that are; none in last steps
DAMPING, LEAST_DAMPING, LESS, MORE = 1e-2, 1e-9, 0.3, 4.0


def rough_start(
    demand: LoopClosure, rough: JointValues, begin: Float[Array, " n_q"], given: Bool[np.ndarray, " n_v"]
) -> Float[Array, " n_q"]:
    """Find coordinates at which the loops are nearly closed, and cut joints, those that measure too, nearly as guessed.

    **Arguments:** `demand`: the loops, and what is held; `rough`: the guess; `begin`: coordinates of the joints in the
    tree, as given or where frames coincide; `given`: which of them are given.
    """
    system, fit = demand.system, _Fit.of(demand, rough, begin, given)
    starts = jax.vmap(lambda aside: retract(system.topology, begin, aside))(
        beside(demand, given, anywhere(STARTS, len(given)))
    )
    found, misses = jax.vmap(scalarised(fit.descend))(starts)
    return unwound(demand, found[jnp.argmin(misses)], begin)


class _Fit(eqx.Module):
    """Least squares of loop rows, of what is held, of the guess, and of the way from `begin`.

    - `demand`: all but the last of these, as rows; `weights`: of these. `keeps`: weights of that way, `given` where
      coordinates are; of the others it is little, to choose among starts, and then none, so as not to bias the guess.
    """

    demand: LoopClosure
    weights: Array
    begin: Array
    keeps: Array
    given: Array

    @staticmethod
    def of(demand: LoopClosure, rough: JointValues, begin: Array, given: Bool[np.ndarray, " n_v"]) -> "_Fit":
        system = demand.system
        both = JointValues((*demand.held.groups, *rough.groups), (*demand.held.values, *rough.values))
        slides = np.concatenate([demand.held.slides(), rough.slides()])
        all_ = LoopClosure(system, demand.t, both)
        count = jax.eval_shape(all_.rows_at, begin).size - len(slides)
        weights = jnp.concatenate([jnp.ones(count), jnp.where(slides, 1.0 / system.length, 1.0)])
        keeps = jnp.where(given, 1.0, LOOSE) / system.scales
        return _Fit(all_, weights, begin, keeps, jnp.asarray(given))

    def _all(self, q, rows, keeps):
        way = speeds(self.demand.system.topology, q, q - self.begin)
        return jnp.concatenate([self.weights * rows, keeps * way])

    def descend(self, q: Float[Array, " n_q"]) -> tuple[Float[Array, " n_q"], Float[Array, ""]]:
        """Find coordinates from which no step leads down, and the sum of squares where the last steps began."""
        system, squared = self.demand.system, lambda rows: jnp.sum(rows * rows)
        moves = jnp.asarray(system.scales).at[strains_of(system)].set(0.0)

        def improve(count, state):
            q, missed, damping = state
            is_last = count >= STEPS
            keeps = jnp.where(is_last & ~self.given, 0.0, self.keeps)
            damping = jnp.where(count == STEPS, DAMPING, damping)
            rows, slopes = self.demand.linearised(q)
            rows, slopes = self._all(q, rows, keeps), jnp.concatenate([self.weights[:, None] * slopes, jnp.diag(keeps)])
            slopes = slopes * moves
            normal = slopes.T @ slopes + damping * jnp.eye(len(moves))
            step = jax.scipy.linalg.solve(normal, -(rows @ slopes), assume_a="pos")
            step = step * jnp.minimum(1.0, ratio(LONGEST_STEP, jnp.max(jnp.abs(step))))
            tried = retract(system.topology, q, moves * step)
            here, reached = squared(rows), squared(self._all(tried, self.demand.rows_at(tried), keeps))
            falls = reached < here
            damping = jnp.where(falls, jnp.maximum(LESS * damping, LEAST_DAMPING), MORE * damping)
            missed = jnp.where(is_last, missed, jnp.where(falls, reached, here))
            return jnp.where(falls, tried, q), missed, damping

        begin = (q, jnp.asarray(jnp.inf, q.dtype), jnp.asarray(DAMPING, q.dtype))
        found, missed, _ = lax.fori_loop(0, STEPS + LAST_STEPS, improve, begin)
        return found, missed


def anywhere(count: int, size: int, seed: int = 0) -> Float[np.ndarray, "{count} {size}"]:
    """Random numbers from -1 to 1, with a first row of zeros."""
    numbers = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(count, size))
    numbers[0] = 0.0
    return numbers


def beside(
    demand: LoopClosure, given: Bool[np.ndarray, " n_v"], numbers: Float[Array, "count n_v"]
) -> Float[Array, "count n_v"]:
    """Changes that lead from one guess to many, by numbers from -1 to 1: any angles, and lengths of the mechanism."""
    system = demand.system
    still = given | np.isin(np.arange(len(given)), strains_of(system))
    return jnp.where(still, 0.0, jnp.where(system.topology.slides, system.length, np.pi) * numbers)


def given_in_tree(topology: Topology, *values: JointValues) -> Bool[np.ndarray, " n_v"]:
    """Which coordinates of joints in the tree have values, one for each speed."""
    groups = [alike for of in values for alike in of.groups if alike.in_tree]
    columns = [topology.columns_of(along) for alike in groups for along in alike.terms]
    return np.isin(np.arange(topology.num_speeds), np.concatenate([np.zeros(0, int), *columns]))


def unwound(demand: LoopClosure, q: Float[Array, " n_q"], begin: Float[Array, " n_q"]) -> Float[Array, " n_q"]:
    """Coordinates without whole turns from `begin`, of hinges that no constraint counts the turns of."""
    topology = demand.system.topology
    counted = {term.joint for terms in topology.constraint_terms for term in terms}
    turning = np.zeros(topology.num_speeds, dtype=bool)
    for name, kind in zip(topology.coordinates, topology.joint_types, strict=False):
        if kind.motion is None and not kind.is_screw and name not in counted:
            turning[topology.speeds[name]] = np.array(kind.speed_units) == "rad"
    of_plain = turning[topology.plain[:, 1]]
    places = topology.plain[of_plain, 0]
    turns = jnp.round((q[places] - begin[places]) / (2.0 * np.pi))
    return jnp.asarray(q).at[places].add(-2.0 * np.pi * turns)
