"""Simulation: from a mechanism and a state to a motion in time."""

from typing import Any

import diffrax

from linkax.formulations.formulation import AbstractFormulation
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, require_bool
from linkax.simulation.explain.diagnosis import cause
from linkax.simulation.explain.remarks import in_words, remark
from linkax.simulation.integrate.accuracy import BALANCED, Accuracy
from linkax.simulation.integrate.integrate import integrate_run
from linkax.simulation.integrate.results import ENDED_WELL, RESULTS, WARNINGS, SimulationError, remark_name, result_name
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, DEFAULT_MAX_STEPS, Run
from linkax.simulation.read.solution import Solution
from linkax.simulation.start.state import State
from linkax.xla.tracing import all_concrete
from linkax.xla.users_line import warn


def simulate(
    mechanism: Mechanism,
    state: State,
    *,
    t1: Number,
    t0: Number = 0.0,
    accuracy: Accuracy = BALANCED,
    formulation: str | AbstractFormulation | None = DEFAULT_FORMULATION,
    saveat: diffrax.SaveAt | None = None,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: Number | None = None,
    max_steps: int | None = DEFAULT_MAX_STEPS,
    adjoint: diffrax.AbstractAdjoint | None = None,
    event: diffrax.Event | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    dtype: Any = None,
    optimise: bool | None = None,
    throw: bool = True,
) -> Solution:
    """Integrate the motion of a mechanism from a state at t0 to t1 [s].

    **Arguments:**

    - `mechanism`, `state`: see `linkax.Mechanism`, `linkax.assemble`. The state is moved onto
      the closed loops first.
    - `accuracy`: tolerances and projection, `linkax.DRAFT`, `BALANCED` (default), `PRECISE`, or
      an `Accuracy` of one's own.
    - `formulation`: of the equations of motion, default the paper's, `linkax.TangentSpace()`, which has numbers of its
      own. Or one of the classical ones it is compared with, by name ("lagrange-multipliers+baumgarte") or as a
      `linkax.ClassicalFormulation`; states are saved as it leaves them, on loops that drift open.
    - `saveat`: as in diffrax; default 201 times, evenly from t0 to t1. What is saved lies on the
      closed loops, as does the `State` that a `fn` of its own gets by (t, state, mechanism), but for
      classical formulations without a correction.
    - `solver`: a diffrax solver; default `Dopri8`, for some mechanisms with beams `linkax.Rodas5P`, see
      `linkax.simulation.integrate.default_solver`.
    - `stepsize_controller`: replaces rtol and atol of `accuracy`. It sees coordinates in radians
      and lengths of the mechanism, each of magnitude one, and speeds relative to the largest.
    - `adjoint`: of diffrax. By default both modes work, over the steps that the run took, where the solver is an
      explicit Runge-Kutta method and states are saved, without event and dense output; elsewhere it is
      `RecursiveCheckpointAdjoint`, for reverse mode. `ForwardMode` serves forward mode alone.
    - `event`: as in diffrax; condition functions get (t, state, mechanism), with the state on the closed loops. Read it
      by name: `lx.Solution.of_state(mechanism, state, t=t).joint("bearing")[0]`, or `.joint_speed("bearing")[0]`, or
      `.position("crank", "tip")[0]`. The event occurs where a condition becomes true, or a number passes zero: upwards
      with `direction=True`, downwards with `direction=False`, either way by default. With a `root_finder` the run ends
      at the event, and its end has derivatives (`RecursiveCheckpointAdjoint` backwards, `ForwardMode` forwards).
      Without one it ends with the step in which the event occurs: derivatives of its end are not a number.
    - `dtype`: floating-point type of the whole computation, default double precision.
    - `dt0`, `max_steps`, `progress_meter`: as in diffrax.
    - `optimise`: deprecated, and without effect: every run compiles as quickly as those without it did.
    - `throw`: raise where the run fails. Inside JAX transformations nothing is raised, and
      `solution.result` alone tells.

    **Returns:** a `Solution`.

    **Raises:** `ValueError` for bad arguments; `SimulationError`, which holds the `.solution` so
    far, where the run ends early: loops that do not close, numbers that are not finite,
    `max_steps` reached, a step size that falls to nothing. Derivatives of such a run are not a number.
    Warns (`AccuracyWarning`), outside JAX transformations, where rounding keeps the run from its tolerance: a body
    carries one far longer, or branches of the motion are too close to each other. Warns likewise (`StiffnessWarning`)
    where a stiff spring, damper or beam, or a fast internal state, and not the motion, chooses the steps, of which
    there are many. Inside of them `solution.remark()` says so, see `linkax.REMARKS`.
    """
    require_bool(throw, "throw")
    if optimise is not None:
        require_bool(optimise, "optimise")
        warn("optimise has no effect any more; leave it out", DeprecationWarning)
    run = Run.of(
        mechanism,
        state,
        t0=t0,
        t1=t1,
        accuracy=accuracy,
        formulation=formulation,
        dtype=dtype,
        saveat=saveat,
        solver=solver,
        stepsize_controller=stepsize_controller,
        dt0=dt0,
        max_steps=max_steps,
        adjoint=adjoint,
        event=event,
        progress_meter=progress_meter,
    )
    outcome = integrate_run(run)
    solution = Solution.of_run(run, outcome)
    if all_concrete((outcome.integrated, outcome.end, outcome.saved)):
        if result_name(solution.result) not in ENDED_WELL:
            if throw:
                raise _failure(solution)
        elif (found := remark_name(remark(solution))) != "none":
            warn(in_words(solution, found).lstrip(), WARNINGS[found])
    return solution


def fixed_steps(step: float | None, t1: float) -> dict:
    """Options of `simulate` for steps of a fixed size up to t1 [s]; none for None."""
    if step is None:
        return {}
    most = max(DEFAULT_MAX_STEPS, int(2.0 * t1 / step))
    return {"dt0": step, "stepsize_controller": diffrax.ConstantStepSize(), "max_steps": most}


def _failure(solution) -> SimulationError:
    """Where and why a run failed."""
    at_start = (
        "times_out_of_order",
        "not_finite",
        "not_assembled",
        "massless",
        "not_closed",
        "no_branch",
        "not_unique",
    )
    before = any(solution.result == getattr(RESULTS, name) for name in at_start)
    when = "before it began" if before else f"at t = {float(solution.t_end):.6g} s"
    doubts = ("stiff",) if solution.result == RESULTS.max_steps_reached else ("single_precision", "lingers")
    why = cause(solution) or in_words(solution, *doubts)
    return SimulationError(f"simulation stopped {when}: {RESULTS[solution.result]}{why}", solution)
