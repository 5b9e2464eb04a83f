"""Passages through singular configurations, found along a motion however coarsely it was saved."""

import itertools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from diffrax import ThirdOrderHermitePolynomialInterpolation
from jaxtyping import Bool, Float, Inexact, Int

from linkax.equations.coordinates import on_manifold, rates, speeds
from linkax.equations.system import system_of
from linkax.formulations.classical import ClassicalFormulation
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.explain.error_estimate import has_parts, num_saves, part_of_run
from linkax.simulation.integrate.map_saved_times import map_saved_times
from linkax.simulation.integrate.results import ENDED_WELL, SimulationError, Solution, result_name
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from scalarjit import scalarised

REFINEMENTS = 6
POLISHES = 2
ASIDE = 5e-3  # of the time since the state before: where the motion is looked at around a passage
PRECISE = 3e-9  # of the whole time: what a polynomial between saved states may leave
VANISHED = 0.1  # of the distances before and after: what a passage falls below
TOGETHER = 1e-6  # of the whole time: passages that close are of several loops at once
ALIKE = 1e-6  # relative: eigenvalues that pass through zero as one
SINGULAR = 2e-6  # distance below which a state is on no side of a passage: twice the rank tolerance
FASTEST = 10.0  # that distances change, per radian or length of the mechanism
BATCH = 64  # intervals that one program looks at


class Passages(NamedTuple):
    """Times at which a motion goes through singular configurations [s], and what they cost.

    - `times`: (n,), rising.
    - `digits`: decimal digits of the state that the run lost to them: rounding errors of the
      tangential motion grow like 1/d at the stages of steps, d the distance from a singular
      configuration, and add up over the passages. NaN for a classical formulation.
    - `accuracy`: the largest error of `times` [s], NaN without passages. The motion itself is off by as much as
      `Solution.error_estimate` tells.
    """

    times: np.ndarray
    digits: float
    accuracy: float


class Samples(NamedTuple):
    """States along a motion, and their distances from a singular configuration; times are the first axis."""

    ts: np.ndarray
    q: np.ndarray
    v: np.ndarray
    distances: np.ndarray

    @staticmethod
    def of(solution: Solution) -> "Samples":
        reached = np.isfinite(np.asarray(solution.ts))
        parts = solution.ts, solution.q, solution.v, solution.singularity_distance()
        return Samples(*(np.asarray(part)[reached] for part in parts))

    def taken(self, which: np.ndarray | np.integer) -> "Samples":
        return Samples(*(part[which] for part in self))

    def then(self, other: "Samples") -> "Samples":
        """Join samples of which the second begin with the last state of the first."""
        return Samples(*(np.concatenate([part, more[1:]]) for part, more in zip(self, other, strict=True)))

    def missed(
        self, off: Float[np.ndarray, " inner"], fastest: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " intervals"]:
        """The largest error of a cubic polynomial in each interval, as a time [s], (n - 1,), see `sizes`.

        The polynomial over two intervals misses the state in their middle by sixteen times as much.
        """
        missed = np.full(len(self.ts), np.inf)
        missed[1:-1] = off / 16.0 / np.maximum(fastest[1:-1], np.finfo(float).tiny)
        return np.where(np.isfinite(missed[1:]), np.maximum(missed[:-1], missed[1:]), np.inf)

    def pairs(self, before: Int[np.ndarray, " k"]) -> "Samples":
        """States at both ends of intervals, (k, 2, ...)."""
        return self.taken(np.stack([before, before + 1], axis=1))


class _Passage(NamedTuple):
    """A passage: its time, the coordinates there, and the error of the time."""

    time: float
    q: np.ndarray
    accuracy: float


