"""Integration of a mechanism's motion in time."""

import warnings
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from linkax.equations.system import system_of
from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.named import formulation as named_formulation
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.functions import Function
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import flag, instance, known
from linkax.simulation.accuracy import BALANCED, Accuracy
from linkax.simulation.diagnosis import cause
from linkax.simulation.given import check_accuracy, checked_state, checked_time, sound_numbers
from linkax.simulation.integration import MechanismControl, Problem, Projected
from linkax.simulation.options import (
    check_kinds,
    check_saved_times,
    check_steps,
    floating,
    saved_times,
    saves_times,
    traced_tolerances,
)
from linkax.simulation.outset import Outset, depart
from linkax.simulation.remarks import in_words
from linkax.simulation.repeat import DEFAULT_SAVES, Repeat
from linkax.simulation.replay import Course, Steps, integrate, is_replayable
from linkax.simulation.results import (
    ENDED_WELL,
    RESULTS,
    WARNINGS,
    SimulationError,
    remark_name,
    result_name,
)
from linkax.simulation.rows import over_rows
from linkax.simulation.solution import Solution
from linkax.simulation.solvers import default_solver
from linkax.simulation.state import State
from linkax.simulation.switches import start_sides
from linkax.simulation.undefined import undefined_where
from linkax.tracing import all_known, compiled, runs_once

DEFAULT_MAX_STEPS = 16**4
_SAVE_STATE = diffrax.SubSaveAt(t1=True).fn


