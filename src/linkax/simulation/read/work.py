"""Work of force elements, impacts and drives over a motion, between its saved times too."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.forces.impacts import Impact
from linkax.model.names import ByName
from linkax.simulation.explain.error_estimate import has_parts, num_saves, part_of_run
from linkax.simulation.integrate.results import ENDED_WELL, AccuracyWarning, Solution, result_name
from linkax.simulation.read.interpolation import motion_between
from linkax.simulation.read.observables import Observables, do_work
from linkax.simulation.read.reading import read, read_in_motion
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, jit_inline
from linkax.xla.users_line import warn

# Gauss's rule on [0, 1], exact to the fifth power.
PLACES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
UNSEEN = 1e-7  # of the kinetic energy and the work of a motion: what need not be accounted for in an interval
SEEN = 1e-4  # of these, from which a warning tells what is not accounted for
MOST_PARTS = 64  # of a motion that are run again
SHORTEST = 1e-12  # interval, of its time


def work(solution: Solution) -> dict[str, Float[Array, "*batch n_t"]]:
    """Work of each element since the first saved time [J], by name; inf at times that were not reached."""
    mechanism, (forces, drives) = solution.mechanism, do_work(solution.mechanism)
    names = [mechanism.force_names[index] for index in forces]
    names += [mechanism.topology.constraints[index] for index in drives]
    works = _between_saved_times(solution)
    of_stops = _of_impacts(solution)
    if names and solution.ts.ndim == 1 and all_concrete(works) and has_parts(solution):
        works = _resolved(solution, np.array(works), np.sum(of_stops, axis=0))
    names += [
        name for name, force in zip(mechanism.force_names, mechanism.forces, strict=True) if isinstance(force, Impact)
    ]
    return ByName(dict(zip(names, [*works, *of_stops], strict=True)), "element that does work")


def _of_impacts(solution) -> Float[Array, "stops *batch n_t"]:
    """Works of impacts, as the run has recorded them."""
    if solution.impact_record is None:
        return jnp.zeros((0, *solution.ts.shape), solution.ts.dtype)
    taken = jnp.moveaxis(solution.impact_record[..., 1, :], -1, 0)
    return jnp.where(jnp.isfinite(taken), taken[..., :1] - taken, jnp.inf + solution.ts)


def _between_saved_times(solution) -> Float[Array, "n *batch n_t"]:
    """Works by powers of the motion as it is interpolated between saved times."""
    forces, drives = do_work(solution.mechanism)
    if not forces + drives or solution.ts.shape[-1] < 2:
        return jnp.zeros((len(forces + drives), *solution.ts.shape), solution.ts.dtype)
    between = motion_between(solution, PLACES)
    powers = [read(Observables.powers_of_forces, between)] if forces else []
    powers += [read_in_motion(Observables.powers_of_drives, between)] if drives else []
    return _integrals(solution.ts, powers)


def _resolved(solution, works, of_stops) -> Float[np.ndarray, "n n_t"]:
    """The works of a single run, with intervals between saved times run again in which energy is not accounted for.

    **Arguments:** `of_stops`: work of all impacts, (n_t,).
    """
    reached = np.isfinite(np.asarray(solution.ts))
    scale = sum(np.max(np.abs(part[..., reached]), initial=0.0) for part in (solution.kinetic_energy(), works))
    each = _of_intervals(solution, works, of_stops, UNSEEN * scale, iter(range(MOST_PARTS)))
    works[:, 1 : each.shape[1] + 1] = np.cumsum(each, axis=1)
    change = (solution.energy() - np.sum(works, axis=0) - of_stops)[reached]
    missed = np.max(np.abs(change - change[:1]), initial=0.0)
    if missed > SEEN * scale:
        warn(
            f"work is known to {missed:.2g} J only, where up to {scale:.2g} J are at work: the motion is too fast for "
            "its saved times; save more of them",
            AccuracyWarning,
        )
    return works


def _of_intervals(solution, works, of_stops, unseen, parts) -> Float[np.ndarray, "n k"]:
    """Works in each interval between saved times that were reached, (n, k).

    Those in which more energy than `unseen` [J] is not accounted for are run again, and saved more often, as long as
    `parts` has entries.
    """
    ts = np.asarray(solution.ts)
    count = int(np.sum(np.isfinite(ts)))
    each = np.diff(works[:, :count], axis=1)
    known = np.sum(each, axis=0) + np.diff(of_stops[:count])
    missed = np.abs(np.diff(np.asarray(solution.energy())[:count]) - known)
    for index in np.argsort(-missed):
        begin, end = ts[index : index + 2]
        if not missed[index] > unseen or end - begin < SHORTEST * abs(end) or next(parts, None) is None:
            break
        internal = None if solution.internal is None else solution.internal[index]
        state = State(solution.q[index], solution.v[index], solution.mechanism.topology, internal)
        part = solution.another(part_of_run(solution, state, np.linspace(begin, end, num_saves(solution))))
        if result_name(part.result) in ENDED_WELL:
            of_part = np.array(_between_saved_times(part)), np.sum(_of_impacts(part), axis=0)
            each[:, index] = np.sum(_of_intervals(part, *of_part, unseen, parts), axis=1)
    return each


@jit_inline
def _integrals(ts, powers):
    """Integrals over the saved times, (n, *batch, n_t), of powers at the places between them."""
    powers = jnp.moveaxis(jnp.concatenate(powers, axis=-1), -1, 0)
    span = jnp.where(jnp.isfinite(ts[..., 1:]), ts[..., 1:] - ts[..., :-1], 0.0)
    at_places = powers.reshape(*powers.shape[:-1], span.shape[-1], len(PLACES))
    each = jnp.where(span[..., None] > 0.0, at_places, 0.0) @ jnp.asarray(WEIGHTS, ts.dtype) * span
    found = jnp.concatenate([jnp.zeros_like(powers[..., :1]), jnp.cumsum(each, axis=-1)], axis=-1)
    return jnp.where(jnp.isfinite(ts), found, ts)
