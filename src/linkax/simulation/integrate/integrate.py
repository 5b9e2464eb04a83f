"""The compiled programs of a run: check its start, integrate, close what was saved."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from linkax.equations.internal_states import bound
from linkax.equations.system import system_of
from linkax.formulations.formulation import AbstractFormulation
from linkax.model.known_times import known_times
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.discrete_adjoint import Integrated, integrate, solve_by_diffrax
from linkax.simulation.integrate.impacts import has_ended, impacts_of, is_driven_in
from linkax.simulation.integrate.integrator import InitialValueProblem, Integrator
from linkax.simulation.integrate.map_saved_times import map_saved_times
from linkax.simulation.integrate.options import saved_times
from linkax.simulation.integrate.problem import Problem
from linkax.simulation.integrate.projected_solver import ProjectedSolver
from linkax.simulation.integrate.results import RESULTS, ended_well
from linkax.simulation.integrate.run import SAVE_STATE, Run, cast, saves_states
from linkax.simulation.integrate.switches import start_sides
from linkax.simulation.start.initial_state import InitialCheck, check_initial_state
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import sound_numbers
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, concrete, is_first
from linkax.xla.undefined import infinite_where, undefined_where
from linkax.xla.waiting import compiling
from scalarjit import Flat, scalarised


class Outcome(NamedTuple):
    """What a run leaves: the check of its start, the integration, and states on the loops at the end and as saved."""

    initial: InitialCheck
    integrated: Integrated
    end: State
    saved: State | None


def integrate_run(run: Run) -> Outcome:
    """Integrate a run, in three programs: another solver, formulation or saveat compiles no more than it must."""
    given = run.flat, run.state, run.t0, run.tangent_space
    if all_concrete(run) and is_first(run.mechanism.topology, run.flat.noted):
        with compiling(), ThreadPoolExecutor() as threads:
            # While XLA compiles one program, in a thread, Python traces the next.
            threads.submit(_check_start.lower(*given).compile)
            initial = _check_start.blank_result(*given)
            threads.submit(_integrate.lower(run, initial).compile)
            integrated = _integrate.blank_result(run, initial)
            threads.submit(_closed.lower(*_closing(run, initial, integrated)).compile)
    initial = _check_start(*given)
    if concrete(sound := sound_numbers(run.mechanism)) is None:
        initial = initial.of_numbers(sound)
    integrated = _integrate(run, initial)
    reached, end, saved = _closed(*_closing(run, initial, integrated))
    return Outcome(initial, integrated._replace(**reached._asdict()), end, saved)


def _closing(run, initial, integrated):
    """The arguments of `_closed`."""
    saveat: Any = run.options.saveat
    reached = Reached(integrated.ts, integrated.t_end, integrated.result)
    given = reached, (integrated.ys, integrated.y_end), saves_states(saveat), _firsts(run)
    return run.flat, run.formulation, run.accuracy, initial, *given


@scalarised
def _check_start(flat, state, t0, tangent_space) -> InitialCheck:
    system = system_of(flat, state.q.dtype)
    return check_initial_state(tangent_space.prepared(system.dtype), system, t0, state)


def problem_of(
    flat: Flat[Mechanism],
    formulation: AbstractFormulation,
    accuracy: Accuracy,
    initial: InitialCheck,
) -> Problem:
    """The initial value problem's right-hand side from a state that was checked."""
    dtype = initial.state.q.dtype
    start = initial.can_start, initial.t, initial.singular
    system = system_of(flat, dtype)
    return Problem(flat.tree, system, formulation.prepared(dtype, initial.rank), accuracy, *start)


