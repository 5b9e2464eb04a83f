"""Derivatives of a run by its accepted steps, once forwards for tangents, once backwards for cotangents.

What diffrax integrates with steps chosen as it goes, is here differentiated as it was computed, with those steps given.
Each equation of motion compiles once for its tangent and once for its cotangent, where differentiating the loop over
steps itself needs seven copies. A step that ends at a switch, or at a known time of a law, ends there as parameters
change too, and those after it move along, so that each begins as far from the kink as it did.
"""

import functools
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from linkax.simulation.integrate.integrator import InitialValueProblem, Integrator, recorded_again
from linkax.simulation.integrate.problem import Problem
from linkax.simulation.integrate.projected_solver import ProjectedSolver
from linkax.simulation.integrate.step_record import StepRecord
from linkax.xla.arrays import Array
from linkax.xla.derivatives import materialise


class Trajectory(NamedTuple):
    """Tangents of the states of a motion: at saved times, at the end, and where asked for, of its `StepRecord`.

    - `ys`, `ts`, `start_ys`, `start_ts`: those of ends of steps, and of where groups of tries begin. Switches and known
      times of laws move some of these times.
    """

    saved: Float[Array, "k n"] | None
    end: Float[Array, " n"]
    ys: Float[Array, "ends n"] | None = None
    ts: Float[Array, " ends"] | None = None
    start_ys: Float[Array, "groups n"] | None = None
    start_ts: Float[Array, " groups"] | None = None

    def of_record(self, record: StepRecord) -> StepRecord:
        """The tangents of a record."""
        nothing = jax.tree.map(lambda _: None, record)
        starts = nothing.starts._replace(t0=self.start_ts, y=self.start_ys)
        return nothing._replace(ts=self.ts, ys=self.ys, starts=starts)


class Tableau(NamedTuple):
    """The coefficients of an explicit Runge-Kutta method: a, (s, s), b and c, (s,)."""

    weights: np.ndarray
    result: np.ndarray
    nodes: np.ndarray

    @staticmethod
    def of(solver: Any) -> "Tableau":
        tableau = solver.tableau
        weights = np.zeros((tableau.num_stages, tableau.num_stages))
        for row, entries in enumerate(tableau.a_lower):
            weights[row + 1, : row + 1] = entries
        return Tableau(weights, tableau.b_sol, np.concatenate([[0.0], tableau.c]))


def _stages(solver, problem, t0, t1, y0):
    """Increments kᵢ = Δt f(t0 + cᵢ Δt, y0 + Σ aᵢⱼ kⱼ) at the stages of a step, (s, n)."""
    table, duration = Tableau.of(solver.solver), t1 - t0
    weights, nodes = jnp.asarray(table.weights, y0.dtype), jnp.asarray(table.nodes, y0.dtype)

    def stage(i, k):
        t = problem.stage_time(t0 + nodes[i] * duration, t1)
        return k.at[i].set(duration * problem.derivative(t, y0 + weights[i] @ k))

    return lax.fori_loop(0, len(nodes), stage, jnp.zeros((len(nodes), len(y0)), y0.dtype))


def _uncorrected(solver, problem, t0, t1, y0):
    """One explicit Runge-Kutta step, y1 = y0 + Σ bᵢ kᵢ, as the dictionary that interpolates in it."""
    k = _stages(solver, problem, t0, t1, y0)
    return dict(y0=y0, y1=y0 + jnp.asarray(Tableau.of(solver.solver).result, y0.dtype) @ k, k=k)


def _step(solver: ProjectedSolver, problem: Problem, t0, t1, y0, sides):
    """One step and the correction after it: (when and where the next begins, what interpolates in the step)."""
    dense = _uncorrected(solver, problem, t0, t1, y0)
    return solver.corrected(problem, t1, dense["y1"], sides), dense


