"""Formulations side by side on one mechanism."""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import diffrax
import jax
import numpy as np

from linkax.equations.system import system_of
from linkax.formulations.classical import ClassicalFormulation
from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.named import COMPARED
from linkax.formulations.named import formulation as named
from linkax.formulations.switch import in_one_program
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import number, require, require_type, whole_number
from linkax.simulation.explain.diagnosis import cause
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.results import RESULTS, result_name
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, DEFAULT_SAVES
from linkax.simulation.read.solution import Solution
from linkax.simulation.simulate import fixed_steps, simulate
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time

TIGHTEST, NEXT_TO_IT = 1e-13, 1e-12  # tolerances of the reference and of its check
DIVERGED = 1e-2  # of the mechanism's length
OPEN = 1e-3  # violation of positions [rad, or lengths of the loop]
INSTANT = 1e-6  # of the whole time
LONG_RUN = 0.5  # a run that takes longer [s] is timed once
STOPPED = {
    "dt_min_reached": "the step size fell to nothing",
    "max_steps_reached": "out of steps",
    "diverged": "numbers were no longer finite",
}


class Trial(NamedTuple):
    """One run of a formulation.

    - `rtol` of adaptive steps, or `step` of fixed ones [s]; the other is None.
    - `error`: largest distance of any point from the known answer, at all times reached [m].
    - `position_violation`, `velocity_violation`, `acceleration_violation`: see `Solution.worst_violation`.
    - `energy_error`: largest difference from the reference run's energy, over its largest kinetic energy [J if none].
    - `steps`, `evaluations`: of the solver, and of the equations of motion in them. `run_s`: wall time [s].
    - `reached` [s]. `verdict`: "converged", or "diverged": the run ended early, or its error is above the bound.
    - `diverged_at`: where it ended early, or its error first was above the bound [s]; None where it converged.
    - `why`: how it diverged, in words.
    """

    formulation: str
    rtol: float | None
    step: float | None
    error: float
    position_violation: float
    velocity_violation: float
    acceleration_violation: float
    energy_error: float
    steps: int
    evaluations: int | None
    run_s: float
    reached: float
    verdict: str
    diverged_at: float | None
    why: str


class Comparison(NamedTuple):
    """What was compared, and with what.

    - `answer`: the known answer: "closed form", or the reference run, the paper's formulation at a tolerance of 1e-13.
    - `uncertainty`: how far the reference run is from the closed form, or from a run at 1e-12 [m].
    - `bound`: an error above counts as diverged [m]. `passages`: through singular configurations [s].
    """

    answer: str
    uncertainty: float
    bound: float
    passages: list[float]
    trials: list[Trial]


class Stepping(NamedTuple):
    """Adaptive steps to a tolerance, or fixed steps [s]."""

    solver: diffrax.AbstractSolver
    rtol: float | None = None
    step: float | None = None


def compare(
    mechanism: Mechanism,
    state: State,
    points: Mapping[str, tuple[str, str | None]],
    *,
    t1: float,
    steppings: Sequence[Stepping],
    formulations: Mapping[str, AbstractFormulation] | Sequence[str] = COMPARED,
    exact: Callable[[np.ndarray], Mapping[str, np.ndarray]] | None = None,
    bound: float | None = None,
    repeats: int = 3,
    report: Callable[[str, float | None], None] = lambda phase, fraction: None,
    keep: Callable[[Comparison], None] = lambda found: None,
) -> Comparison:
    """Integrate the same motion from 0 to t1 [s] by several formulations.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`.
    - `points`: {name: (body, frame of the body or None for its centre of mass)}, whose positions are compared.
    - `steppings`: how to step; every formulation is run with each of them.
    - `formulations`: names of `linkax.formulations.named`, or {name of one's own: formulation}.
    - `exact`: times -> positions of the points, (n_t, 3) each [m], or None, where they are known in closed form.
    - `bound`: of the error [m]; default: a hundredth of the mechanism's length.
    - `repeats`: of each run, of which the shortest counts.
    - `report`: called with what happens now, and with the fraction done where that is known.
    - `keep`: called with the comparison so far, after each formulation.

    **Returns:** a `Comparison`, of trials in the order of formulations, for each of these of steppings.

    **Raises:** `ValueError` for an unknown name; `SimulationError` where the paper's formulation cannot do the motion.
    """
    state, t1 = checked_state(mechanism, state), float(checked_time(t1, "t1"))
    _check_points(mechanism, points)
    _check_asked(t1, steppings, formulations, bound, repeats)
    chosen = dict(formulations) if isinstance(formulations, Mapping) else {name: named(name) for name in formulations}
    classical = {name: entry for name, entry in chosen.items() if isinstance(entry, ClassicalFormulation)}
    chosen |= dict(zip(classical, in_one_program(list(classical.values())), strict=True))
    times = np.linspace(0.0, t1, DEFAULT_SAVES)
    positions = lambda found: {name: np.asarray(found.position(*point)) for name, point in points.items()}

    def run(formulation, stepping, times=times, throw=False):
        found = simulate(
            mechanism,
            state,
            t1=times[-1],
            accuracy=Accuracy(rtol=TIGHTEST if stepping.rtol is None else stepping.rtol),
            formulation=formulation,
            solver=stepping.solver,
            saveat=diffrax.SaveAt(ts=times),
            throw=throw,
            **fixed_steps(stepping.step, t1),
        )
        return jax.block_until_ready(found)

    report("compiling the reference run", None)
    reference = run(DEFAULT_FORMULATION, Stepping(diffrax.Dopri8(), rtol=TIGHTEST), throw=True)
    known = None if exact is None else exact(times)
    answer = positions(reference) if known is None else known
    other = (
        run(DEFAULT_FORMULATION, Stepping(diffrax.Dopri8(), rtol=NEXT_TO_IT), throw=True)
        if known is None
        else reference
    )
    bound = DIVERGED * float(system_of(mechanism, float).length) if bound is None else bound
    passages = [float(passage) for passage in reference.passages().times]
    uncertainty = float(np.max(_apart(positions(other), answer)))
    kind = "reference run" if known is None else "closed form"
    found = Comparison(kind, uncertainty, bound, passages, [])
    for count, (name, formulation) in enumerate(chosen.items()):
        report(f"running {name}", count / len(chosen))
        for stepping in steppings:
            run(formulation, stepping, INSTANT * times)  # compiles, where no formulation before it has
            solution, seconds = _timed(functools.partial(run, formulation, stepping), repeats)
            apart = np.where(np.isfinite(solution.ts), _apart(positions(_plain(solution)), answer), 0.0)
            trial = _trial(name, stepping, solution, seconds, apart, bound, reference, passages)
            found = found._replace(trials=[*found.trials, trial])
        keep(found)
    return found


