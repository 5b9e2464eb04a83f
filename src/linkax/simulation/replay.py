"""Derivatives of an integration, by going over its accepted steps again.

What diffrax integrates with steps chosen as it goes, is here differentiated as it was computed, with those steps
given: once forwards for tangents, once backwards for cotangents. One rule serves both modes. It compiles each
equation of motion once for its tangent and once for its cotangent, where differentiating the loop over steps itself
needs seven copies.
"""

import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from linkax.simulation.integration import Problem, Projected
from linkax.tracing import materialised, with_products_as_sums

NO_REVERSE = (
    "Reverse-mode derivatives of reverse-mode derivatives of a simulation do not exist. Take second derivatives "
    "forwards: jax.jacfwd(jax.jacfwd(loss)), or jax.jvp(jax.grad(loss), ...) for a Hessian times a vector."
)


class Course(NamedTuple):
    """What the motion depends on: a problem, the state that it starts from, first, last and saved times."""

    problem: Problem
    y0: Float[Array, " n"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    saved: Float[Array, " k"] | None


class Steps(NamedTuple):
    """The accepted steps of an integration: where each begins and ends, (s + 1, ...), and how many there are."""

    ts: Float[Array, " s+1"]
    ys: Float[Array, "s+1 n"]
    count: Int[Array, ""]


class Motion(NamedTuple):
    """What of an integration has derivatives: values at saved times, at the end, and at all steps where asked for."""

    saved: Float[Array, "k n"] | None
    end: Float[Array, " n"]
    steps: Float[Array, "s+1 n"] | None = None


def is_replayable(solver, saveat, event, max_steps) -> bool:
    """Whether derivatives can be had from here: explicit Runge-Kutta steps, saved states and no event."""
    plain = isinstance(saveat.subs, diffrax.SubSaveAt) and not saveat.subs.steps and not saveat.dense
    explicit = isinstance(solver, diffrax.AbstractERK) and isinstance(solver.tableau, diffrax.ButcherTableau)
    return plain and explicit and event is None and max_steps is not None


def tangents(solver: Projected, course: Course, steps: Steps, changes: Course, every=False) -> Motion:
    """The change of the motion with changes of what it depends on; None for what does not change.

    `every`: at all steps too. Linear in the changes, and differentiable: once backwards, or forwards any number of
    times.
    """
    # In one array, which is one of a batch where anything is: JAX could not transpose a batch with changes in common.
    flat, restored = ravel_pytree(changes)
    return eqxi.filter_primitive_bind(_tangents_p, solver, every, course, steps, restored, flat + (steps.count < 0))


class _Tableau(NamedTuple):
    """The coefficients of an explicit Runge-Kutta method: a, (s, s), b and c, (s,)."""

    weights: np.ndarray
    result: np.ndarray
    nodes: np.ndarray

    @staticmethod
    def of(solver) -> "_Tableau":
        tableau = solver.tableau
        weights = np.zeros((tableau.num_stages, tableau.num_stages))
        for row, entries in enumerate(tableau.a_lower):
            weights[row + 1, : row + 1] = entries
        return _Tableau(weights, tableau.b_sol, np.concatenate([[0.0], tableau.c]))


def _stages(solver, problem, t0, t1, y0):
    """Rates at the stages of a step, times its duration, (s, n)."""
    table, duration = _Tableau.of(solver.solver), t1 - t0
    weights, nodes = jnp.asarray(table.weights, y0.dtype), jnp.asarray(table.nodes, y0.dtype)

    def stage(i, k):
        return k.at[i].set(duration * problem.derivative(t0 + nodes[i] * duration, y0 + weights[i] @ k))

    return lax.fori_loop(0, len(nodes), stage, jnp.zeros((len(nodes), len(y0)), y0.dtype))


def _uncorrected(solver, problem, t0, t1, y0):
    """One step of an explicit Runge-Kutta method, as what interpolates in it."""
    k = _stages(solver, problem, t0, t1, y0)
    return dict(y0=y0, y1=y0 + jnp.asarray(_Tableau.of(solver.solver).result, y0.dtype) @ k, k=k)


def _step(solver: Projected, problem: Problem, t0, t1, y0, sides):
    """The state that a step and the correction after it leave, on the sides after it, and what interpolates in it."""
    dense = _uncorrected(solver, problem, t0, t1, y0)
    return solver.corrected(problem, t1, dense["y1"], sides), dense


def _pulled(function, primals, cotangent):
    """Cotangents of a function's arguments, its evaluation being a branch of its own."""
    pull = lambda cotangent: jax.vjp(function, *primals)[1](cotangent)
    otherwise = jax.tree.map(lambda array: jnp.full_like(array, jnp.nan), primals)
    return lax.cond(jnp.all(jnp.isfinite(cotangent)), pull, lambda cotangent: otherwise, cotangent)


def _step_backwards(solver: Projected, of_problem, problem, t0, t1, dense, sides, y1_bar, dense_bar):
    """Cotangents of a problem, both times and the state before a step, of the state after it and what interpolates.

    `of_problem`: what a problem is of that of it which is differentiated. `sides`: see `_step`.
    """
    table, duration = _Tableau.of(solver.solver), t1 - t0
    y0, k = dense["y0"], dense["k"]
    weights, nodes = jnp.asarray(table.weights, y0.dtype), jnp.asarray(table.nodes, y0.dtype)
    result = jnp.asarray(table.result, y0.dtype)
    corrected = lambda problem, t, y: solver.corrected(of_problem(problem), t, y, sides)
    rates = lambda problem, t, y: of_problem(problem).derivative(t, y)
    problem_bar, t1_bar, y_bar = _pulled(corrected, (problem, t1, dense["y1"]), y1_bar)
    y_bar = y_bar + dense_bar["y1"]
    k_bar = dense_bar["k"] + result[:, None] * y_bar

    def stage(back, carry):
        problem_bar, t0_bar, t1_bar, y_bar, k_bar = carry
        i = len(nodes) - 1 - back
        at = problem, t0 + nodes[i] * duration, y0 + weights[i] @ k
        more, t_bar, stage_bar = _pulled(rates, at, duration * k_bar[i])
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


def _within(solver: Projected, t0, t1, dense, t):
    """The motion at a time within a step."""
    return solver.interpolation_cls(t0=t0, t1=t1, **dense).evaluate(t)


def _forwards(solver, every, course, steps, restored, flat) -> Motion:
    """Tangents, step by step."""
    changes = restored(flat)
    saved, y0, last = course.saved, course.y0, steps.count - 1
    saved_dot = None if saved is None else materialised(saved, changes.saved)

    def step(sides, problem, t0, t1, y):
        return _step(solver, problem, t0, t1, y, sides)

    def one(carry):
        k, j, y, motion = carry
        ends = steps.ts[k], steps.ts[k + 1]
        begin_dot = jnp.where(k == 0, materialised(course.t0, changes.t0), 0.0)
        end_dot = jnp.where(k == last, materialised(course.t1, changes.t1), 0.0)
        moved = changes.problem, begin_dot, end_dot, motion.end
        sides = course.problem.sides(steps.ys[k + 1])
        (y, dense), (y_dot, dense_dot) = eqx.filter_jvp(
            functools.partial(step, sides), (course.problem, *ends, y), moved
        )

        def save(carry):
            j, found = carry
            within = functools.partial(_within, solver)
            _, value = jax.jvp(within, (*ends, dense, saved[j]), (begin_dot, end_dot, dense_dot, saved_dot[j]))
            return j + 1, found.at[j].set(value)

        found = motion.saved
        if saved is not None:
            j, found = lax.while_loop(lambda carry: _reached(saved, carry[0], ends[1]), save, (j, found))
        return k + 1, j, y, Motion(found, y_dot, motion.steps.at[k + 1].set(y_dot) if every else None)

    motion = Motion(
        saved=None if saved is None else jnp.zeros((len(saved), len(y0)), y0.dtype),
        end=materialised(y0, changes.y0),
        steps=jnp.zeros_like(steps.ys).at[0].set(materialised(y0, changes.y0)) if every else None,
    )
    begin = jnp.zeros((), int), jnp.zeros((), int), y0, motion
    return lax.while_loop(lambda carry: carry[0] < steps.count, with_products_as_sums(one), begin)[-1]


def _reached(saved, j, t):
    """Whether there is a j-th saved time, up to t."""
    return (j < len(saved)) & (saved[jnp.minimum(j, len(saved) - 1)] <= t)


def _backwards(solver, course, steps, wanted, cotangent: Motion) -> Course:
    """Cotangents of the leaves of a course that are `wanted`, step by step from the last."""
    problem, fixed = eqx.partition(course.problem, wanted.problem)
    saved, last = course.saved, steps.count - 1

    of_problem = lambda problem: eqx.combine(problem, fixed)

    def one(carry):
        k, j, y_bar, problem_bar, t0_bar, t1_bar, saved_bar = carry
        ends = steps.ts[k], steps.ts[k + 1]
        dense = _uncorrected(solver, course.problem, *ends, steps.ys[k])
        begin_bar = end_bar = jnp.zeros_like(ends[0])
        dense_bar = jax.tree.map(jnp.zeros_like, dense)
        if saved is not None:

            def save(carry):
                j, *bars, saved_bar = carry
                within = functools.partial(_within, solver)
                *more, t_bar = jax.vjp(within, *ends, dense, saved[j])[1](cotangent.saved[j])
                bars = jax.tree.map(jnp.add, tuple(bars), tuple(more))
                return j - 1, *bars, saved_bar.at[j].set(t_bar)

            def inside(carry):
                j = carry[0]
                return (j >= 0) & ((saved[jnp.maximum(j, 0)] > ends[0]) | (k == 0))

            begin = j, begin_bar, end_bar, dense_bar, saved_bar
            j, begin_bar, end_bar, dense_bar, saved_bar = lax.while_loop(inside, save, begin)
        sides = course.problem.sides(steps.ys[k + 1])
        more, begin_more, end_more, y_bar = _step_backwards(
            solver, of_problem, problem, *ends, dense, sides, y_bar, dense_bar
        )
        problem_bar = jax.tree.map(jnp.add, problem_bar, more)
        t0_bar = jnp.where(k == 0, begin_bar + begin_more, t0_bar)
        t1_bar = jnp.where(k == last, end_bar + end_more, t1_bar)
        return k - 1, j, y_bar, problem_bar, t0_bar, t1_bar, saved_bar

    zero = jnp.zeros((), steps.ts.dtype)
    finish = steps.ts[steps.count]
    count = 0 if saved is None else jnp.sum(saved <= finish)
    saved_bar = None if saved is None else jnp.zeros_like(saved)
    begin = last, count - 1, cotangent.end, jax.tree.map(jnp.zeros_like, problem), zero, zero, saved_bar
    one = with_products_as_sums(one)
    *_, y_bar, problem_bar, t0_bar, t1_bar, saved_bar = lax.while_loop(lambda carry: carry[0] >= 0, one, begin)
    return eqx.filter(Course(problem_bar, y_bar, t0_bar, t1_bar, saved_bar), wanted)


@eqx.filter_custom_jvp
def integrate(course: Course, integration):
    """Run an `integration`, (course, track) -> (found, Steps or None), with the derivatives of `tangents`.

    What is found has fields `ts` and `t_end`, `ys` and `y_end`, the motion; its other fields have no derivative.
    """
    return integration(course, False)[0]


@integrate.def_jvp
def _integrate_jvp(primals, changes):
    (course, integration), (changes, _) = primals, changes
    found, steps = _tracked(course, integration)
    motion = tangents(integration.solver, course, steps, changes)
    return found, _change(found, integration, course, changes, motion)


@eqx.filter_custom_jvp
def _tracked(course, integration):
    return integration(course, True)


@_tracked.def_jvp
def _tracked_jvp(primals, changes):
    """Derivatives of the steps' states, which derivatives of cotangents need."""
    (course, integration), (changes, _) = primals, changes
    found, steps = _tracked(course, integration)
    motion = tangents(integration.solver, course, steps, changes, every=True)
    begin, end = materialised(course.t0, changes.t0), materialised(course.t1, changes.t1)
    ts = jnp.zeros_like(steps.ts).at[steps.count].set(end).at[0].set(begin)
    return (found, steps), (_change(found, integration, course, changes, motion), Steps(ts, motion.steps, None))


def _change(found, integration, course, changes, motion):
    """Of what is found: the end's time is t1, unless the integration ended before."""
    nothing = jax.tree.map(lambda _: None, found)
    begin, end = materialised(course.t0, changes.t0), materialised(course.t1, changes.t1)
    saved = None if course.saved is None else materialised(course.saved, changes.saved)
    return nothing._replace(
        ts=integration.rows(begin, saved, end),
        t_end=jnp.where(found.t_end == course.t1, end, 0.0),
        ys=integration.rows(materialised(course.y0, changes.y0), motion.saved, motion.end),
        y_end=motion.end,
    )


# As a primitive of JAX, linear in its last argument: only so can one function have a forward and a backward rule.


def _abstract(solver, every, course, steps, restored, flat):
    n = course.y0.shape
    of = lambda shape: jax.core.ShapedArray(shape, course.y0.dtype)
    saved = None if course.saved is None else of(course.saved.shape + n)
    return Motion(saved, of(n), of(steps.ys.shape) if every else None)


@eqxi.filter_primitive_jvp
def _jvp(primals, changes):
    return eqx.filter_jvp(_forwards, primals, changes)


@eqxi.filter_primitive_transpose(materialise_zeros=True)
def _transpose(inputs, cotangent):
    solver, every, course, steps, restored, flat = inputs
    if every:
        raise NotImplementedError(NO_REVERSE)
    changes = jax.eval_shape(restored, flat.aval)
    wanted = jax.tree.map(lambda change: change is not None, changes, is_leaf=lambda leaf: leaf is None)
    found, _ = ravel_pytree(_backwards(solver, course, steps, wanted, cotangent))
    none = lambda tree: jax.tree.map(lambda _: None, tree)
    return none(solver), none(every), none(course), none(steps), None, found


_tangents_p = eqxi.create_vprim(
    "replay",
    eqxi.filter_primitive_def(_forwards),
    eqxi.filter_primitive_def(_abstract),
    _jvp,
    _transpose,
)