def simulate(
    mechanism: Mechanism,
    state: State,
    *,
    t1,
    t0=0.0,
    accuracy: Accuracy = BALANCED,
    formulation: str | AbstractFormulation | None = None,
    saveat: diffrax.SaveAt | None = None,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0=None,
    max_steps: int = DEFAULT_MAX_STEPS,
    adjoint: diffrax.AbstractAdjoint | None = None,
    event: diffrax.Event | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    dtype=None,
    optimise: bool = True,
    throw: bool = True,
) -> Solution:
    """Integrate the motion of a mechanism from a state at t0 to t1 [s].

    **Arguments:**

    - `mechanism`, `state`: see `linkax.Mechanism`, `linkax.assemble`. The state is moved onto
      the closed loops first.
    - `accuracy`: tolerances and projection, `linkax.DRAFT`, `BALANCED` (default), `PRECISE`, or
      an `Accuracy` of one's own.
    - `formulation`: of the equations of motion, default the paper's (`linkax.TangentSpace`). Or one of the
      classical ones it is compared with, by name ("lagrange-multipliers+baumgarte") or as a
      `linkax.ClassicalFormulation`; states are saved as it leaves them, on loops that drift open.
    - `saveat`: as in diffrax; default 201 times, evenly from t0 to t1. What is saved lies on the
      closed loops, as does the `State` that a `fn` of its own gets by (t, state, mechanism), but for
      classical formulations without a correction.
    - `solver`: a diffrax solver; default `Dopri8`, for some mechanisms with beams `Kvaerno5`, see
      `linkax.simulation.solvers`.
    - `stepsize_controller`: replaces rtol and atol of `accuracy`. It sees coordinates in radians
      and lengths of the mechanism, each of magnitude one, and speeds relative to the largest.
    - `adjoint`: of diffrax. By default both modes work, over the steps that the run took, where the solver is an
      explicit Runge-Kutta method and states are saved, without event and dense output; elsewhere it is
      `RecursiveCheckpointAdjoint`, for reverse mode. `ForwardMode` serves forward mode alone.
    - `event`: as in diffrax; condition functions get (t, state, mechanism). With a `root_finder` the run ends at the
      event, and its end has derivatives (`RecursiveCheckpointAdjoint` backwards, `ForwardMode` forwards). Without one
      it ends with the step in which the event occurs: derivatives of its end are not a number.
    - `dtype`: floating-point type of the whole computation, default double precision.
    - `dt0`, `max_steps`, `progress_meter`: as in diffrax.
    - `optimise`: False compiles in less than half of the time a program that takes three to eight times as long:
      for a run to be made once. It does nothing for mechanisms with beams, nor inside JAX transformations.
    - `throw`: raise where the run fails. Inside JAX transformations nothing is raised, and
      `solution.result` alone tells.

    **Returns:** a `Solution`.

    **Raises:** `ValueError` for bad arguments; `SimulationError`, which holds the `.solution` so
    far, where the run ends early: loops that do not close, numbers that are not finite,
    `max_steps` reached, a step size that falls to nothing. Derivatives of such a run are not a number.
    Warns (`AccuracyWarning`), outside JAX transformations, where rounding keeps the run from its tolerance: a body
    carries one far longer, or branches of the motion are too close to each other. Warns likewise (`StiffnessWarning`)
    where a stiff spring, damper or beam, and not the motion, chooses the steps, of which there are many. Inside of
    them `solution.remark()` says so, see `linkax.REMARKS`.
    """
    dtype, t0, t1 = floating(dtype), checked_time(t0, "t0"), checked_time(t1, "t1")
    if known(t0) is not None and known(t1) is not None and not t1 > t0:
        raise ValueError(f"t1 is {t1} s, t0 is {t0} s; t1 must be larger")
    state = checked_state(mechanism, state)
    check_accuracy(accuracy)
    flag(throw, "throw")
    flag(optimise, "optimise")
    check_kinds(
        saveat=saveat,
        solver=solver,
        stepsize_controller=stepsize_controller,
        adjoint=adjoint,
        event=event,
        progress_meter=progress_meter,
    )
    if stepsize_controller is None:
        stepsize_controller = diffrax.PIDController(rtol=accuracy.rtol, atol=accuracy.atol)
    if isinstance(formulation, str):
        formulation = named_formulation(formulation)
    names = "give a name, a linkax.ClassicalFormulation, or None"
    instance(formulation, AbstractFormulation | None, "formulation", names)
    if solver is None:
        rtol, _ = MechanismControl(stepsize_controller).tolerances((None, None))
        solver = default_solver(mechanism, rtol, t1 - t0)
    dt0 = check_steps(solver, stepsize_controller, dt0, max_steps, t0, t1)
    if saveat is None:
        evenly = np.linspace if all_known((t0, t1)) else jnp.linspace
        saveat = diffrax.SaveAt(ts=evenly(t0, t1, DEFAULT_SAVES))
    check_saved_times(saveat, t0, t1, max_steps)
    replayed = adjoint is None and _saves_states(saveat) and is_replayable(solver, saveat, event, max_steps)
    if adjoint is None:
        adjoint = diffrax.ForwardMode() if replayed else diffrax.RecursiveCheckpointAdjoint()
    saveat, event = _with_functions(saveat, event)
    control = MechanismControl(traced_tolerances(stepsize_controller), is_final=replayed)
    once = not optimise and not mechanism.beams  # whose large arrays take as long to compile either way
    mechanism, state, t0, accuracy = _cast((mechanism, state, t0, accuracy), dtype)
    # Compiled apart, so that another solver, formulation or saveat compiles no more than it must.
    outset = _start(mechanism, state, t0, accuracy)
    if not known(sound := sound_numbers(mechanism)):
        outset = outset.of_numbers(sound)
    found, formulation = _integrate(
        mechanism,
        accuracy,
        outset,
        formulation,
        t0,
        t1,
        dt0,
        saveat,
        Projected.around(solver, accuracy, adjoint, control),
        control,
        adjoint,
        replayed,
        event,
        diffrax.NoProgressMeter() if progress_meter is None else progress_meter,
        max_steps,
        once=once,
    )
    saves = _saves_states(saveat)
    times, values = (found.ts, found.t_end), (found.ys, found.y_end)
    end, saved = _closed(mechanism, accuracy, outset, formulation, times, values, saves, _firsts(saveat), once=once)
    solution = Solution(
        mechanism=mechanism,
        accuracy=accuracy,
        formulation=formulation,
        ts=found.ts,
        q=saved.q if saves else None,
        v=saved.v if saves else None,
        ys=None if saves else found.ys,
        t_end=found.t_end,
        end=end,
        stats=found.stats,
        result=found.result,
        rank_nearby=outset.rank,
        closest=found.closest,
        average=found.average,
        definiteness=outset.definiteness,
        interpolation=found.interpolation,
        repeat=Repeat.of(
            simulate, state, t0, dt0, solver, stepsize_controller, max_steps, optimise, saves_times(saveat)
        ),
    )
    if all_known((found, end, saved)):
        if result_name(solution.result) not in ENDED_WELL:
            if throw:
                raise _failure(solution, state)
        elif (remark := remark_name(solution.remark())) != "none":
            warnings.warn(in_words(solution, remark).lstrip(), WARNINGS[remark], stacklevel=2)
    return solution