def _step_vjp(solver: ProjectedSolver, of_problem, problem, t0, t1, dense, sides, after_bar, dense_bar):
    """VJP of one step: cotangents of ((t, y) after it, dense output) ↦ cotangents of (problem, t0, t1, y0).

    `of_problem`: rebuilds the `Problem` from its differentiated leaves. `sides`: see `_step`.
    """
    table, duration = Tableau.of(solver.solver), t1 - t0
    y0, k = dense["y0"], dense["k"]
    weights, nodes = jnp.asarray(table.weights, y0.dtype), jnp.asarray(table.nodes, y0.dtype)
    result = jnp.asarray(table.result, y0.dtype)
    corrected = lambda problem, t, y: solver.corrected(of_problem(problem), t, y, sides)
    rates = lambda problem, t, y: of_problem(problem).derivative(t, y)
    problem_bar, t1_bar, y_bar = jax.vjp(corrected, problem, t1, dense["y1"])[1](after_bar)
    y_bar = y_bar + dense_bar["y1"]
    k_bar = dense_bar["k"] + result[:, None] * y_bar

    def stage(back, carry):
        problem_bar, t0_bar, t1_bar, y_bar, k_bar = carry
        i = len(nodes) - 1 - back
        at = problem, of_problem(problem).stage_time(t0 + nodes[i] * duration, t1), y0 + weights[i] @ k
        more, t_bar, stage_bar = jax.vjp(rates, *at)[1](duration * k_bar[i])
        stretch = k[i] @ k_bar[i] / duration
        return (
            jax.tree.map(jnp.add, problem_bar, more),
            t0_bar + (1.0 - nodes[i]) * t_bar - stretch,
            t1_bar + nodes[i] * t_bar + stretch,
            y_bar + stage_bar,
            k_bar + weights[i][:, None] * stage_bar,
        )

    begin = problem_bar, jnp.zeros_like(t0), t1_bar, y_bar + dense_bar["y0"], k_bar
    return lax.fori_loop(0, len(nodes), stage, begin)[:-1]


def _within(solver: ProjectedSolver, t0, t1, dense, t):
    """Interpolate the motion at a time within a step."""
    return solver.interpolation_cls(t0=t0, t1=t1, **dense).evaluate(t)


class Group(NamedTuple):
    """The accepted steps among a group of tries: their ends, (rows + 1, ...), the start first, and how many."""

    ts: Float[Array, " ends"]
    ys: Float[Array, "ends n"]
    count: Int[Array, ""]


@eqx.filter_custom_jvp
def _group(ivp: InitialValueProblem, integrator: Integrator, record: StepRecord, number: Int[Array, ""]) -> Group:
    """The steps of a group of tries: those of the last are on record, others are made again."""
    start = record.start(number)
    is_last = number == record.last
    # The last group ends where it begins: nothing is integrated.
    again = recorded_again(ivp._replace(t1=jnp.where(is_last, start.t0, ivp.t1)), integrator, start, record.rows)
    either = lambda on_record, other: jnp.where(is_last, on_record, other)
    return Group(either(record.ts, again.ts), either(record.ys, again.ys), either(record.count, again.count))


@_group.def_jvp
def _group_jvp(primals, tangents):
    (ivp, integrator, record, number), (ivp_dot, _, record_dot, _) = primals, tangents
    group = _group(ivp, integrator, record, number)
    starts, starts_dot = record.starts, record_dot.starts
    t_dot, y_dot = materialise(starts.t0, starts_dot.t0)[number], materialise(starts.y, starts_dot.y)[number]
    along = _Along(integrator.solver, ivp, ivp_dot, every=True, saves=False)
    is_last = number == record.last
    motion: Any = along.group(group, number == 0, is_last, along.begin(t_dot, y_dot, len(group.ts)))
    of_rows = [(record.ts, record_dot.ts, motion.ts), (record.ys, record_dot.ys, motion.ys)]
    ts_dot, ys_dot = (jnp.where(is_last, materialise(of, dot), again) for of, dot, again in of_rows)
    return group, Group(ts_dot, ys_dot, cast(Any, None))


class _Motion(NamedTuple):
    """Tangents on the way: which saved time is next, of the time and the state where the next step begins, of states at
    saved times, of the ends of the steps of the group.
    """

    j: Int[Array, ""]
    t: Float[Array, ""]
    y: Float[Array, " n"]
    saved: Float[Array, "k n"] | None
    ts: Float[Array, " ends"] | None
    ys: Float[Array, "ends n"] | None


