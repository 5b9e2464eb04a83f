"""Coordinates that close the loops, with those of some joints held."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.configuration import Configuration, configure
from linkax.equations.coordinates import rates, retract, speeds
from linkax.equations.gaps import as_if_closed, flips
from linkax.equations.loops import jacobian, residual
from linkax.equations.system import System
from linkax.linalg.while_falling import while_falling
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import elastic_energy, nearest_solution, nearest_solution_in, strains_of
from linkax.xla.arrays import Array
from linkax.xla.derivatives import pushforward, ratio
from linkax.xla.static_scatter import scatter_static
from linkax.xla.tracing import jit_inline

MOST_STEPS = 100
# Share of what is open that a step closes at least: a hundred of less do not close it, and loops that cannot be closed
# took 100 steps from each start, to the same nearest miss, where 15 do.
LEAST_FALL = 1e-4
LONGEST_STEP = 0.7  # radians, or lengths of the mechanism
STEP_FRACTIONS = 0.5 ** np.arange(6)
ROUNDING_ULPS = 8.0  # of residuals: a state that misses by no more stays as it is
CLOSED = 1e-9  # remaining gap, relative to the mechanism's length
# Starts of the search beside the guess, by which it leaves a saddle of the gap, or a bad guess.
ATTEMPTS = np.array([0.0, 1e-2, 1e-1, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0, 1.0, 1.5, 1.5, 1.5, 1.5, 3.0, 3.0, 3.0, 3.0])
# The same where strains move too, and what these count for next to the rows, little; where that stops short, nothing.
STRAINED = np.array([[0.0, 1e-2, 1e-2, 0.0, 1e-2, 1e-2], [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]])


class LoopClosure(eqx.Module):
    """The problem of closing the loops at time t, with coordinates of some joints held at values."""

    system: System
    t: Array
    held: JointValues

    def rows(self, configuration: Configuration) -> Float[Array, " n"]:
        """All residuals: loop rows, flipped axes, misses."""
        return jnp.concatenate(
            [residual(configuration), flips(configuration)[0], self.held.apart(configuration).flat()]
        )

    @jit_inline
    def linearised(self, q: Float[Array, " n_q"]) -> tuple[Float[Array, " n"], Float[Array, "n n_v"]]:
        """The residuals and their derivative where the loops are closed; elsewhere the direction that closes them."""
        topology, configuration = self.system.topology, configure(self.system, self.t, q)
        moved = lambda change: configure(self.system, self.t, retract(topology, q, change))
        held = self.held.slopes(lambda change: self.held.apart(moved(change)), topology, q.dtype)
        close_loops = as_if_closed(configuration)
        slopes = jacobian(close_loops)
        if np.any(topology.slips):  # which hold no places
            slopes = jnp.where(topology.slips[:, None], 0.0, slopes)
        return self.rows(configuration), jnp.concatenate([slopes, flips(close_loops)[1], held])

    @jit_inline
    def rows_at(self, q: Float[Array, " n_q"]) -> Float[Array, " n"]:
        """All residuals at coordinates."""
        return self.rows(configure(self.system, self.t, q))

    @jit_inline
    def size(self, q: Float[Array, " n_q"]) -> Float[Array, ""]:
        """The size of all residuals."""
        return _size(self.rows(configure(self.system, self.t, q)))

    @jit_inline
    def newton(
        self, rows: Float[Array, " n"], slopes: Float[Array, "n n_v"], back: Float[Array, " n_v"]
    ) -> Float[Array, " n_v"]:
        """The change nearest to `back` that closes the loops, where nothing is elastic."""
        return nearest_solution(self.system, back, slopes, -rows)

    def back(self, q: Float[Array, " n_q"], guess: Float[Array, " n_q"]) -> Float[Array, " n_v"]:
        """The change that undoes the change of strains since a guess."""
        change = speeds(self.system.topology, q, guess - q)
        strains = strains_of(self.system)
        return scatter_static(jnp.zeros_like(change), strains, change[strains])

    def metrics(self) -> Float[Array, "2 n_v n_v"]:
        """Two metrics, in radians and lengths, with strains by energy, over that of the softest or of the hardest
        strain.
        """
        strains, scales = strains_of(self.system), self.system.scales
        energy = elastic_energy(self.system)
        sizes = jnp.diagonal(energy) * scales[strains] ** 2
        of = lambda size: jnp.diag(scales**-2).at[np.ix_(strains, strains)].set(energy / size)
        return jax.vmap(of)(jnp.stack([jnp.min(sizes), jnp.max(sizes)]))

    def descent(self, rows: Float[Array, " n"], slopes: Float[Array, "n n_v"]) -> Float[Array, " n_v"]:
        """The steepest descent of the squared residuals, without strains, as long as their linearisation says."""
        strains = strains_of(self.system)
        downhill = scatter_static(
            -(self.system.scales**2) * (rows @ slopes), strains, jnp.zeros(len(strains), rows.dtype)
        )
        change = slopes @ downhill
        scale = jnp.sum(change * change)
        return downhill * ratio(-(rows @ change), scale, 0.0)

    def meet(
        self,
        q: Float[Array, " n_q"],
        guess: Float[Array, " n_q"],
        moves: Bool[Array, " n_v"],
        weight: Float[Array, ""],
    ) -> tuple[Float[Array, " n_q"], Float[Array, ""]]:
        """Take damped Newton steps from q until residuals and strains vanish or stop falling; descend where those fail.

        **Arguments:** `guess`: coordinates whose strains they lead back to; `moves`: which coordinates they change;
        `weight`: of strains in radians and lengths of the mechanism, next to the residuals.

        **Returns:** the coordinates reached, and the size of the residuals there.
        """
        metrics = self.metrics() if len(strains_of(self.system)) else None
        small = ROUNDING_ULPS * jnp.finfo(q.dtype).eps

        def newton(rows, slopes, back):
            if metrics is None:
                return self.newton(rows, slopes, back)[None]
            return jax.vmap(lambda metric: nearest_solution_in(metric, self.system.scales, back, slopes, -rows))(
                metrics
            )

        def strained(q):
            back = self.back(q, guess)
            return jnp.zeros((), q.dtype) if metrics is None else weight * jnp.sqrt(back @ metrics[1] @ back)

        def improve(state, _):
            q, _ = state
            rows, slopes = self.linearised(q)
            slopes = jnp.where(moves, slopes, 0.0)
            steps = [
                newton(rows, slopes, jnp.where(weight > 0.0, self.back(q, guess), 0.0)),
                self.descent(rows, slopes)[None],
            ]
            steps = jnp.concatenate(steps)
            longest = jax.vmap(self.system.fastest)(steps)
            steps = steps * jnp.minimum(1.0, ratio(LONGEST_STEP, longest))[:, None]
            changes = (STEP_FRACTIONS[:, None, None] * steps).reshape(-1, steps.shape[1])
            tries = jax.vmap(lambda change: retract(self.system.topology, q, change))(changes)
            tries = jnp.concatenate([tries, q[None]])
            sizes = jax.vmap(self.size)(tries)
            misses = sizes + jax.vmap(strained)(tries)
            # Next to a singular configuration a change of rounding is amplified, and closes nothing.
            best = jnp.where(misses[-1] <= small, len(tries) - 1, jnp.argmin(misses))
            return (tries[best], sizes[best]), misses[best]

        # Strains go on falling, slowly, where the loops are closed.
        least_fall = LEAST_FALL if metrics is None else 0.0
        return while_falling(improve, (q, jnp.asarray(jnp.inf, q.dtype)), MOST_STEPS, small, q.dtype, least_fall)

    def search(self, q: Float[Array, " n_q"]) -> Float[Array, " n_q"]:
        """Find coordinates that close the loops, from q, or else from beside it; those nearest to it where none do."""
        fixed = np.isin(np.arange(self.system.topology.num_speeds), strains_of(self.system))
        # Beams are strained only where that leads to no closed loops, by what the nearest miss leaves open.
        sizes, weights = np.concatenate(
            [[ATTEMPTS, 0.0 * ATTEMPTS], [*STRAINED] if np.any(fixed) else 2 * [[]]], axis=1
        )
        beside = sizes[:, None] * np.random.default_rng(0).normal(size=(len(sizes), len(fixed)))
        starts, weights = jnp.asarray(beside, q.dtype) * self.system.scales, jnp.asarray(weights, q.dtype)

        def unfinished(carry):
            count, _, size = carry
            return (count < len(starts)) & (size > CLOSED)

        def attempt(carry):
            count, best, size = carry
            strains = count >= len(ATTEMPTS)
            moves = strains | jnp.logical_not(fixed)
            begin, aside = jnp.where(strains, best, q), jnp.where(moves, starts[count], 0.0)
            found, reached = self.meet(retract(self.system.topology, begin, aside), q, moves, weights[count])
            return count + 1, jnp.where(reached < size, found, best), jnp.minimum(reached, size)

        begin = (jnp.zeros((), int), q, jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, attempt, begin)[1]


def _size(rows):
    return jnp.sqrt(jnp.sum(rows * rows))


@eqx.filter_custom_jvp
def close_loops(
    demand: LoopClosure, q: Float[Array, " n_q"], found: Float[Array, " n_q"] | None
) -> Float[Array, " n_q"]:
    """Find coordinates that close the loops, by a search from q, or take what such a search has `found`."""
    return demand.search(q) if found is None else found


@close_loops.def_jvp
def _closed_jvp(primals, tangents):
    """Tangent by the implicit function theorem, nearest to that of where the search begins; the search has none."""
    demand, begin, _ = primals
    q = close_loops(*primals)
    # Apart from their structure, see `linkax.formulations.projected_state`.
    return q, _closed_tangent(demand, begin, q, *jax.tree.flatten(tangents[:2]))


@jit_inline
def _closed_tangent(demand, begin, q, tangents, structure):
    topology, (change, begins) = demand.system.topology, jax.tree.unflatten(structure, tangents)
    along = jnp.zeros_like(demand.system.scales) if begins is None else speeds(topology, begin, begins)
    at_rest = lambda demand: demand.rows(configure(demand.system, demand.t, q))
    rows, opens = pushforward(at_rest, (demand,), (change,))
    along = nearest_solution(demand.system, along, demand.linearised(q)[1], -opens)
    # Loops that do not close stay as open as they were found.
    return rates(topology, q, jnp.where(_size(rows) <= CLOSED, along, 0.0))