def fixed_steps(step: float | None, t1: float) -> dict:
    """Options of `simulate` for steps of a fixed size up to t1 [s]; none for None."""
    if step is None:
        return {}
    most = max(DEFAULT_MAX_STEPS, int(2.0 * t1 / step))
    return {"dt0": step, "stepsize_controller": diffrax.ConstantStepSize(), "max_steps": most}


def _with_functions(saveat, event):
    """The same with their functions compared by what they compute, see `linkax.model.code`."""
    if event is not None:
        functions = jax.tree.map(Function, event.cond_fn, is_leaf=callable)
        event = eqx.tree_at(lambda e: e.cond_fn, event, functions)
    if not _saves_states(saveat):
        is_sub = lambda node: isinstance(node, diffrax.SubSaveAt)
        saveat = eqx.tree_at(lambda s: s.subs, saveat, jax.tree.map(_with_function, saveat.subs, is_leaf=is_sub))
    return saveat, event


def _with_function(sub):
    if sub.fn is _SAVE_STATE or (function := Function(sub.fn)).numbers:  # which diffrax takes for structure
        return sub
    return eqx.tree_at(lambda s: s.fn, sub, function)


class _OnManifold(eqx.Module):
    """A user's function of (t, state, mechanism), for diffrax: the state is closed first."""

    function: callable

    def __call__(self, t, y, args, **unused):  # diffrax passes `args` by name where it seeks the root of an event
        return self.function(t, args.close(t, y), args.mechanism)


def _wrapped_saves(subs):
    is_sub = lambda node: isinstance(node, diffrax.SubSaveAt)
    wrap = lambda sub: eqx.tree_at(lambda s: s.fn, sub, _OnManifold(_state_itself if sub.fn is _SAVE_STATE else sub.fn))
    return jax.tree.map(wrap, subs, is_leaf=is_sub)


def _state_itself(t, state, mechanism):
    return state


def _wrapped_event(event):
    if event is None:
        return None
    return eqx.tree_at(lambda e: e.cond_fn, event, jax.tree.map(_OnManifold, event.cond_fn, is_leaf=callable))


def _cast(tree, dtype):
    """A pytree with its numbers in a floating-point type."""
    real = lambda leaf: isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating)
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if real(leaf) and leaf.dtype != dtype else leaf, tree)


@runs_once
def _start(mechanism, state, t0, accuracy) -> Outset:
    dtype = state.q.dtype
    return depart(accuracy.method(dtype), system_of(mechanism, dtype), t0, state)


def _problem(mechanism, accuracy, outset, formulation) -> Problem:
    dtype = outset.state.q.dtype
    method = accuracy.method(dtype) if formulation is None else formulation
    if isinstance(method, TangentSpace):
        method = eqx.tree_at(lambda m: m.rank_nearby, method, outset.rank, is_leaf=lambda leaf: leaf is None)
    start = outset.sound, outset.t, outset.singular
    return Problem(mechanism, system_of(mechanism, dtype), method, accuracy, *start)


def _saves_states(saveat) -> bool:
    """Whether states are saved, and not functions of them."""
    return isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs.fn is _SAVE_STATE


class _Found(NamedTuple):
    """What the integration leaves: times and values saved, those at its end, and how it ended.

    `closest`, `average`: the smallest and the mean distance from a singular configuration.
    """

    ts: Any
    ys: Any
    t_end: Array
    y_end: Array
    stats: dict
    result: RESULTS
    closest: Array
    average: Array
    interpolation: Any


