"""A diffrax solver that puts the state back on the closed loops after each step."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.constraint_rows import is_driven
from linkax.model.numbers import Number
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.diffrax_contract import SolverState, StepError, stage_distances
from linkax.simulation.integrate.events import until_next_change
from linkax.simulation.integrate.placement import Placement, lock_ahead
from linkax.simulation.integrate.problem import Problem
from linkax.simulation.integrate.step_control import OPENS, MechanismControl
from linkax.simulation.integrate.switches import Sides, crossed, meet
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import jit_inline, without_derivatives

DIVERGES = 2.0  # rate at which changes grow from one iteration to the next
STAGNATES = 0.9  # rate at which they no longer fall
CLOSED = 1e-5  # radians, or lengths of the mechanism: what corrections leave open at the end of a step, at most
ON_BRANCH = 0.1  # of d at its end: the error of a step of a driven motion, at most, else it may end on another branch
ON_THE_WAY = np.array([0.3, 0.6, 0.9])  # of a step: where loops are looked at
# Times the way to where a mechanism locks: where drives are looked at, and how far they must have gone then.
BEYOND, AT_LEAST = 1.5, 1.3


class StageNorm(eqx.Module):
    """The size of a change of the rates at a stage: its effect on the state, relative to the tolerances."""

    problem: Problem
    y0: Float[Array, " n"]
    duration: Float[Array, ""]
    tolerances: tuple[Array, Array]

    def __call__(self, change: Float[Array, " n"]) -> Float[Array, ""]:
        problem, (rtol, atol) = self.problem, self.tolerances
        errors, internal = problem.errors(self.y0, self.duration * change), problem.internal(self.y0)
        sizes = [1.0, problem.system.fastest(problem.unpacked(self.y0)[1])]
        sizes += [] if internal is None else [jnp.abs(internal / problem.scales[2])]
        allowed = [scale * (rtol * size + atol) for scale, size in zip(problem.scales, sizes, strict=True)]
        scaled = [error / most for error, most in zip(errors, allowed, strict=True)]
        return jnp.max(jnp.abs(jnp.concatenate(scaled)), initial=0.0)


class Chord(diffrax.VeryChord):
    """diffrax's root finder for implicit steps, going on for as long as it converges.

    Up to version 0.7.2 diffrax's takes a step for failed where two iterations do not suffice, and computes twice the
    Jacobian that it keeps over a step.

    - `slopes`: ∂f/∂y where the step begins, (n, n); by default the Jacobian is diffrax's.
    """

    slopes: Float[Array, "n n"] | None = None

    def init(
        self, fn: Any, y: Any, args: Any, options: dict[str, Any], f_struct: Any, aux_struct: Any, tags: Any
    ) -> Any:
        """Factorise 1 − γ Δt ∂f/∂y, the Jacobian of a stage's equation; its `args` have γ second and Δt last."""
        if self.slopes is None or "init_state" in options:  # of the step, by an earlier call
            return super().init(fn, y, args, options, f_struct, aux_struct, tags)
        begun = super().init(lambda at, _: (at, None), y, args, options, f_struct, aux_struct, tags)
        operator = lineax.MatrixLinearOperator(jnp.eye(len(y), dtype=y.dtype) - args[1] * args[-1] * self.slopes)
        factors = lax.stop_gradient(self.linear_solver.init(operator, options={}))
        return dataclasses.replace(begun, linear_state=(operator, factors))

    def terminate(
        self, fn: Callable, y: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset[object]
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Stop where what later iterations would still change is below kappa, or where they diverge."""
        rate, at_least_two = state.diffsize / state.diffsize_prev, state.step >= 2
        contracts = at_least_two & (rate < 1.0)
        to_come = state.diffsize * jnp.where(contracts, rate / jnp.where(contracts, 1.0 - rate, 1.0), 1.0)
        failed = state.result != optx.RESULTS.successful
        # Changes that stop falling within the tolerance are rounding, which fast waves make larger than kappa.
        rounding = at_least_two & (rate >= STAGNATES) & (state.diffsize < 1.0)
        converged = (to_come < self.kappa) | rounding
        diverged = at_least_two & jnp.logical_not(rate <= DIVERGES) & jnp.logical_not(converged)
        result = optx.RESULTS.where(diverged & jnp.logical_not(failed), optx.RESULTS.nonlinear_divergence, state.result)
        return failed | converged | diverged, result

    def postprocess(
        self,
        fn: Any,
        y: Float[Array, "*shape"],
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: Any,
        tags: Any,
        result: optx.RESULTS,
    ) -> tuple[Float[Array, "*shape"], Any, dict[str, Any]]:
        """Return zero rates where they diverge: the step is rejected, and its derivatives must be numbers."""
        return jnp.where(result == optx.RESULTS.successful, y, 0.0), aux, {}


class ProjectedSolver(diffrax.AbstractAdaptiveSolver):
    """Wrap any diffrax solver: it puts the state back on the closed loops after each step.

    The estimate of the step's error is put there too: only its part in the tangent space remains
    in the state. The rest is mostly rounding, which a singular configuration amplifies and the
    correction removes; a step control that saw it would stall.

    - `event`: where steps must not pass over it. `after_step`: whether to correct.
    - `is_undifferentiated`: no transformation will differentiate its steps.

    Not an `AbstractWrappedSolver`: diffrax would look through it for fields it does not have.
    """

    solver: diffrax.AbstractSolver
    tolerances: tuple[Array, Array] | None
    event: diffrax.Event | None
    after_step: bool = eqx.field(static=True)
    is_undifferentiated: bool = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm

    @staticmethod
    def around(
        solver: diffrax.AbstractSolver,
        accuracy: Accuracy,
        adjoint: diffrax.AbstractAdjoint,
        control: MechanismControl,
        event: diffrax.Event | None,
    ) -> "ProjectedSolver":
        """Wrap a solver.

        diffrax hands a solver two things only where it sees it, so it gets them here: the kind of loop inside
        Runge-Kutta steps that forward mode needs, and the tolerances for the root finder of an implicit one.
        """
        kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
        if kind and getattr(solver, "scan_kind", kind) is None:
            solver = eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda leaf: leaf is None)
        finder = getattr(solver, "root_finder", None)
        # What is no number stands for the tolerances of the step control.
        lacks = finder is not None and not eqx.is_array_like(finder.rtol)
        tolerances = control.tolerances((accuracy.rtol, accuracy.atol)) if lacks else None
        event = event if control.is_adaptive else None
        after_step = accuracy.projection in ("both", "step")
        return ProjectedSolver(solver, tolerances, event, after_step, control.is_undifferentiated)

    def _stepping(self, problem, t0, y0, duration):
        """The solver for one step: its root finder measures iterates as errors of the step are measured."""
        if self.tolerances is None:
            return self.solver
        inner: Any = self.solver
        finder = inner.root_finder
        if type(finder) is diffrax.VeryChord:
            slopes = lax.stop_gradient(jax.jacfwd(lambda y: problem.derivative(t0, y))(y0))
            finder = Chord(0.0, 1.0, kappa=finder.kappa, linear_solver=finder.linear_solver, slopes=slopes)
        norm = StageNorm(problem, y0, duration, self.tolerances)
        return dataclasses.replace(self.solver, root_finder=dataclasses.replace(finder, rtol=0.0, atol=1.0, norm=norm))

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self) -> Any:
        return self.solver.term_compatible_contr_kwargs

    def order(self, terms: Any) -> int | None:
        return self.solver.order(terms)

    def error_order(self, terms: Any) -> Number | None:
        return self.solver.error_order(terms)

    def init(
        self, terms: Any, t0: Float[Array, ""], t1: Float[Array, ""], y0: Float[Array, " n"], args: Problem
    ) -> SolverState:
        one = jnp.ones((), args.system.dtype)
        return SolverState(self.solver.init(terms, t0, t1, y0, args), one, one, jnp.zeros((), bool))

    def func(self, terms: Any, t0: Float[Array, ""], y0: Float[Array, " n"], args: Problem) -> Float[Array, " n"]:
        return self.solver.func(terms, t0, y0, args)

    # diffrax traces its loop three times.
    @jit_inline
    def step(
        self,
        terms: Any,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y0: Float[Array, " n"],
        args: Problem,
        solver_state: SolverState,
        made_jump: Bool[Array, ""] | bool,
    ) -> tuple[Float[Array, " n"], StepError, dict[str, Any], SolverState, diffrax.RESULTS]:
        """Take a step with the solver inside and correct it; its error and state are those of `diffrax_contract`."""
        # Solvers that begin with the last derivative of the step before must not where the state has moved since, nor
        # where laws may have jumped.
        switching = len(args.sides(y0)) > 0
        moved = self.after_step and args.method.moves_after_steps
        made_jump = True if switching or moved or args.times is not None else made_jump
        solver = self._stepping(args, t0, y0, t1 - t0)
        within_step = args if args.times is None else dataclasses.replace(args, until=t1)
        stepped, error, dense_info, inner, result = solver.step(
            terms, t0, t1, y0, within_step, solver_state.inner, made_jump
        )
        stages = stage_distances(dense_info, t1 - t0, self.solver)
        leaves = solver_state.arrives
        # By an infinite error a solver tells that its step has failed: of infinity no derivative is a number.
        failed = error is not None and jnp.logical_not(jnp.all(jnp.isfinite(error)))
        error = None if error is None else lax.stop_gradient(jnp.where(failed, 0.0, error))
        if self.after_step:
            y1, errors, arrives = args.corrected(t1, stepped, error)
        else:
            y1 = stepped
            arrives = leaves if stages is None else stages[-1]
            errors = None if error is None else args.errors(y1, error)
        errors = jax.tree.map(lambda error: jnp.where(failed, jnp.inf, error), errors)
        locked = jnp.zeros((), bool)
        if stages is None:
            placement = Placement.unknown(arrives)
        else:
            inner_solver: Any = self.solver
            along = np.asarray(inner_solver.tableau.c, dtype=float), stages[0], stages[1:], lax.stop_gradient(arrives)
            leaves, placement = stages[0], Placement.of(*along)
            if is_driven(args.system):
                problem, t, duration, before, after = without_derivatives((args, t1, t1 - t0, y0, y1))
                fastest = lambda y: problem.system.fastest(problem.unpacked(y)[1])
                ahead = duration * lock_ahead(*along, ratio(fastest(after), fastest(before)))
                locked = (ahead > 0.0) & (problem.drives_on(t, after, BEYOND * ahead) > AT_LEAST * ahead)
        closest = jnp.minimum(solver_state.closest, jnp.minimum(placement.passes, arrives))
        within = self.interpolation_cls(t0=t0, t1=t1, **dense_info).evaluate
        opens = switch = turns = None
        if self.after_step and args.method.checks_loops(args.system.topology):
            on_the_way = t0 + jnp.asarray(ON_THE_WAY, t1.dtype) * (t1 - t0)
            times = jnp.append(on_the_way, t1)
            *between, end = jax.vmap(args.opens)(times, jnp.concatenate([jax.vmap(within)(on_the_way), y1[None]]))
            # No motion goes on from loops that are not closed, such as past where a mechanism locks.
            at_most = jnp.maximum(CLOSED, jnp.sqrt(jnp.finfo(end.dtype).eps))
            opens = jnp.max(jnp.stack([*between, OPENS / at_most * end]))
            if is_driven(args.system) and error is not None:
                # Of a motion that drives leave no freedom, the correction takes all of the error, wherever it leads to.
                uncorrected = args.system.fastest(args.errors(y1, error)[0])
                opens = jnp.maximum(opens, OPENS * uncorrected / jnp.maximum(ON_BRANCH * arrives, CLOSED))
            opens = lax.stop_gradient(opens)
        corrected = y1

        def closed(share):
            """Corrected as the end is: a root between a motion and its end is none that a shorter step comes to."""
            return within(t0 + share * (t1 - t0)) + share * (corrected - stepped)

        if switching:
            fixed = without_derivatives((args, t0, t1, y0, y1))
            switch, sides = lax.stop_gradient(meet(*fixed, within=closed))
            problem, *ends = fixed
            turns = jax.vmap(problem.turning)(jnp.stack(ends[:2]), jnp.stack(ends[2:]))
            turns = None if turns is None else lax.stop_gradient(jnp.max(turns))
            _, y1 = crossed(args, t1, y1, sides, "nothing" if self.is_undifferentiated else "state")
        if self.event is not None:
            event, *fixed = without_derivatives((self.event, args, t0, t1))
            share = until_next_change(event, *fixed, within=closed, after=y1)
            switch = share if switch is None else jnp.minimum(switch, share)
        state = SolverState(inner, arrives, closest, locked)
        of_step = StepError(
            errors, leaves, placement, opens, switch, turns, locked.astype(t1.dtype), solver_state.inner
        )
        return y1, of_step, dense_info, state, result

    def corrected(
        self, problem: Problem, t1: Float[Array, ""], y1: Float[Array, " n"], sides: Sides
    ) -> tuple[Float[Array, ""], Float[Array, " n"]]:
        """Correct the state after a step, and put it on these sides of switches: when, and where motion goes on."""
        return crossed(problem, t1, problem.corrected(t1, y1)[0] if self.after_step else y1, sides, "time")
