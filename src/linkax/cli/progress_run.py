"""Run a long simulation in segments, to report its progress and to keep what it has computed."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.accuracy import BALANCED, Accuracy
from linkax.simulation.integrate.default_solver import default_solver
from linkax.simulation.integrate.results import RESULTS
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, DEFAULT_MAX_STEPS
from linkax.simulation.read.solution import Solution
from linkax.simulation.simulate import fixed_steps, simulate
from linkax.simulation.start.state import State

SEGMENTS = 20
DEFAULT_INTERVALS = 1000
LONG_RUN = 2.0  # a run that would take longer is cut into segments [s]
INSTANT = 1e-6  # duration of the run that compiles, relative to the whole


class TimedRun(NamedTuple):
    """A solution, and how long it took: wall time of compiling and of running [s]."""

    solution: Solution
    compile_s: float
    run_s: float


def simulate_in_segments(
    mechanism: Mechanism,
    state: State,
    *,
    t1: int | float,
    accuracy: Accuracy = BALANCED,
    solver: diffrax.AbstractSolver | None = None,
    formulation: str | AbstractFormulation | None = DEFAULT_FORMULATION,
    step: int | float | None = None,
    intervals: int = DEFAULT_INTERVALS,
    report: Callable[[str, float | None], None] = lambda phase, fraction: None,
    keep: Callable[[Solution], None] = lambda solution: None,
) -> TimedRun:
    """Integrate from 0 to t1 [s], and report the progress.

    A long run is cut into segments, each of which takes a few steps more than the same part of an uncut run. The first
    segment shows whether that is worth it; all share a program.

    **Arguments:**

    - `mechanism`, `state`, `accuracy`, `solver`, `formulation`: see `linkax.simulate`.
    - `step`: size of fixed steps [s], in place of adaptive ones.
    - `intervals`: number of intervals between the saved times, a multiple of 20.
    - `report`: called with the current phase, and with the fraction done where that is known.
    - `keep`: called with the solution so far, after each segment.

    **Returns:** a `TimedRun`. If a segment fails, its solution ends with that segment.
    """
    if solver is None:  # one for all parts
        solver = default_solver(mechanism, None if step else accuracy.rtol, t1)
    options = dict(accuracy=accuracy, solver=solver, formulation=formulation, **fixed_steps(step, t1))
    run = partial(_timed, mechanism, intervals, options)
    report("compiling", None)
    _, compile_s = run(state, 0.0, INSTANT * t1)
    report("integrating", 0.0)
    first, run_s = run(state, 0.0, t1 / SEGMENTS)
    # A classical formulation keeps the gaps that it has left; a segment would begin with closed loops.
    if isinstance(first.formulation, TangentSpace) and _is_long(first, run_s):
        whole, seconds = _with_later_segments(run, first, t1, report, keep)
        return TimedRun(whole, compile_s, run_s + seconds)
    whole, run_s = run(state, 0.0, t1, intervals)
    keep(whole)
    return TimedRun(whole, compile_s, run_s)


def _timed(mechanism, intervals, options, start, t0, end, count=None) -> tuple[Solution, float]:
    """A part of the run, saved after `count` intervals, by default those of a segment, and its wall time [s].

    All parts have equally many saved times, and so share a program.
    """
    count = intervals // SEGMENTS if count is None else count
    began = time.perf_counter()
    times = np.pad(np.linspace(t0, end, count + 1), (0, intervals - count), mode="edge")
    saveat = diffrax.SaveAt(ts=jnp.asarray(times))
    solution = simulate(mechanism, start, t0=t0, t1=end, saveat=saveat, throw=False, **options)
    return jax.block_until_ready(solution), time.perf_counter() - began


def _with_later_segments(run, first, t1, report, keep) -> tuple[Solution, float]:
    """The solution of all segments, from that of the first, and the wall time of the later ones [s]."""
    parts, whole, total = [first], _joined([first]), 0.0
    keep(whole)
    for t0, end in itertools.pairwise(np.linspace(0.0, t1, SEGMENTS + 1)[1:]):
        if whole.result != RESULTS.successful:
            break
        report("integrating", float(t0 / t1))
        part, seconds = run(whole.end, t0, end)
        parts, total = [*parts, part], total + seconds
        whole = _joined(parts)
        keep(whole)
    return whole, total


def _is_long(first, seconds):
    return SEGMENTS * seconds > LONG_RUN or SEGMENTS * first.stats["num_steps"] > DEFAULT_MAX_STEPS // 2


def _joined(parts) -> Solution:
    """One solution with as many times as a run without segments; the time between two belongs to the earlier one."""
    counted = {name: sum(part.stats[name] for part in parts) for name in parts[0].stats if name != "max_steps"}
    kept = [name for name in Solution.by_time if getattr(parts[0], name) is not None]
    return dataclasses.replace(
        parts[-1],
        **{name: _one_after_another([getattr(part, name) for part in parts]) for name in kept},
        stats=parts[-1].stats | counted,
        rank_nearby=np.max([part.rank_nearby for part in parts], axis=0),
        closest=min(part.closest for part in parts),
        average=_mean_distance(parts),
        definiteness=parts[0].definiteness,
        run=parts[0].run,
    )


def _mean_distance(parts):
    """Mean distance from a singular configuration over the time of all parts."""
    lasting = [part for part in parts if part.t_end > part.ts[0]]
    durations = [part.t_end - part.ts[0] for part in lasting]
    return np.average([part.average for part in lasting], weights=durations) if lasting else parts[0].average


def _one_after_another(parts):
    """Join what the parts saved; each later one begins with the last time of the one before."""
    saved = (len(parts[0]) - 1) // SEGMENTS
    first, *others = (np.asarray(part) for part in parts)
    return np.concatenate([first[: saved + 1], *(values[1 : saved + 1] for values in others)])
