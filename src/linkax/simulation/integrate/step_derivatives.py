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

from linkax.simulation.integrate.problem import Problem
from linkax.simulation.integrate.projected_solver import ProjectedSolver
from linkax.xla.arrays import Array
from linkax.xla.derivatives import materialise


class InitialValueProblem(NamedTuple):
    """What a motion depends on: a problem, the state y0 at t0, the last time t1, and the saved times."""

    problem: Problem
    y0: Float[Array, " n"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    saved: Float[Array, " k"] | None


class Steps(NamedTuple):
    """The accepted steps of an integration: their ends, (s + 1, ...), the start first, and how many there are."""

    ts: Float[Array, " ends"]
    ys: Float[Array, "ends n"]
    count: Int[Array, ""] | None


class Trajectory(NamedTuple):
    """The states of a motion that have derivatives: at saved times, at the end, at all steps where asked for.

    `times`: those of the steps, of which switches and known times of laws move some.
    """

    saved: Float[Array, "k n"] | None
    end: Float[Array, " n"]
    steps: Float[Array, "ends n"] | None = None
    times: Float[Array, " ends"] | None = None


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


def tangents_over_steps(
    solver: ProjectedSolver, every: bool, ivp: InitialValueProblem, steps: Steps, tangents: InitialValueProblem
) -> Trajectory:
    """JVP of a run, step by step from the first: tangents of its states; None among `tangents` is zero."""
    y0, count = ivp.y0, cast(Any, steps.count)
    last, switching = count - 1, len(ivp.problem.sides(ivp.y0)) > 0
    known_dot = None if tangents.problem is None else tangents.problem.times
    moving = switching or known_dot is not None
    saves, saved = ivp.saved is not None, cast(Any, ivp.saved)
    saved_dot = cast(Any, materialise(saved, tangents.saved) if saves else None)

    def step(sides, problem, t0, t1, y):
        return _step(solver, problem, t0, t1, y, sides)

    def one(carry):
        k, j, y, moves, motion = carry
        ends = steps.ts[k], steps.ts[k + 1]
        begin_dot = jnp.where(k == 0, materialise(ivp.t0, tangents.t0), moves if moving else 0.0)
        end_dot = moves if moving else 0.0
        if known_dot is not None:
            is_known, index = _known(ivp.problem, ends[1])
            end_dot = jnp.where(is_known, known_dot[index], end_dot)
        end_dot = jnp.where(k == last, materialise(ivp.t1, tangents.t1), end_dot)
        moved = tangents.problem, begin_dot, end_dot, motion.end
        sides = ivp.problem.sides(steps.ys[k + 1])
        at = ivp.problem, *ends, y
        ((_, y), dense), ((later, y_dot), dense_dot) = eqx.filter_jvp(functools.partial(step, sides), at, moved)

        def save(carry):
            j, found = carry
            within = functools.partial(_within, solver)
            _, value = jax.jvp(within, (*ends, dense, saved[j]), (begin_dot, end_dot, dense_dot, saved_dot[j]))
            return j + 1, found.at[j].set(value)

        found = motion.saved
        if saves:
            j, found = lax.while_loop(lambda carry: _reached(saved, carry[0], ends[1]), save, (j, found))
        each = lambda rows, row: rows.at[k + 1].set(row) if every else None
        times = each(motion.times, later) if moving else motion.times
        return k + 1, j, y, later if moving else None, Trajectory(found, y_dot, each(motion.steps, y_dot), times)

    motion = Trajectory(
        saved=jnp.zeros((len(saved), len(y0)), y0.dtype) if saves else None,
        end=materialise(y0, tangents.y0),
        steps=jnp.zeros_like(steps.ys).at[0].set(materialise(y0, tangents.y0)) if every else None,
        times=jnp.zeros_like(steps.ts).at[0].set(materialise(ivp.t0, tangents.t0)) if every else None,
    )
    begin = jnp.zeros((), int), jnp.zeros((), int), y0, jnp.zeros_like(ivp.t0) if moving else None, motion
    return lax.while_loop(lambda carry: carry[0] < count, one, begin)[-1]


def _known(problem, t):
    """Whether a step ends at a known time, and which."""
    ends = problem.times == t
    return jnp.any(ends), jnp.argmax(ends)


def _reached(saved, j, t):
    """Whether there is a j-th saved time, up to t."""
    return (j < len(saved)) & (saved[jnp.minimum(j, len(saved) - 1)] <= t)


def cotangents_over_steps(
    solver: ProjectedSolver, ivp: InitialValueProblem, steps: Steps, wanted: InitialValueProblem, cotangent: Trajectory
) -> InitialValueProblem:
    """VJP of a run, step by step from the last: cotangents of the leaves of `ivp` that are `wanted`."""
    problem, fixed = eqx.partition(ivp.problem, wanted.problem)
    last, switching = cast(Any, steps.count) - 1, len(ivp.problem.sides(ivp.y0)) > 0
    moving = switching or problem.times is not None
    saved = cast(Any, ivp.saved)
    saved_cotangent: Any = cotangent.saved

    of_problem = lambda problem: eqx.combine(problem, fixed)

    def one(carry):
        k, j, y_bar, moves_bar, problem_bar, t0_bar, t1_bar, saved_bar = carry
        ends = steps.ts[k], steps.ts[k + 1]
        dense = _uncorrected(solver, ivp.problem, *ends, steps.ys[k])
        zero = jnp.zeros_like(ends[0])
        of_step = j, zero, zero, jax.tree.map(jnp.zeros_like, dense), saved_bar
        if saved is not None:
            of_step = _cotangents_of_saves(solver, saved, saved_cotangent, ends, dense, k == 0, of_step)
        j, begin_bar, end_bar, dense_bar, saved_bar = of_step
        sides = ivp.problem.sides(steps.ys[k + 1])
        more, begin_more, end_more, y_bar = _step_vjp(
            solver, of_problem, problem, *ends, dense, sides, (moves_bar if moving else zero, y_bar), dense_bar
        )
        problem_bar = jax.tree.map(jnp.add, problem_bar, more)
        begin_bar, end_bar = begin_bar + begin_more, end_bar + end_more
        t0_bar = jnp.where(k == 0, begin_bar, t0_bar)
        t1_bar = jnp.where(k == last, end_bar, t1_bar)
        end_bar = jnp.where(k == last, 0.0, end_bar)
        if problem.times is not None:
            is_known, index = _known(ivp.problem, ends[1])
            of_times = problem_bar.times.at[index].add(jnp.where(is_known, end_bar, 0.0))
            problem_bar = eqx.tree_at(lambda problem: problem.times, problem_bar, of_times)
            end_bar = jnp.where(is_known, 0.0, end_bar)
        moves_bar = begin_bar + end_bar if moving else None
        return k - 1, j, y_bar, moves_bar, problem_bar, t0_bar, t1_bar, saved_bar

    zero = jnp.zeros((), steps.ts.dtype)
    finish = steps.ts[steps.count]
    count = 0 if saved is None else jnp.sum(saved <= finish)
    saved_bar = None if saved is None else jnp.zeros_like(saved)
    begin = (
        last,
        count - 1,
        cotangent.end,
        zero if moving else None,
        jax.tree.map(jnp.zeros_like, problem),
        zero,
        zero,
        saved_bar,
    )
    *_, y_bar, _, problem_bar, t0_bar, t1_bar, saved_bar = lax.while_loop(lambda carry: carry[0] >= 0, one, begin)
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