@compiled
def _integrate(
    mechanism,
    accuracy,
    outset,
    formulation,
    t0,
    t1,
    dt0,
    saveat,
    solver,
    controller,
    adjoint,
    replayed,
    event,
    progress_meter,
    max_steps,
):
    dtype = outset.state.q.dtype
    formulation, t0, t1, dt0, saveat, controller = _cast((formulation, t0, t1, dt0, saveat, controller), dtype)
    in_order, t0, t1, dt0, saveat = _in_order(t0, t1, dt0, saveat)
    problem = _problem(mechanism, accuracy, outset, formulation)
    problem = eqx.tree_at(lambda p: p.sound, problem, problem.sound & in_order)
    if not _saves_states(saveat):
        saveat = eqx.tree_at(lambda s: s.subs, saveat, _wrapped_saves(saveat.subs))
    q, v = outset.state.q, outset.state.v
    sides = start_sides(problem.system, t0, q, v) if controller.is_adaptive else ()
    y0 = problem.packed(q, v, sides=sides)
    event = _wrapped_event(event)
    integration = _Integration(
        outset, in_order, dt0, saveat, solver, controller, adjoint, event, progress_meter, max_steps
    )
    if replayed:
        found = integrate(Course(problem, y0, t0, t1, saveat.subs.ts), integration)
    else:
        found = integration(Course(problem, y0, t0, t1, None), False)[0]
    return _without_derivatives(found, event, (mechanism, outset.state, t0, t1, dt0, saveat)), formulation


def _without_derivatives(found: _Found, event, inputs) -> _Found:
    """What was found: without derivatives where the run failed, or ended with a step that an event ended."""
    failed = jnp.logical_not(jnp.stack([found.result == getattr(RESULTS, name) for name in ENDED_WELL]).any())
    at_end = failed
    if event is not None and event.root_finder is None:
        at_end = failed | (found.result == RESULTS.event_occurred)
    of_times = lambda ts: failed | (at_end & (ts >= found.t_end))
    of_values = lambda ts, ys: jax.tree.map(lambda y: of_times(ts).reshape(-1, *(1,) * (y.ndim - 1)), ys)
    values, fixed = eqx.partition((found.ts, found.ys, found.t_end, found.y_end), eqx.is_inexact_array)
    undefined = (
        jax.tree.map(of_times, values[0]),
        jax.tree.map(of_values, values[0], values[1]),
        at_end,
        at_end,
    )
    values = undefined_where(undefined, values, eqx.filter(inputs, eqx.is_inexact_array))
    ts, ys, t_end, y_end = eqx.combine(values, fixed)
    return found._replace(ts=ts, ys=ys, t_end=t_end, y_end=y_end)


def _in_order(t0, t1, dt0, saveat):
    """Whether traced times make sense, and the times: where they do not, others, from which no step is taken.

    diffrax would raise from inside a program, and for all members of a batch.
    """
    right = jnp.isfinite(t0) & (t1 > t0) & jnp.isfinite(t1)
    right = right if dt0 is None else right & jnp.isfinite(dt0) & (dt0 > 0.0)
    subs = saved_times(saveat)
    for ts in subs:
        right = right & jnp.all(jnp.isfinite(ts)) & jnp.all(jnp.diff(ts) >= 0.0) & (ts[0] >= t0) & (ts[-1] <= t1)
    either = lambda given, other: jnp.where(right, given, other)
    if subs:
        saveat = eqx.tree_at(saved_times, saveat, [jnp.where(right, ts, jnp.zeros_like(ts)) for ts in subs])
    zero = jnp.zeros_like(t0)
    return right, either(t0, zero), either(t1, zero + 1.0), None if dt0 is None else either(dt0, zero + 1.0), saveat


