"""Synthesise linkages: dimensions for a path, a motion or a function, from many random starts in one batch."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.analysis.trace import Trace
from linkax.model.numbers import require_bool, require_type, whole_number
from linkax.simulation.integrate.results import RESULTS
from linkax.studies.fits.fit_search import Squares, checked_tolerance, search_from_each
from linkax.studies.fits.levenberg_marquardt import LevenbergMarquardt
from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.studies.parameters.parameters import Bounded
from linkax.studies.synthesis.synthesis_result import Candidate, Synthesis
from linkax.xla.arrays import Array
from linkax.xla.waiting import compiling
from scalarjit.code import ByValue

WEIGHTS = (1.0, 30.0, 1000.0)  # of conditions in the searches, one after the other
MET = 1e-6  # by how much a condition may be missed
WHOLE = "whole trace"  # a condition of all candidates that have one
SAME = 1e-3  # of the bounds' distance: parameters nearer to each other are one minimum
CHUNK = 250  # starts that are computed together, which suits a processor's cache


def synthesis(
    function: Callable[[Any], Candidate],
    params: Any,
    *,
    starts: int = 2000,
    kept: int = 50,
    seed: int = 0,
    steps: int = 100,
    tolerance: int | float = 1e-6,
    progress: bool | None = None,
) -> Synthesis:
    """Find the dimensions with which a linkage comes closest to what is asked of it.

    ```python
    def four_bar(pins):
        mechanism = lx.linkage(pins, {"crank": "OA", "coupler": "ABP", "rocker": "BC"}, fixed="OC")
        turn = lx.trace(mechanism, lx.State.as_drawn(mechanism), {"O": angles}, throw=False)
        conditions = {"transmission angle": turn.transmission_angle("B", "C") - np.radians(40.0)}
        return lx.Candidate(turn.position("coupler", "P")[:, :2] - points, conditions, turn)


    found = lx.synthesis(four_bar, {pin: lx.Bounded(place, -2.0, 2.0) for pin, place in drawn.items()})
    lx.plot.path(found.candidate(0).trace, {"P": ("coupler", "P")})
    ```

    Parameters are drawn evenly between their bounds. From the best of these starts Levenberg and Marquardt's method
    goes on, from all in one batch, with exact derivatives. Conditions are added to the squares of the error with
    weights that rise from one search to the next, so that at the end they hold.

    Positions of a trace are all on one branch, so that a candidate whose trace reaches all of them does not change it;
    one that leads the crank once about makes the full turn a condition.

    **Arguments:**

    - `function`: params -> a `Candidate`. What it asks to be small is its `error`, whose sum of squares is minimised:
      of a path, distances; of a motion, distances and angles; of a function, angles of the output.
    - `params`: pytree of `linkax.Bounded`; where these start, the search does too.
    - `starts`: number of random starts. `kept`: how many of them the search goes on from. `seed`: of the random draws.
    - `steps`, `tolerance`: of each search, as in `linkax.fit`. `progress`: whether to show a progress bar; by default
      where the output is a terminal.

    **Returns:** a `Synthesis`, the best linkage first.

    **Raises:** `ValueError` for other parameters; for a function that returns no `Candidate`, or whose trace is a
    batch; and where no start is possible.
    """
    remedy = "give a function of params that returns a linkax.Candidate"
    function = ByValue.each(require_type(function, Callable, "function", remedy))
    for leaf in jax.tree.leaves(params, is_leaf=lambda node: isinstance(node, Bounded)):
        require_type(leaf, Bounded, "params", "give all between bounds, such as linkax.Bounded(1.0, 0.5, 2.0)")
    whole_number(starts, "starts")
    whole_number(kept, "kept")
    whole_number(seed, "seed", least=0)
    whole_number(steps, "steps")
    tolerance = checked_tolerance(tolerance)
    if progress is not None:
        require_bool(progress, "progress")
    free = FreeParameters.of(params)
    judge, chunk = _Judge(function, free), min(CHUNK, starts)
    with compiling():
        z = _draws(free, starts, seed)
        errors, misses, least = judge.each(z, chunk)
    possible = np.isfinite(errors) & np.isfinite(misses)
    if not np.any(possible):
        raise ValueError(
            f"function is finite at none of {starts} starts: no trace reaches all positions; give more starts, or "
            "narrower bounds about a linkage that does"
        )
    scale = np.median(errors[possible])
    best = np.argsort(np.where(possible, errors + scale * misses, np.inf))[: min(kept, int(np.sum(possible)))]
    search = Squares(LevenbergMarquardt(tolerance, free), judge.residual, free, None, False)
    z, ended = z[best], []
    for weight in WEIGHTS if set(least) - {WHOLE} else WEIGHTS[:1]:
        args = (jnp.asarray(weight * np.sqrt(scale)),)
        found, losses, ended = search_from_each(search, z, args, steps, progress)
        z = jnp.where(np.isfinite(losses)[:, None], found, z)
    return _sorted(judge, judge.each(z, chunk), z, ended, int(np.sum(possible)), starts)


class _Judge(eqx.Module):
    """What a function says of candidates."""

    function: Callable
    free: FreeParameters

    def candidate(self, params: Any) -> Candidate:
        """The candidate of a function, with conditions as arrays, which are NaN where its trace is not whole.

        **Raises:** `ValueError` where it returns something else.
        """
        found = self.function(params)
        require_type(found, Candidate, "what function returned", "return linkax.Candidate(error, conditions, trace)")
        conditions = found.conditions
        require_type(conditions, Mapping, "conditions", "give {name: array}, each at least zero where it holds")
        told = {name: jnp.asarray(value, float) for name, value in conditions.items()}
        if found.trace is not None:
            require_type(found.trace, Trace, "trace", "give what linkax.trace returned")
            if found.trace.ts.ndim > 1:
                raise ValueError("trace is a batch; give that of one linkage, linkax.synthesis makes the batch")
            reached = found.trace.result == RESULTS.successful
            told = {name: jnp.where(reached, value, jnp.nan) for name, value in told.items()}
            told[WHOLE] = jnp.where(reached, 0.0, jnp.nan)
        return found._replace(conditions=told)

    def residual(self, params: Any, weight: Float[Array, ""]) -> tuple[Any, list[Array]]:
        """The error, and by how much conditions are missed, infinite where they are not finite."""
        found = self.candidate(params)
        return found.error, [weight * missed for missed in _missed(found)]

    @eqx.filter_jit
    def judged(self, z: Float[Array, "n p"]) -> "_Judged":
        """What is said of several."""

        def of(z):
            found = self.candidate(self.free.params(z))
            least: dict[str, Any] = {name: jnp.min(value) for name, value in found.conditions.items()}
            return _Judged(_square(found.error), _square(_missed(found)), least)

        return jax.vmap(of)(z)

    def each(self, z: Float[Array, "n p"], chunk: int) -> "_Judged":
        """The same chunk by chunk, by one program."""
        padded = jnp.resize(z, (-(-len(z) // chunk) * chunk, z.shape[1]))
        parts = [self.judged(padded[i : i + chunk]) for i in range(0, len(padded), chunk)]
        return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(z)], *parts)


class _Judged(NamedTuple):
    """Sums of squares of the error, and of what conditions are missed by; the least of each condition."""

    errors: Float[Array | np.ndarray, " n"]
    misses: Float[Array | np.ndarray, " n"]
    least: dict[str, Float[Array | np.ndarray, " n"]]


def _missed(found) -> list[Array]:
    """By how much conditions are missed, infinite where they are not finite."""
    values = found.conditions.values()
    return [jnp.where(jnp.isfinite(value), jnp.minimum(value, 0.0), jnp.inf) for value in values]


def _square(tree) -> Float[Array, ""]:
    return sum((jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def _draws(free, starts, seed) -> Float[Array, "n p"]:
    """Parameters between their bounds: where they start, and at random."""
    generator, columns = np.random.default_rng(seed), []
    for leaf in free.leaves:
        places = generator.uniform(size=(starts - 1, *np.shape(leaf.value)))
        drawn = np.asarray(leaf.lower) + np.asarray(leaf.upper - leaf.lower) * places
        columns.append(jnp.asarray(np.concatenate([np.asarray(leaf.value)[None], drawn])))
    return free.starts(jax.tree.unflatten(free.structure, columns))


def _sorted(judge, judged, z, ended, possible, starts) -> Synthesis:
    """Linkages without those found twice, first those that meet the conditions, by their errors."""
    params, errors = jax.tree.map(np.asarray, jax.vmap(judge.free.params)(z)), judged.errors
    met = np.all([value >= -MET for value in judged.least.values()], axis=0) & np.isfinite(errors)
    conditions = {name: value for name, value in judged.least.items() if name != WHOLE}
    leaves = [np.reshape(leaf, (len(z), -1)) for leaf in judge.free.structure.flatten_up_to(params)]
    widths = [float(leaf.upper - leaf.lower) for leaf in judge.free.leaves]
    places = np.concatenate([part / width for part, width in zip(leaves, widths, strict=True)], axis=1)
    order: list[int] = []
    for i in np.lexsort((errors, ~met)):
        if all(np.max(np.abs(places[i] - places[j])) > SAME for j in order):
            order.append(int(i))
    taken = lambda array: array[np.array(order)]
    return Synthesis(
        params=jax.tree.map(taken, params),
        errors=taken(errors),
        conditions={name: taken(value) for name, value in conditions.items()},
        met=taken(met),
        ended=[ended[i] for i in order],
        names=judge.free.names,
        possible=possible,
        starts=starts,
        function=judge.function,
    )