def _check_points(mechanism, points):
    if not isinstance(points, Mapping) or not points:
        raise ValueError(f"points are {points!r}; give {{name: (body, frame of the body or None)}}")
    for body, at in points.values():
        found = mechanism.body(body)
        if at is not None:
            found.at(at)


def _check_asked(t1, steppings, formulations, bound, repeats):
    require(np.asarray(t1), lambda t: t > 0.0, "t1 [s]", "it must be positive")
    whole_number(repeats, "repeats")
    if bound is not None:
        require(number(bound, (), "bound [m]"), lambda x: x > 0.0, "bound [m]", "it must be positive")
    if not isinstance(steppings, Sequence) or not steppings:
        raise ValueError(f"steppings are {steppings!r}; give a list of linkax.Stepping(solver, rtol=...)")
    for stepping in steppings:
        require_type(stepping, Stepping, "an entry of steppings", "give a linkax.Stepping(solver, rtol=...)")
    if not isinstance(formulations, Mapping | Sequence) or isinstance(formulations, str) or not formulations:
        raise ValueError(f"formulations are {formulations!r}; give a list of names, or {{name: formulation}}")


def _timed(run, repeats):
    """What a run finds, and the shortest time that it takes [s]."""
    shortest = np.inf
    for _ in range(repeats):
        began = time.perf_counter()
        found = run()
        shortest = min(shortest, time.perf_counter() - began)
        if shortest > LONG_RUN:
            break
    return found, shortest


def _plain(found) -> Solution:
    """The same motion, read by programs that all formulations share."""
    return dataclasses.replace(found, run=found.run.changed(formulation=DEFAULT_FORMULATION))


def _apart(positions, answer):
    """Largest distance of any point at each time [m], infinite where a number is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        distances = [np.linalg.norm(positions[name] - answer[name], axis=-1) for name in answer if name in positions]
    largest = np.max(distances, axis=0)
    return np.where(np.isfinite(largest), largest, np.inf)


def _trial(name, stepping, found, seconds, apart, bound, reference, passages) -> Trial:
    finished = bool(found.result == RESULTS.successful)
    reached = np.isfinite(np.asarray(found.ts))
    energy = np.asarray(_plain(found).energy() - reference.energy())[reached]
    kinetic = np.max(np.asarray(reference.kinetic_energy()))
    error = float(np.max(apart))
    verdict = "converged" if finished and error <= bound else "diverged"
    diverged_at, why = None, ""
    if not finished:
        diverged_at = float(found.t_end)
        why = f"stopped at {diverged_at:.4g} s: {STOPPED.get(result_name(found.result), 'failed')}."
        why += cause(found)
    elif verdict == "diverged":
        first = int(np.argmax(apart > bound))
        gap = float(found.violation().position[first])
        loops = f"loops open by {gap:.0e}" if gap > OPEN else f"loops closed to {gap:.0e}"
        diverged_at = float(found.ts[first])
        why = f"off by more than {bound:.2g} m at {diverged_at:.4g} s, {loops}"
        before = [passage for passage in passages if passage <= diverged_at]
        why += f"; last singular passage at {before[-1]:.4g} s." if before else "."
    worst = found.worst_violation()
    steps = int(found.stats["num_steps"])
    return Trial(
        formulation=name,
        rtol=stepping.rtol,
        step=stepping.step,
        error=error,
        position_violation=float(worst.position),
        velocity_violation=float(worst.velocity),
        acceleration_violation=float(worst.acceleration),
        energy_error=float(np.max(np.abs(energy), initial=0.0) / (kinetic if kinetic > 0.0 else 1.0)),
        steps=steps,
        evaluations=evaluations(stepping.solver, steps, found.formulation.moves_after_steps),
        run_s=seconds,
        reached=float(found.t_end),
        verdict=verdict,
        diverged_at=diverged_at,
        why=why,
    )


def evaluations(solver, steps: int, anew: bool = False) -> int | None:
    """Evaluations of the equations of motion in so many Runge-Kutta steps; `anew`: that at the start of each too."""
    tableau = getattr(solver, "tableau", None)
    if tableau is None:
        return None
    reused = tableau.fsal and not anew
    return steps * (tableau.num_stages - reused) + int(reused)


def at_equal_cost(trials: Sequence[Trial], budget_s: float) -> list[Trial]:
    """Of each formulation the trial of the smallest error among those that converged within `budget_s` [s].

    Where none did, the fastest one.
    """
    found = []
    for name in dict.fromkeys(trial.formulation for trial in trials):
        own = [trial for trial in trials if trial.formulation == name]
        finished = [trial for trial in own if trial.verdict == "converged" and trial.run_s <= budget_s]
        found.append(min(finished, key=lambda t: t.error) if finished else min(own, key=lambda t: t.run_s))
    return found
