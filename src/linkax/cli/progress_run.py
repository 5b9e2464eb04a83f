"""A long run in segments, so that its progress can be reported from the host."""

import dataclasses
import itertools
import time
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
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
LONG_RUN = 2.0  # seconds
WORTH_OPTIMISING = 4.0  # times the time to compile: a run that would take longer
INSTANT = 1e-6  # of the whole time


class TimedRun(NamedTuple):
    """A solution, the wall time that compiling and running took [s], and whether its program was optimised.

    See `linkax.simulate`: with beams it always is.
    """

    solution: Solution
    compile_s: float
    run_s: float
    optimised: bool


def simulate_in_segments(
    mechanism: Mechanism,
    state: State,
    *,
    t1: float,
    accuracy: Accuracy = BALANCED,
    solver: diffrax.AbstractSolver | None = None,
    formulation: str | AbstractFormulation = DEFAULT_FORMULATION,
    step: float | None = None,
    intervals: int = DEFAULT_INTERVALS,
    report: Callable[[str, float | None], None] = lambda phase, fraction: None,
    keep: Callable[[Solution], None] = lambda solution: None,
) -> TimedRun:
    """Integrate from 0 to t1 [s], and tell how far it is.

    A run that takes long is cut into segments, each with a few steps more than an uncut run
    needs. The first one tells whether that is worth it, and whether it is to optimise the program,
    which all others share.

    **Arguments:**

    - `mechanism`, `state`, `accuracy`, `solver`, `formulation`: see `linkax.simulate`.
    - `step`: of fixed size [s], instead of steps that adapt.
    - `intervals`: between the saved times, a multiple of 20.
    - `report`: called with what happens now, and with the fraction done where that is known.
    - `keep`: called with the solution so far, after each segment.

    **Returns:** a `TimedRun`; its solution ends with the segment that failed, if one did.
    """

    segment = intervals // SEGMENTS
    if solver is None:  # one for all parts
        solver = default_solver(mechanism, None if step else accuracy.rtol, t1)

    def run(start, t0, end, optimise, count=segment):
        """A part of the run, saved after `count` intervals; all such share a program."""
        began = time.perf_counter()
        times = np.pad(np.linspace(t0, end, count + 1), (0, intervals - count), mode="edge")
        found = simulate(
            mechanism,
            start,
            t0=t0,
            t1=end,
            accuracy=accuracy,
            solver=solver,
            formulation=formulation,
            saveat=diffrax.SaveAt(ts=times),
            optimise=optimise,
            throw=False,
            **fixed_steps(step, t1),
        )
        return jax.block_until_ready(found), time.perf_counter() - began

    report("compiling", None)
    optimised = bool(mechanism.beams)
    _, compile_s = run(state, 0.0, INSTANT * t1, optimised)
    report("integrating", 0.0)
    first, run_s = run(state, 0.0, t1 / SEGMENTS, optimised)
    if not optimised and SEGMENTS * run_s > WORTH_OPTIMISING * compile_s:
        report("optimising", None)
        optimised, (_, seconds) = True, run(state, 0.0, INSTANT * t1, True)
        compile_s += seconds
        report("integrating", 1.0 / SEGMENTS)
    # A classical formulation keeps what it leaves open: a segment would begin on the loops again.
    if not isinstance(first.formulation, TangentSpace) or not _is_long(first, run_s):
        whole, run_s = run(state, 0.0, t1, optimised, intervals)
        keep(whole)
        return TimedRun(whole, compile_s, run_s, optimised)
    parts, whole = [first], _joined([first])
    keep(whole)
    for t0, end in itertools.pairwise(np.linspace(0.0, t1, SEGMENTS + 1)[1:]):
        if whole.result != RESULTS.successful:
            break
        report("integrating", float(t0 / t1))
        part, seconds = run(whole.end, t0, end, optimised)
        parts, run_s = [*parts, part], run_s + seconds
        whole = _joined(parts)
        keep(whole)
    return TimedRun(whole, compile_s, run_s, optimised)


def _is_long(first, seconds):
    return SEGMENTS * seconds > LONG_RUN or SEGMENTS * first.stats["num_steps"] > DEFAULT_MAX_STEPS // 2


def _joined(parts) -> Solution:
    """One solution with as many times as a run without segments; a border belongs to the earlier one."""
    counted = {name: sum(part.stats[name] for part in parts) for name in parts[0].stats if name != "max_steps"}
    return dataclasses.replace(
        parts[-1],
        **{name: _one_after_another([getattr(part, name) for part in parts]) for name in ("ts", "q", "v")},
        stats=parts[-1].stats | counted,
        rank_nearby=np.max([part.rank_nearby for part in parts], axis=0),
        closest=min(part.closest for part in parts),
        average=_mean_distance(parts),
        definiteness=parts[0].definiteness,
        run=parts[0].run,
    )


def _mean_distance(parts):
    """Over the time of all parts, from a singular configuration."""
    lasting = [part for part in parts if part.t_end > part.ts[0]]
    durations = [part.t_end - part.ts[0] for part in lasting]
    return np.average([part.average for part in lasting], weights=durations) if lasting else parts[0].average


def _one_after_another(parts):
    """What each saved; the first times of the others are the last ones of those before."""
    saved = (len(parts[0]) - 1) // SEGMENTS
    first, *others = (np.asarray(part) for part in parts)
    return np.concatenate([first[: saved + 1], *(values[1 : saved + 1] for values in others)])