@scalarised
def _integrate(run: Run, initial: InitialCheck) -> Integrated:
    dtype = initial.state.q.dtype
    formulation, t0, t1, options, control = cast((run.formulation, run.t0, run.t1, run.options, run.control), dtype)
    in_order, t0, t1, dt0, saveat = _in_order(t0, t1, options.dt0, options.saveat)
    problem = problem_of(run.flat, formulation, run.accuracy, initial)
    times = known_times(problem.mechanism) if control.is_adaptive else None
    problem = dataclasses.replace(
        problem, can_start=problem.can_start & in_order, times=None if times is None else times.astype(dtype)
    )
    inputs = run.flat, initial.state, t0, t1, dt0, saveat
    if not saves_states(saveat):
        saveat = eqx.tree_at(lambda s: s.subs, saveat, _wrapped_saves(saveat.subs))
    q, v, internal = initial.state.q, initial.state.v, initial.state.internal
    sides = start_sides(bound(problem.system, internal), t0, q, v) if control.is_adaptive else ()
    y0, event = problem.packed(q, v, sides, internal), _wrapped_event(options.event)
    solver = ProjectedSolver.around(options.solver, run.accuracy, run.adjoint, control, event)
    meter = diffrax.NoProgressMeter() if options.progress_meter is None else options.progress_meter
    integrator = Integrator(dt0, saveat, solver, control, run.adjoint, event, meter, options.max_steps)
    saved = saveat.subs.ts if run.has_discrete_adjoint else None
    solve = integrate if run.has_discrete_adjoint else solve_by_diffrax
    integrated, _ = solve(InitialValueProblem(problem, y0, t0, t1, saved), integrator, False)
    result = _at_stop(integrated.result, problem, integrated.t_end, integrated.y_end)
    if event is not None and event.root_finder is not None:
        gives_up = (result == RESULTS.nonlinear_max_steps_reached) | (result == RESULTS.nonlinear_divergence)
        result = RESULTS.where(gives_up, RESULTS.event_without_root, result)
    result = _result(result, initial, in_order, control.is_adaptive)
    integrated = integrated._replace(result=result)
    return _without_derivatives(integrated, event, inputs)


def _in_order(
    t0, t1, dt0, saveat
) -> tuple[Bool[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""] | None, diffrax.SaveAt]:
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


class _OnManifold(eqx.Module):
    """A user's function of (t, state, mechanism), for diffrax: the state is closed first."""

    function: Callable

    # diffrax passes `args` by name where it seeks the root of an event.
    def __call__(self, t: Float[Array, ""], y: Float[Array, " n"], args: Problem, **unused: Any) -> Any:
        state, holds = args.close(t, y)
        return self.function(t, infinite_where(jnp.logical_not(holds), state, y), args.mechanism)

    def unclosed(self, t: Float[Array, ""], y: Float[Array, " n"], args: Problem) -> Any:
        """The same of a state that is not closed first."""
        q, v = args.unpacked(y)
        return self.function(t, State(q, v, args.system.topology, args.internal(y)), args.mechanism)


def _wrapped_saves(subs):
    is_sub = lambda node: isinstance(node, diffrax.SubSaveAt)
    wrap = lambda sub: eqx.tree_at(lambda s: s.fn, sub, _OnManifold(_state_itself if sub.fn is SAVE_STATE else sub.fn))
    return jax.tree.map(wrap, subs, is_leaf=is_sub)


def _state_itself(t, state, mechanism):
    return state


def _wrapped_event(event):
    if event is None:
        return None
    return eqx.tree_at(lambda e: e.cond_fn, event, jax.tree.map(_OnManifold, event.cond_fn, is_leaf=callable))


def _at_stop(result, problem, t, y):
    """How a run ended, by the vector y of its end, where no motion led on from a stop or a contact."""
    system = problem.system
    stands = result == RESULTS.dt_min_reached
    result = RESULTS.where(problem.pressed_through(t, y) & stands, RESULTS.pressed_through, result)
    if not impacts_of(system):
        return result
    kept = jnp.asarray(problem.sides(y))
    ended = RESULTS.where(is_driven_in(system, kept), RESULTS.driven_into_stop, RESULTS.rests_on_stop)
    return RESULTS.where(has_ended(system, kept) & stands, ended, result)