class _Along(NamedTuple):
    """Tangents of an initial value problem, taken along its steps."""

    solver: ProjectedSolver
    ivp: InitialValueProblem
    tangents: InitialValueProblem
    every: bool
    saves: bool

    def begin(self, t_dot, y_dot, ends: int) -> _Motion:
        """Tangents where the first step begins, of a group of so many ends."""
        zeros = lambda *shape: jnp.zeros(shape, y_dot.dtype)
        rows = (zeros(ends), zeros(ends, len(y_dot))) if self.every else (None, None)
        saved = zeros(len(cast(Any, self.ivp.saved)), len(y_dot)) if self.saves else None
        return _Motion(jnp.zeros((), int), t_dot, y_dot, saved, *rows)

    def group(self, group: Group, is_first, is_last, motion: _Motion) -> _Motion:
        """Tangents over a group of steps."""
        ivp, tangents = self.ivp, self.tangents
        switching = len(ivp.problem.sides(ivp.y0)) > 0
        known_dot = None if tangents.problem is None else tangents.problem.times
        moving = switching or known_dot is not None
        saved = cast(Any, ivp.saved)
        saved_dot = cast(Any, materialise(saved, tangents.saved) if self.saves else None)

        def step(sides, problem, t0, t1, y):
            return _step(self.solver, problem, t0, t1, y, sides)

        def one(carry):
            k, y, motion = carry
            ends = group.ts[k], group.ts[k + 1]
            end_dot = motion.t if moving else 0.0
            if known_dot is not None:
                is_known, index = _known(ivp.problem, ends[1])
                end_dot = jnp.where(is_known, known_dot[index], end_dot)
            end_dot = jnp.where(is_last & (k == group.count - 1), materialise(ivp.t1, tangents.t1), end_dot)
            moved = tangents.problem, motion.t, end_dot, motion.y
            sides = ivp.problem.sides(group.ys[k + 1])
            at = ivp.problem, *ends, y
            ((_, y), dense), ((later, y_dot), dense_dot) = eqx.filter_jvp(functools.partial(step, sides), at, moved)

            def save(carry):
                j, found = carry
                within = functools.partial(_within, self.solver)
                _, value = jax.jvp(within, (*ends, dense, saved[j]), (motion.t, end_dot, dense_dot, saved_dot[j]))
                return j + 1, found.at[j].set(value)

            j, found = motion.j, motion.saved
            if self.saves:
                j, found = lax.while_loop(lambda carry: _reached(saved, carry[0], ends[1]), save, (j, found))
            t_dot = later if moving else jnp.zeros_like(motion.t)
            each = lambda rows, row: rows.at[k + 1].set(row) if self.every else None
            return k + 1, y, _Motion(j, t_dot, y_dot, found, each(motion.ts, t_dot), each(motion.ys, y_dot))

        if self.every:
            of_start = lambda rows, row: jnp.zeros_like(rows).at[0].set(row)
            motion = motion._replace(ts=of_start(motion.ts, motion.t), ys=of_start(motion.ys, motion.y))
        begin = jnp.zeros((), int), group.ys[0], motion
        return lax.while_loop(lambda carry: carry[0] < group.count, one, begin)[-1]


def tangents_over_steps(
    integrator: Integrator, every: bool, ivp: InitialValueProblem, record: StepRecord, tangents: InitialValueProblem
) -> Trajectory:
    """JVP of a run, step by step from the first: tangents of its states; None among `tangents` is zero."""
    along = _Along(integrator.solver, ivp, tangents, every, saves=ivp.saved is not None)

    def one(carry):
        number, motion, starts = carry
        group = _group(ivp, integrator, record, number)
        starts = [rows.at[number].set(row) for rows, row in zip(starts, (motion.y, motion.t), strict=False)]
        return number + 1, along.group(group, number == 0, number == record.last, motion), starts

    first = along.begin(materialise(ivp.t0, tangents.t0), materialise(ivp.y0, tangents.y0), len(record.ts))
    starts = [jnp.zeros_like(record.starts.y), jnp.zeros_like(record.starts.t0)] if every else []
    begin: Any = jnp.zeros((), int), first, starts
    _, motion, starts = lax.while_loop(lambda carry: carry[0] <= record.last, one, begin)
    if not every:
        return Trajectory(motion.saved, motion.y)
    ts = motion.ts.at[record.count].set(materialise(ivp.t1, tangents.t1))
    return Trajectory(motion.saved, motion.y, motion.ys, ts, *starts)


def _known(problem, t):
    """Whether a step ends at a known time, and which."""
    ends = problem.times == t
    return jnp.any(ends), jnp.argmax(ends)


def _reached(saved, j, t):
    """Whether there is a j-th saved time, up to t."""
    return (j < len(saved)) & (saved[jnp.minimum(j, len(saved) - 1)] <= t)