class _Integration(eqx.Module):
    """diffrax's integration of a course, with all its options."""

    outset: Outset
    in_order: Bool[Array, ""]
    dt0: Any
    saveat: diffrax.SaveAt
    solver: Projected
    controller: MechanismControl
    adjoint: diffrax.AbstractAdjoint
    event: Any
    progress_meter: diffrax.AbstractProgressMeter
    max_steps: int = eqx.field(static=True)

    def __call__(self, course: Course, track: bool):
        """What the integration leaves, and its steps if they are to be tracked."""
        end, steps = diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t0=True, steps=True)
        saveat = self.saveat
        if course.saved is not None:
            saveat = eqx.tree_at(lambda s: s.subs.ts, saveat, course.saved)
        saveat = eqx.tree_at(
            lambda s: (s.subs, s.solver_state),
            saveat,
            ((saveat.subs, end, steps) if track else (saveat.subs, end), True),
            is_leaf=lambda leaf: leaf is None,
        )
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(_derivative),
            self.solver,
            course.t0,
            course.t1,
            self.dt0,
            course.y0,
            course.problem,
            saveat=saveat,
            stepsize_controller=self.controller,
            adjoint=self.adjoint,
            event=self.event,
            max_steps=self.max_steps,
            throw=False,
            progress_meter=self.progress_meter,
        )
        (ts, t_end, *times), (ys, y_end, *states) = found.ts, found.ys
        result = _result(found.result, self.outset, self.in_order, self.controller.is_adaptive)
        closest = found.solver_state[2]
        steps = Steps(times[0], states[0], found.stats["num_accepted_steps"]) if track else None
        average = lax.stop_gradient(y_end[0, -1] / (t_end[0] - course.t0))
        return _Found(ts, ys, t_end[0], y_end[0], found.stats, result, closest, average, found.interpolation), steps

    def rows(self, y0, saved, end):
        """What diffrax saves, of values at the start, at saved times, and at the end."""
        sub = self.saveat.subs
        parts = [y0[None]] * sub.t0 + [saved] * (sub.ts is not None) + [end[None]] * sub.t1
        return jnp.concatenate(parts)


def _firsts(saveat):
    """For each saved time the first row of that time, which may come more than once; None where times are traced."""
    ts = known(saveat.subs.ts) if saves_times(saveat) else None
    return None if ts is None else np.searchsorted(ts, ts)


@compiled
def _closed(mechanism, accuracy, outset, formulation, times, values, saves, firsts) -> tuple[State, State | None]:
    """The state at the end, and those that are saved, on the loops; infinite where none was saved."""
    problem = _problem(mechanism, accuracy, outset, formulation)
    (ts, t_end), (ys, y_end) = times, values
    if not saves:
        return problem.close(t_end, y_end), None
    # The end comes first, so that it is in the same part as times that were saved.
    saved = jnp.isfinite(ts)
    once = saved if firsts is None else saved & (firsts == jnp.arange(len(ts)))
    rows = [jnp.concatenate(parts) for parts in ((jnp.ones(1, bool), once), (t_end[None], ts), (y_end[None], ys))]
    closed = over_rows(problem.close, *rows)
    each = lambda rows: rows[1:] if firsts is None else rows[1:][firsts]
    later = lambda rows: jnp.where(saved[:, None], each(rows), jnp.inf)
    return State(closed.q[0], closed.v[0]), State(later(closed.q), later(closed.v))


def _derivative(t, y, problem):
    return problem.derivative(t, y)


def _result(result, outset, in_order, is_adaptive):
    """The first of what is wrong at the start, else how the integration ended."""
    result = RESULTS.promote(result)
    if not is_adaptive:
        result = RESULTS.where(result == RESULTS.dt_min_reached, RESULTS.diverged, result)
    result = RESULTS.where(outset.unique, result, RESULTS.not_unique)
    result = RESULTS.where(outset.on_branch, result, RESULTS.no_branch)
    result = RESULTS.where(outset.closed, result, RESULTS.not_closed)
    result = RESULTS.where(outset.massive, result, RESULTS.massless)
    result = RESULTS.where(outset.finite, result, RESULTS.not_finite)
    result = RESULTS.where(outset.assembled, result, RESULTS.not_assembled)
    return RESULTS.where(in_order, result, RESULTS.times_out_of_order)


def _failure(solution, state) -> SimulationError:
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
    why = cause(solution, state) or in_words(solution, *doubts)
    return SimulationError(f"simulation stopped {when}: {RESULTS[solution.result]}{why}", solution)
