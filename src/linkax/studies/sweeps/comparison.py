"""Compare formulations of the equations of motion on one mechanism."""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
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
from linkax.studies.sweeps.comparison_result import Comparison, Trial

TIGHTEST, NEXT_TO_IT = 1e-13, 1e-12  # tolerances of the reference run and of the run that checks it
DIVERGED = 1e-2  # default bound of the error, in lengths of the mechanism
OPEN = 1e-3  # violation of positions from which loops are told to be open [rad, or lengths of the loop]
INSTANT = 1e-6  # duration of the run that compiles, relative to the whole
LONG_RUN = 0.5  # a run that takes longer is timed once [s]
STOPPED = {
    "dt_min_reached": "the step size fell to nothing",
    "locked": "the mechanism locks",
    "max_steps_reached": "out of steps",
    "diverged": "numbers were no longer finite",
}


class Stepping(NamedTuple):
    """A solver with adaptive steps to a tolerance `rtol`, or with fixed steps of size `step` [s]."""

    solver: diffrax.AbstractSolver
    rtol: float | None = None
    step: float | None = None


def compare(
    mechanism: Mechanism,
    state: State,
    points: Mapping[str, tuple[str, str | None]],
    *,
    t1: int | float,
    steppings: Sequence[Stepping],
    formulations: Mapping[str, AbstractFormulation | None] | Sequence[str] = COMPARED,
    exact: Callable[[np.ndarray], Mapping[str, np.ndarray] | None] | None = None,
    bound: int | float | None = None,
    repeats: int = 3,
    report: Callable[[str, float | None], None] = lambda phase, fraction: None,
    keep: Callable[[Comparison], None] = lambda comparison: None,
) -> Comparison:
    """Integrate the same motion from 0 to t1 [s] by several formulations.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`.
    - `points`: {name: (body, frame of the body or None for its centre of mass)}, whose positions are compared.
    - `steppings`: how to step; each formulation runs with each of them.
    - `formulations`: names of `linkax.formulations.named`, or {name of one's own: formulation}.
    - `exact`: times -> {name of a point: positions, (n_t, 3) [m]}, the closed form, or None where there is none.
    - `bound`: of the error [m]; by default a hundredth of the mechanism's length.
    - `repeats`: number of runs of each trial, of which the shortest time counts.
    - `report`: called with the current phase, and with the fraction done where that is known.
    - `keep`: called with the comparison so far, after each formulation.

    **Returns:** a `Comparison`, its trials in the order of the formulations, and for each of these of the steppings.

    **Raises:** `ValueError` for an unknown name; `SimulationError` where the paper's formulation cannot integrate the
    motion.
    """
    state, t1 = checked_state(mechanism, state), float(checked_time(t1, "t1"))
    _check_points(mechanism, points)
    _check_asked(t1, steppings, formulations, bound, repeats)
    chosen = _chosen(formulations)
    motion = _Motion(mechanism, state, points, np.linspace(0.0, t1, DEFAULT_SAVES))
    report("compiling the reference run", None)
    reference, answer, comparison = _reference(motion, exact)
    if bound is not None:
        comparison = comparison._replace(bound=bound)
    for count, (name, formulation) in enumerate(chosen.items()):
        report(f"running {name}", count / len(chosen))
        for stepping in steppings:
            motion.run(formulation, stepping, INSTANT)  # compiles, where no formulation before it has
            solution, seconds = _timed(functools.partial(motion.run, formulation, stepping), repeats)
            apart = np.where(np.isfinite(solution.ts), _apart(motion.positions(_plain(solution)), answer), 0.0)
            trial = _trial(name, stepping, solution, seconds, apart, comparison, reference)
            comparison = comparison._replace(trials=[*comparison.trials, trial])
        keep(comparison)
    return comparison


class _Motion(NamedTuple):
    """The motion to integrate, its points to compare, and the times to save [s]."""

    mechanism: Mechanism
    state: State
    points: Mapping[str, tuple[str, str | None]]
    times: np.ndarray

    def run(
        self, formulation: AbstractFormulation | None, stepping: Stepping, part: float = 1.0, throw: bool = False
    ) -> Solution:
        """Integrate the first `part` of the time."""
        times, t1 = part * self.times, float(self.times[-1])
        solution = simulate(
            self.mechanism,
            self.state,
            t1=times[-1],
            accuracy=Accuracy(rtol=TIGHTEST if stepping.rtol is None else stepping.rtol),
            formulation=formulation,
            solver=stepping.solver,
            saveat=diffrax.SaveAt(ts=jnp.asarray(times)),
            throw=throw,
            **fixed_steps(stepping.step, t1),
        )
        return jax.block_until_ready(solution)

    def positions(self, solution: Solution) -> dict[str, np.ndarray]:
        """{name of a point: positions, (n_t, 3) [m]}."""
        return {name: np.asarray(solution.position(*point)) for name, point in self.points.items()}