def cotangents_over_steps(
    integrator: Integrator,
    ivp: InitialValueProblem,
    record: StepRecord,
    wanted: InitialValueProblem,
    cotangent: Trajectory,
) -> InitialValueProblem:
    """VJP of a run, step by step from the last: cotangents of the leaves of `ivp` that are `wanted`."""
    problem, fixed = eqx.partition(ivp.problem, wanted.problem)
    solver, switching = integrator.solver, len(ivp.problem.sides(ivp.y0)) > 0
    moving = switching or problem.times is not None
    saved = cast(Any, ivp.saved)
    saved_cotangent: Any = cotangent.saved

    of_problem = lambda problem: eqx.combine(problem, fixed)

    def over_group(carry):
        number, *bars = carry
        group = _group(ivp, integrator, record, number)
        one = functools.partial(over_step, group, number == 0, number == record.last)
        _, *bars = lax.while_loop(lambda carry: carry[0] >= 0, one, (group.count - 1, *bars))
        return number - 1, *bars

    def over_step(group, is_first, is_last, carry):
        k, j, y_bar, moves_bar, problem_bar, t0_bar, t1_bar, saved_bar = carry
        begins, finishes = is_first & (k == 0), is_last & (k == group.count - 1)
        ends = group.ts[k], group.ts[k + 1]
        dense = _uncorrected(solver, ivp.problem, *ends, group.ys[k])
        zero = jnp.zeros_like(ends[0])
        of_step = j, zero, zero, jax.tree.map(jnp.zeros_like, dense), saved_bar
        if saved is not None:
            of_step = _cotangents_of_saves(solver, saved, saved_cotangent, ends, dense, begins, of_step)
        j, begin_bar, end_bar, dense_bar, saved_bar = of_step
        sides = ivp.problem.sides(group.ys[k + 1])
        more, begin_more, end_more, y_bar = _step_vjp(
            solver, of_problem, problem, *ends, dense, sides, (moves_bar if moving else zero, y_bar), dense_bar
        )
        problem_bar = jax.tree.map(jnp.add, problem_bar, more)
        begin_bar, end_bar = begin_bar + begin_more, end_bar + end_more
        t0_bar = jnp.where(begins, begin_bar, t0_bar)
        t1_bar = jnp.where(finishes, end_bar, t1_bar)
        end_bar = jnp.where(finishes, 0.0, end_bar)
        if problem.times is not None:
            is_known, index = _known(ivp.problem, ends[1])
            of_times = problem_bar.times.at[index].add(jnp.where(is_known, end_bar, 0.0))
            problem_bar = eqx.tree_at(lambda problem: problem.times, problem_bar, of_times)
            end_bar = jnp.where(is_known, 0.0, end_bar)
        moves_bar = begin_bar + end_bar if moving else None
        return k - 1, j, y_bar, moves_bar, problem_bar, t0_bar, t1_bar, saved_bar

    zero = jnp.zeros((), record.ts.dtype)
    finish = record.ts[record.count]
    count = 0 if saved is None else jnp.sum(saved <= finish)
    saved_bar = None if saved is None else jnp.zeros_like(saved)
    begin = (
        record.last,
        count - 1,
        cotangent.end,
        zero if moving else None,
        jax.tree.map(jnp.zeros_like, problem),
        zero,
        zero,
        saved_bar,
    )
    *_, y_bar, _, problem_bar, t0_bar, t1_bar, saved_bar = lax.while_loop(
        lambda carry: carry[0] >= 0, over_group, begin
    )
    return eqx.filter(InitialValueProblem(problem_bar, y_bar, t0_bar, t1_bar, saved_bar), wanted)


def _cotangents_of_saves(solver, saved, saved_cotangent, ends, dense, is_first, begin):
    """VJP of all that is saved in one step, from the last: add cotangents to (j, t0, t1, dense output, saved times)."""

    def save(carry):
        j, *bars, saved_bar = carry
        within = functools.partial(_within, solver)
        *more, t_bar = jax.vjp(within, *ends, dense, saved[j])[1](saved_cotangent[j])
        bars = jax.tree.map(jnp.add, tuple(bars), tuple(more))
        return j - 1, *bars, saved_bar.at[j].set(t_bar)

    def inside(carry):
        j = carry[0]
        return (j >= 0) & ((saved[jnp.maximum(j, 0)] > ends[0]) | is_first)

    return lax.while_loop(inside, save, begin)