def passages(solution: Solution) -> Passages:
    """Find the passages of one `linkax.Solution`.

    **Raises:** `ValueError` for a batch, or where the solution saved functions of its own; `SimulationError` where the
    motion has to be run again, and fails.
    """
    found = _passages(solution)
    times = np.array([passage.time for passage in found])
    accuracy = max((passage.accuracy for passage in found), default=math.nan)
    if isinstance(solution.formulation, ClassicalFormulation):  # which does not measure how close its stages come
        return Passages(times, math.nan, accuracy)
    lost = np.log10(max(len(times), 1) / max(float(solution.closest), np.finfo(float).eps))
    return Passages(times, float(max(lost, 0.0)), accuracy)


def singular_states(solution: Solution) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n_q"]]:
    """Find the times of passages, (n,), and the coordinates there, (n, n_q)."""
    found = _passages(solution)
    states = np.array([passage.q for passage in found]).reshape(len(found), solution.q.shape[-1])
    return np.array([passage.time for passage in found]), states


def _passages(solution) -> list[_Passage]:
    """Find all passages, in order.

    J at one state times the right inverse of J at the one before has eigenvalues near one; an eigenvalue that is
    negative has passed through zero between the two. Its zero is sought on a polynomial first, then on the motion, run
    again.
    """
    if solution.ts.ndim != 1:
        raise ValueError(f"passages of a batch of shape {solution.ts.shape[:-1]}; ask for one member at a time")
    if solution.q is None:
        raise ValueError("this solution saved functions of its own in ys; simulate without SaveAt(fn=...)")
    samples = _close_enough(solution)
    samples = samples.taken(samples.distances > SINGULAR)
    if len(samples.ts) < 2:
        return []
    off, fastest = map(np.asarray, sizes(solution.mechanism, samples.ts, samples.q, samples.v))
    intervals = _candidates(samples, fastest)
    pairs, missed = samples.pairs(intervals), samples.missed(off, fastest)[intervals]
    turned = [change.turned() for change in _between(solution, pairs, np.ones(len(pairs.ts)))[0]]
    with_ends = np.repeat(np.arange(len(turned)), [len(ends) for ends in turned])
    pairs, missed = pairs.taken(with_ends), missed[with_ends]
    places, distances, states = _zeros(solution, pairs, np.concatenate([np.empty(0), *turned]))
    vanished = np.flatnonzero(distances <= VANISHED * np.max(pairs.distances, axis=1))
    times = pairs.ts[:, 0] + places * np.diff(pairs.ts, axis=1)[:, 0]
    together = TOGETHER * np.ptp(samples.ts)
    different = vanished[_apart(times[vanished], together)]
    precise = PRECISE * np.ptp(samples.ts)
    found = [
        _Passage(float(times[k]), states[k], float(missed[k]))
        if missed[k] <= precise
        else _polished(solution, pairs.taken(k), times[k], states[k])
        for k in different
    ]
    return [found[k] for k in _apart(np.array([passage.time for passage in found]), together)]


def _apart(times, together):
    """Indices of the first of times that lie together, in order."""
    order = np.argsort(times)
    return order[np.diff(times[order], prepend=-np.inf) > together]


