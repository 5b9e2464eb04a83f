"""Passages through singular configurations, read off a motion's saved times."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from diffrax import ThirdOrderHermitePolynomialInterpolation

from linkax.equations.coordinates import on_manifold, rates
from linkax.equations.system import system_of
from linkax.formulations.classical import ClassicalFormulation
from linkax.tracing import runs_once

REFINEMENTS = 4
VANISHED = 0.1  # of the distances before and after: what a passage falls below
TOGETHER = 1e-3  # of the time between saved states: passages that close are of several loops at once


class Passages(NamedTuple):
    """Times at which a motion goes through singular configurations [s], and what they cost.

    - `times`: (n,), rising. Between two passages of the same loop there must be a saved time.
    - `digits`: decimal digits of the state that the run lost to them: rounding errors of the
      tangential motion grow like 1/d at the stages of steps, d the distance from a singular
      configuration, and add up over the passages. Not a number for a classical formulation.
    """

    times: np.ndarray
    digits: float


def passages(solution) -> Passages:
    """Passages of one `linkax.Solution`, not of a batch.

    **Raises:** `ValueError` for a batch, or where the solution saved functions of its own.
    """
    times, _ = singular_states(solution)
    if isinstance(solution.formulation, ClassicalFormulation):  # which does not measure how close its stages come
        return Passages(times, math.nan)
    lost = np.log10(max(len(times), 1) / max(float(solution.closest), np.finfo(float).eps))
    return Passages(times, float(max(lost, 0.0)))


def singular_states(solution):
    """Times at which a motion goes through singular configurations, (n,), and the coordinates there, (n, n_q).

    J at one saved state times the right inverse of J at the one before has eigenvalues near one;
    one that is negative has passed through zero between, and that is where it is sought.
    """
    if solution.ts.ndim != 1:
        raise ValueError(f"passages of a batch of shape {solution.ts.shape[:-1]}; ask for one member at a time")
    if solution.q is None:
        raise ValueError("this solution saved functions of its own in ys; simulate without SaveAt(fn=...)")
    ts = np.asarray(solution.ts)
    reached = np.flatnonzero(np.isfinite(ts[1:]))
    ends = [_turned(change) for change in _between(solution, reached, np.ones(len(reached)))[0]]
    intervals, ends = np.repeat(reached, [len(values) for values in ends]), np.concatenate([np.empty(0), *ends])
    places, distances, states = _zeros(solution, intervals, ends)
    around = np.asarray(solution.singularity_distance())
    vanished = distances <= VANISHED * np.maximum(around[intervals], around[intervals + 1])
    times = (ts[intervals] + places * (ts[intervals + 1] - ts[intervals]))[vanished]
    order = np.argsort(times)
    times, states = times[order], states[vanished][order]
    spacing = np.max(np.diff(ts[: len(reached) + 1]), initial=0.0)
    apart = np.diff(times, prepend=-np.inf) > TOGETHER * spacing
    return times[apart], states[apart]


def _eigenvalues(change):
    """Ones where a motion that diverged has left no numbers."""
    return np.linalg.eigvals(change) if np.all(np.isfinite(change)) else np.ones(len(change))


def _turned(change):
    """The eigenvalues that have become negative."""
    values = _eigenvalues(change)
    return values.real[values.real < -np.abs(values.imag)]


def _zeros(solution, intervals, ends):
    """Where between saved states the eigenvalues are zero that end at `ends`, d and the coordinates there."""
    low, high = (np.zeros(len(ends)), np.ones(len(ends))), (np.ones(len(ends)), ends)
    places, distances = low
    states = np.zeros((len(ends), solution.q.shape[-1]))
    for _ in range(REFINEMENTS if len(ends) else 0):
        (a, f), (b, g) = low, high
        places = a + (b - a) * f / (f - g)
        changes, distances, states = _between(solution, intervals, places)
        values = [_eigenvalues(change).real for change in changes]
        value = np.array([value[np.argmin(np.abs(value))] for value in values])
        low = np.where(value > 0.0, (places, value), low)
        high = np.where(value > 0.0, high, (places, value))
    return places, distances, states


def _between(solution, intervals, places):
    """What eigenvalues are taken of, d and q, at places from 0 to 1 between saved states."""
    found = _between_states(solution, jnp.asarray(intervals), jnp.asarray(places))
    return jax.tree.map(np.asarray, found)


@runs_once
def _between_states(solution, intervals, places):
    dtype = solution.q.dtype
    system, method = system_of(solution.mechanism, dtype), solution.accuracy.method(dtype, solution.rank_nearby)

    def at(k, place):
        duration = solution.ts[k + 1] - solution.ts[k]
        hermite = ThirdOrderHermitePolynomialInterpolation(
            t0=jnp.zeros((), dtype),
            t1=jnp.ones((), dtype),
            y0=solution.q[k],
            y1=solution.q[k + 1],
            k0=duration * rates(system.topology, solution.q[k], solution.v[k]),
            k1=duration * rates(system.topology, solution.q[k + 1], solution.v[k + 1]),
        )
        t = solution.ts[k] + place * duration
        q = on_manifold(system.topology, hermite.evaluate(place))
        here = method.crossing(system, t, q)
        before = method.crossing(system, solution.ts[k], solution.q[k])
        return here.jacobian @ before.inverse.normal, here.inverse.distance, q

    return jax.vmap(at)(intervals, places)