def _reference(motion, exact) -> tuple[Solution, Mapping[str, np.ndarray], Comparison]:
    """The reference run, the known answer, and a comparison with it that has no trials yet."""
    at_tolerance = lambda rtol: motion.run(DEFAULT_FORMULATION, Stepping(diffrax.Dopri8(), rtol=rtol), throw=True)
    reference = at_tolerance(TIGHTEST)
    known = None if exact is None else exact(motion.times)
    answer = motion.positions(reference) if known is None else known
    other = at_tolerance(NEXT_TO_IT) if known is None else reference
    comparison = Comparison(
        answer="reference run" if known is None else "closed form",
        uncertainty=float(np.max(_apart(motion.positions(other), answer))),
        bound=DIVERGED * float(system_of(motion.mechanism, float).length),
        passages=[float(passage) for passage in reference.passages().times],
        trials=[],
    )
    return reference, answer, comparison


def _chosen(formulations) -> dict[str, AbstractFormulation]:
    """{name: formulation}, the classical ones in one program."""
    is_own = isinstance(formulations, Mapping)
    chosen = {name: formulations[name] if is_own else named(name) for name in formulations}
    classical = {name: entry for name, entry in chosen.items() if isinstance(entry, ClassicalFormulation)}
    return chosen | dict(zip(classical, in_one_program(list(classical.values())), strict=True))


def _check_points(mechanism, points):
    if not isinstance(points, Mapping) or not points:
        raise ValueError(f"points are {points!r}; give {{name: (body, frame of the body or None)}}")
    for name, at in points.values():
        body = mechanism.body(name)
        if at is not None:
            body.at(at)


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
    """A run's solution, and the shortest time that it takes [s]."""

    def timed():
        began = time.perf_counter()
        return run(), time.perf_counter() - began

    solution, shortest = timed()
    for _ in range(repeats - 1):
        if shortest > LONG_RUN:
            break
        solution, seconds = timed()
        shortest = min(shortest, seconds)
    return solution, shortest


def _plain(solution) -> Solution:
    """The same motion, with the default formulation, so that all share the programs that read it."""
    return dataclasses.replace(solution, run=solution.run.changed(formulation=DEFAULT_FORMULATION))


def _apart(positions, answer):
    """Largest distance of any point from the answer at each time [m]; infinite where a number is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        distances = [np.linalg.norm(positions[name] - answer[name], axis=-1) for name in answer if name in positions]
    largest = np.max(distances, axis=0)
    return np.where(np.isfinite(largest), largest, np.inf)


def _trial(name, stepping, solution, seconds, apart, comparison, reference) -> Trial:
    """A trial, from its solution, run time and the distances `apart` from the answer."""
    reached = np.isfinite(np.asarray(solution.ts))
    energy = np.asarray(_plain(solution).energy() - reference.energy())[reached]
    kinetic = np.max(np.asarray(reference.kinetic_energy()))
    error = float(np.max(apart))
    converged = bool(solution.result == RESULTS.successful) and error <= comparison.bound
    diverged_at, why = (None, "") if converged else _divergence(solution, apart, comparison)
    worst = solution.worst_violation()
    steps = int(solution.stats["num_steps"])
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
        evaluations=evaluations(stepping.solver, steps, solution.formulation.moves_after_steps),
        run_s=seconds,
        reached=float(solution.t_end),
        verdict="converged" if converged else "diverged",
        diverged_at=diverged_at,
        why=why,
    )


def _divergence(solution, apart, comparison) -> tuple[float, str]:
    """When a trial diverged [s], and how, in words."""
    if not bool(solution.result == RESULTS.successful):
        stopped = float(solution.t_end)
        how = STOPPED.get(result_name(solution.result), "failed")
        return stopped, f"stopped at {stopped:.4g} s: {how}.{cause(solution)}"
    first = int(np.argmax(apart > comparison.bound))
    diverged_at, gap = float(solution.ts[first]), float(solution.violation().position[first])
    loops = f"loops open by {gap:.0e}" if gap > OPEN else f"loops closed to {gap:.0e}"
    before = [passage for passage in comparison.passages if passage <= diverged_at]
    passage = f"; last singular passage at {before[-1]:.4g} s." if before else "."
    return diverged_at, f"off by more than {comparison.bound:.2g} m at {diverged_at:.4g} s, {loops}{passage}"


def evaluations(solver: diffrax.AbstractSolver, steps: int, anew: bool = False) -> int | None:
    """Number of evaluations of the equations of motion in a number of Runge-Kutta steps; None for other solvers.

    `anew`: whether each step evaluates them at its start, also where its method could reuse the last stage.
    """
    tableau = getattr(solver, "tableau", None)
    if not isinstance(tableau, diffrax.ButcherTableau):
        return None
    reused = tableau.fsal and not anew
    return steps * (tableau.num_stages - reused) + int(reused)


def at_equal_cost(trials: Sequence[Trial], budget_s: float) -> list[Trial]:
    """Of each formulation, the trial of smallest error among those that converged within `budget_s` [s].

    Where none did, its fastest trial.
    """
    best = []
    for name in dict.fromkeys(trial.formulation for trial in trials):
        own = [trial for trial in trials if trial.formulation == name]
        finished = [trial for trial in own if trial.verdict == "converged" and trial.run_s <= budget_s]
        best.append(min(finished, key=lambda t: t.error) if finished else min(own, key=lambda t: t.run_s))
    return best