def _close_enough(solution) -> Samples:
    """Take as many states as the run took steps: where fewer were saved, run it again, part by part."""
    samples, steps = Samples.of(solution), int(solution.stats.get("num_accepted_steps", 0))
    if steps < len(samples.ts) or not has_parts(solution):
        return samples
    state, t0, found = solution.run.state, solution.run.t0, None
    saves = num_saves(solution)
    parts = -(-2 * steps // (saves - 1))
    for begin, end in itertools.pairwise(np.linspace(float(t0), float(solution.t_end), parts + 1)):
        part = solution.another(part_of_run(solution, state, np.linspace(begin, end, saves)))
        more, state = Samples.of(part), part.end
        found = more if found is None else found.then(more)
        if result_name(part.result) not in ENDED_WELL:
            if result_name(solution.result) in ENDED_WELL:
                raise SimulationError(
                    f"a part of the motion, run again from {begin:.6g} s to see where it passes singular "
                    f"configurations, fails at {float(part.t_end):.6g} s; save at least {2 * steps} times",
                    part,
                )
            break
    return samples if found is None else found


def _candidates(samples, fastest):
    """Indices of intervals in which distances may fall to zero, given how far the joints move in them."""
    travelled = np.maximum(fastest[1:], fastest[:-1]) * np.diff(samples.ts)
    smaller = np.minimum(samples.distances[1:], samples.distances[:-1])
    return np.flatnonzero(smaller <= FASTEST * travelled)


def _polished(solution, pair, time, q) -> _Passage:
    """Find a passage between two states on the motion, from the time and coordinates that a polynomial says."""
    begin, accuracy = pair.ts[0], pair.ts[1] - pair.ts[0]
    if not has_parts(solution):
        return _Passage(float(time), q, float(accuracy))
    internal = None if solution.internal is None else solution.at([begin]).internal[0]
    state = State(jnp.asarray(pair.q[0]), jnp.asarray(pair.v[0]), solution.mechanism.topology, internal)
    for _ in range(POLISHES):
        aside = ASIDE * (time - begin)
        part = solution.another(part_of_run(solution, state, np.array([begin, time - aside, time + aside])))
        if result_name(part.result) not in ENDED_WELL:
            break
        ts, qs, vs = (np.asarray(of)[:3] for of in (part.ts, part.q, part.v))
        at_ends = lambda of, k: of[[0, k]][None]
        ends = [Samples(at_ends(ts, k), at_ends(qs, k), at_ends(vs, k), pair.distances[None]) for k in (1, 2)]
        f, g = (_between(solution, end, np.ones(1))[0][0].smallest() for end in ends)
        share = -f / (g - f) if g != f else 0.5
        polished = ts[1] + share * (ts[2] - ts[1])
        if not pair.ts[0] <= polished <= pair.ts[1]:  # where a motion comes close, and none of its states is singular
            break
        accuracy = abs(polished - time)
        time = polished
        q = qs[1] + share * (qs[2] - qs[1])
    return _Passage(float(time), q, float(accuracy))


class _Change(NamedTuple):
    """J times its right inverse G at an earlier state, and J G there, which projects on the independent rows."""

    change: np.ndarray
    projector: np.ndarray

    def eigenvalues(self) -> Inexact[np.ndarray, " n"]:
        """Eigenvalues on the independent rows; ones where a motion that diverged has left no numbers."""
        if not np.all(np.isfinite(self.change)):
            return np.ones(len(self.change))
        basis, _, _ = np.linalg.svd(self.projector)
        basis = basis[:, : round(np.trace(self.projector))]
        return np.linalg.eigvals(basis.T @ self.change @ basis)

    def turned(self) -> Float[np.ndarray, " n"]:
        """The eigenvalues that have become negative; equal ones, of loops that move alike, once."""
        off = np.abs(self.change - self.projector)
        if np.max(np.sum(off, axis=0), initial=0.0) * np.max(np.sum(off, axis=1), initial=0.0) < 1.0:
            return np.empty(0)  # as the norm of what the eigenvalues differ from one by is below one
        values: Any = self.eigenvalues()
        turned = np.sort(values.real[values.real < -np.abs(values.imag)])
        return turned[np.diff(turned, prepend=-np.inf) > ALIKE * np.abs(turned)]

    def smallest(self) -> float | np.floating:
        """The eigenvalue nearest to zero."""
        values = self.eigenvalues()
        return values[np.argmin(np.abs(values))].real


def _zeros(solution, pairs, ends):
    """Find where between two states eigenvalues that end at `ends` are zero, with d and the coordinates there."""
    low, high = (np.zeros(len(ends)), np.ones(len(ends))), (np.ones(len(ends)), ends)
    places, distances = low
    states = np.zeros((len(ends), solution.q.shape[-1]))
    for _ in range(REFINEMENTS if len(ends) else 0):
        (a, f), (b, g) = low, high
        places = a + (b - a) * f / (f - g)
        changes, distances, states = _between(solution, pairs, places)
        value = np.array([change.smallest() for change in changes])
        low = np.where(value > 0.0, (places, value), low)
        high = np.where(value > 0.0, high, (places, value))
    return places, distances, states


def _between(solution, pairs, places):
    """Changes of J (see `_passages`), d and coordinates, at shares from 0 to 1 between two states."""
    changes, distances, states = [], [np.zeros(0)], [np.zeros((0, solution.q.shape[-1]))]
    for first in range(0, len(places), BATCH):
        taken = np.arange(first, min(first + BATCH, len(places)))
        filled, there = np.resize(taken, BATCH), np.arange(BATCH) < len(taken)  # one shape, so that one program serves
        ts, qs, vs, _ = pairs.taken(filled)
        motion = solution.mechanism, solution.run.tangent_space, solution.rank_nearby
        found = between_states(*motion, there, ts, qs, vs, places[filled])
        change, projector, distance, q = (np.asarray(part)[: len(taken)] for part in found)
        changes += map(_Change, change, projector)
        distances, states = [*distances, distance], [*states, q]
    return changes, np.concatenate(distances), np.concatenate(states)


def _on_cubic(system, ts, qs, vs, place):
    """Interpolate coordinates between two states by their cubic polynomial, at a share from 0 to 1."""
    duration, dtype = ts[1] - ts[0], qs.dtype
    hermite = ThirdOrderHermitePolynomialInterpolation(
        t0=jnp.zeros((), dtype),
        t1=jnp.ones((), dtype),
        y0=qs[0],
        y1=qs[1],
        k0=duration * rates(system.topology, qs[0], vs[0]),
        k1=duration * rates(system.topology, qs[1], vs[1]),
    )
    return hermite.evaluate(place)


@scalarised
def sizes(
    mechanism: Mechanism, ts: Float[Array, " n"], qs: Float[Array, "n n_q"], vs: Float[Array, "n n_v"]
) -> tuple[Float[Array, " n-2"], Float[Array, " n"]]:
    """How far states are from the cubic polynomials between their neighbours, and their fastest speeds [1/s].

    Both in radians and lengths of the mechanism.
    """
    system = system_of(mechanism, qs.dtype)
    size = lambda changes: jnp.max(jnp.abs(changes / system.scales), axis=1, initial=0.0)
    places = (ts[1:-1] - ts[:-2]) / (ts[2:] - ts[:-2])
    ends = (jnp.stack([part[:-2], part[2:]], axis=1) for part in (ts, qs, vs))
    off = lambda q, *interval: speeds(system.topology, q, _on_cubic(system, *interval) - q)
    return size(jax.vmap(scalarised(off))(qs[1:-1], *ends, places)), size(vs)


@scalarised
def between_states(
    mechanism: Mechanism,
    tangent_space: TangentSpace,
    rank_nearby: Int[Array, " k"] | None,
    there: Bool[Array, " n"],
    ts: Float[Array, "n 2"],
    qs: Float[Array, "n 2 n_q"],
    vs: Float[Array, "n 2 n_v"],
    places: Float[Array, " n"],
) -> tuple[Float[Array, "n m m"], Float[Array, "n m m"], Float[Array, " n"], Float[Array, "n n_q"]]:
    """J at shares between two states times its right inverse G at the first; J G there; d and q at the shares.

    All with a leading axis; NaN where no states are `there`.
    """
    dtype = qs.dtype
    system, method = system_of(mechanism, dtype), tangent_space.prepared(dtype, rank_nearby)

    def at(ts, qs, vs, place):
        q = on_manifold(system.topology, _on_cubic(system, ts, qs, vs, place))
        here, _, distance = method.right_inverse(system, ts[0] + place * (ts[1] - ts[0]), q)
        before, right_inverse, _ = method.right_inverse(system, ts[0], qs[0])
        return here @ right_inverse, before @ right_inverse, distance, q

    return map_saved_times(at, there, ts, qs, vs, places)