def _result(result, initial: InitialCheck, in_order: Bool[Array, ""], is_adaptive: bool):
    """The first of what is wrong at the start, else how the integration ended."""
    if not is_adaptive:
        result = RESULTS.where(result == RESULTS.dt_min_reached, RESULTS.diverged, result)
    result = RESULTS.where(initial.unique, result, RESULTS.not_unique)
    result = RESULTS.where(initial.on_branch, result, RESULTS.no_branch)
    result = RESULTS.where(initial.closed, result, RESULTS.not_closed)
    result = RESULTS.where(initial.massive, result, RESULTS.massless)
    result = RESULTS.where(initial.finite, result, RESULTS.not_finite)
    result = RESULTS.where(initial.assembled, result, RESULTS.not_assembled)
    return RESULTS.where(in_order, result, RESULTS.times_out_of_order)


def _without_derivatives(integrated: Integrated, event, inputs) -> Integrated:
    """The same without derivatives where the run failed, or ended with a step that an event ended."""
    failed = jnp.logical_not(ended_well(integrated.result))
    at_end = failed
    if event is not None and event.root_finder is None:
        at_end = failed | (integrated.result == RESULTS.event_occurred)
    of_times = lambda ts: failed | (at_end & (ts >= integrated.t_end))
    of_values = lambda ts, ys: jax.tree.map(lambda y: of_times(ts).reshape(-1, *(1,) * (y.ndim - 1)), ys)
    values, fixed = eqx.partition(
        (integrated.ts, integrated.ys, integrated.t_end, integrated.y_end), eqx.is_inexact_array
    )
    undefined = (
        jax.tree.map(of_times, values[0]),
        jax.tree.map(of_values, values[0], values[1]),
        at_end,
        at_end,
    )
    values = undefined_where(undefined, values, eqx.filter(inputs, eqx.is_inexact_array))
    ts, ys, t_end, y_end = eqx.combine(values, fixed)
    return integrated._replace(ts=ts, ys=ys, t_end=t_end, y_end=y_end)


def _firsts(run):
    """For each saved time the first row of that time, which may come more than once; None where times are traced."""
    ts = concrete(run.options.saveat.subs.ts) if run.saves_times else None
    return None if ts is None else np.searchsorted(ts, ts)


class Reached(NamedTuple):
    """Times that a run saved and ended at, and how it ended."""

    ts: Any
    t_end: Float[Array, ""]
    result: Any


@scalarised
def _closed(
    flat, formulation, accuracy, initial, reached, values, saves, firsts
) -> tuple[Reached, State, State | None]:
    """What was reached, the state at the end, and those that are saved, on the loops; infinite where none was saved.

    The run fails where a state does not close nearby: what comes later is not given out.
    """
    problem = problem_of(flat, formulation, accuracy, initial)
    ts, t_end, _ = reached
    ys, y_end = values
    if not saves:
        end, holds = problem.close(t_end, y_end)
        return *_checked(reached, end, jnp.asarray(holds), t_end), None
    # The end comes first, so that it is in the same part as times that were saved.
    saved = jnp.isfinite(ts)
    once = saved if firsts is None else saved & (firsts == jnp.arange(len(ts)))
    rows = [jnp.concatenate(parts) for parts in ((jnp.ones(1, bool), once), (t_end[None], ts), (y_end[None], ys))]
    closed, holds = map_saved_times(problem.close, *rows)
    each = lambda rows: rows[1:] if firsts is None else rows[1:][firsts]
    holds_later = each(holds) | jnp.logical_not(saved)
    fails_at = jnp.min(jnp.where(holds_later, t_end, ts), initial=jnp.inf)
    reached, end = _checked(
        reached, jax.tree.map(lambda rows: rows[0], closed), holds[0] & jnp.all(holds_later), fails_at
    )
    missing = jnp.logical_not(saved & (jnp.cumsum(~holds_later) == 0))
    ts, saved = infinite_where(missing, (ts, jax.tree.map(each, closed)), (ts, values))
    return reached._replace(ts=ts), end, saved


def _checked(reached, end, holds, fails_at):
    """What was reached, and the state at its end: where a state does not hold, a run that ended well fails there."""
    fails = jnp.logical_not(holds) & ended_well(reached.result)
    result = RESULTS.where(fails, RESULTS.off_loops, reached.result)
    t_end = jnp.where(fails, fails_at, reached.t_end)
    return reached._replace(t_end=t_end, result=result), infinite_where(fails, end, end)
