"""What diffrax lacks for motion on a manifold: a solver that projects, a step control that knows it.

The two work as a pair: `Projected` corrects the state after each step, leaves of the error
estimate what remains in the corrected state, and finds how close the stages came to a singular
configuration; `MechanismControl` measures errors in the units of the mechanism, takes off what
rounding alone causes, and places steps so that no stage falls close to a singular configuration.
"""

import dataclasses
from functools import partial
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float

from linkax.equations.coordinates import rates, speeds
from linkax.equations.system import System
from linkax.formulations.formulation import AbstractFormulation
from linkax.model.mechanism import Mechanism
from linkax.simulation.accuracy import Accuracy
from linkax.simulation.state import State
from linkax.simulation.switches import crossed, held, meet, values
from linkax.tracing import in_one_kernel

NOISE_ULPS = 1.0
SEEN_ULPS = 512.0  # of estimates: rounding changes larger ones by less than a hundredth
SEEN = 1e-3  # of the tolerance, which is as small
FIRST_STEP = 1e-3  # of the whole time
FIRST_TURN = 1e-2  # radians, or lengths of the mechanism
FIRST_TURN_SINGULAR = 1e-3  # from a singular configuration, where the first stage does not know all of the loops
SMALLEST_STEP_ULPS = 4.0
MOST_RETRIES = 4
FEASIBLE = 0.1  # of a step's first distance: what any step can keep from a passage
DIVERGES = 2.0  # rate at which changes grow from one iteration to the next
STAGNATES = 0.9  # rate at which they no longer fall
BEYOND = 1.5  # how far after its end a step may leave a passage, in steps


class Problem(eqx.Module):
    """The right-hand side's arguments: a mechanism, its numbers, the method that solves it, how well.

    diffrax integrates one vector: q, v, and the time integral of the distance d from the nearest
    singular configuration, whose rates tell a step how close its stages came. Where steps adapt to switches of force
    elements, the sides of these come first. From a state that is not `sound`, no step is taken. At `closed_at` [s] the
    state is on the loops already: there a correction would be rounding alone, which close to a singular configuration
    is amplified. `from_singular`: the run starts in one.
    """

    mechanism: Mechanism
    system: System
    method: AbstractFormulation
    accuracy: Accuracy
    sound: Bool[Array, ""] = True
    closed_at: Float[Array, ""] = np.inf
    from_singular: Bool[Array, ""] = False

    def packed(self, q, v, integral=0.0, sides=()):
        """The vector that diffrax integrates."""
        first = [sides] if len(sides) else []
        return jnp.concatenate([*first, q, v, jnp.reshape(jnp.asarray(integral, q.dtype), (1,))])

    def _first(self, y):
        """Where q begins in such vectors: after the sides."""
        return y.shape[-1] - self.system.topology.num_coordinates - self.system.topology.num_speeds - 1

    def unpacked(self, y):
        """q and v of such vectors, (..., m + n_q + n_v + 1)."""
        first = self._first(y)
        middle = first + self.system.topology.num_coordinates
        return y[..., first:middle], y[..., middle:-1]

    def sides(self, y):
        """The sides of switches on which force elements are held, (m,); none where steps do not adapt to them."""
        return y[: self._first(y)] if self._first(y) else ()

    def on_sides(self, y, sides):
        """The same vector with other sides."""
        return jnp.concatenate([sides, y[len(sides) :]])

    def switches(self, t, y):
        """Values of the switches at a vector, (m,)."""
        return values(self.system, t, *self.unpacked(y))

    def errors(self, y, error):
        """Error estimates of q and v at a vector y, as changes (n_v,) of both."""
        of_q, of_v = self.unpacked(error)
        return speeds(self.system.topology, self.unpacked(y)[0], of_q), of_v

    def derivative(self, t, y):
        """(q̇, v̇, d) for diffrax."""
        correct = self.accuracy.projection in ("both", "stage") and t != self.closed_at

        def packed_rates(y):
            sides = self.sides(y)
            system = held(self.system, sides) if len(sides) else self.system
            v, acceleration, q, distance = self.method.derivative(system, t, *self.unpacked(y), correct)
            still = jax.tree.map(jnp.zeros_like, sides)
            return self.packed(rates(system.topology, q, v), acceleration, distance, still)

        return _apart(packed_rates, y, jnp.full_like(y, jnp.nan))

    def close(self, t, y):
        """The `State` on the manifold to rounding."""
        return State(*self.method.close(self.system, t, *self.unpacked(y)))


def _apart(function, y, otherwise):
    """function(y), as a branch of its own, taken where y is finite.

    The branch is for speed: XLA runs a computation on the CPU without the cost of scheduling
    its parts (half of the time for a small mechanism) where it touches small arrays only, and
    inlined into a solver's step it would touch the tables of the solver.
    """
    return lax.cond(jnp.all(jnp.isfinite(y)), function, lambda y: otherwise, y)


class StepError(NamedTuple):
    """What `Projected` tells `MechanismControl` of a step.

    - `error`: estimate of q and v, or None.
    - `leaves`: distance d from the nearest singular configuration where the step begins.
    - `passes`: the smallest d of its other stages. `retry`: by how much to change the step so that
      what passes there falls between two stages.
    - `switch`: by how much to shorten the step so that it ends at the first switch of a force element that it goes
      past, one for none; None where there are none.
    """

    error: Any
    leaves: Float[Array, ""]
    passes: Float[Array, ""]
    retry: Float[Array, ""]
    switch: Float[Array, ""] | None = None


def placements(nodes) -> np.ndarray:
    """By how much to change a step that meets an event at one of its nodes.

    For each node of a Runge-Kutta tableau in (0, 1] the factor that brings the event as far from
    all nodes as possible, into the middle of a gap between later ones or after the step's end.
    """
    nodes = np.asarray(nodes, dtype=float)
    ends = np.unique([*nodes[nodes > 0.0], BEYOND])
    middle, clearance = (ends[1:] + ends[:-1]) / 2, (ends[1:] - ends[:-1]) / 2

    def placement(node):
        later = middle >= node
        return node / middle[later][np.argmax((clearance / middle)[later])]

    return np.array([placement(node) if node > 0.0 else 1.0 for node in nodes])


class StageNorm(eqx.Module):
    """The size of a change of the rates at a stage: what it changes of the state, relative to the tolerances."""

    problem: Problem
    y0: Float[Array, " n"]
    duration: Float[Array, ""]
    tolerances: tuple[Array, Array]

    def __call__(self, change):
        problem, (rtol, atol) = self.problem, self.tolerances
        units, (of_q, of_v) = problem.system.units, problem.errors(self.y0, self.duration * change)
        fastest = jnp.max(jnp.abs(problem.unpacked(self.y0)[1] / units), initial=0.0)
        of_q, of_v = of_q / units / (rtol + atol), of_v / units / (rtol * fastest + atol)
        return jnp.max(jnp.abs(jnp.concatenate([of_q, of_v])), initial=0.0)


class Chord(diffrax.VeryChord):
    """diffrax's root finder for implicit steps, which goes on for as long as it converges.

    Up to version 0.7.2 diffrax's takes a step for failed where two iterations do not suffice.
    """

    def terminate(self, fn, y, args, options, state, tags):
        """Whether what the iterations to come would still change is below kappa, or they diverge."""
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


class Projected(diffrax.AbstractAdaptiveSolver):
    """Any diffrax solver, with the state put back on the closed loops after each step.

    The estimate of the step's error is put there too: only its part in the tangent space remains
    in the state. The rest is mostly rounding, which a singular configuration amplifies and the
    correction removes; a step control that saw it would stall.

    The solver's state holds the distance from a singular configuration at the end of the last
    step, and the smallest so far at any stage.

    `is_final`: no transformation will differentiate its steps, so that each may be one kernel.

    Not an `AbstractWrappedSolver`: diffrax would look through it for fields it does not have.
    """

    solver: diffrax.AbstractSolver
    tolerances: tuple[Array, Array] | None
    after_step: bool = eqx.field(static=True)
    is_final: bool = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm

    @staticmethod
    def around(solver, accuracy, adjoint, control: "MechanismControl") -> "Projected":
        """Wrap a solver.

        What diffrax hands to a solver only where it sees it, it gets here: the kind of loop inside Runge-Kutta
        steps that forward mode needs, and the tolerances for the root finder of an implicit one.
        """
        kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
        if kind and getattr(solver, "scan_kind", kind) is None:
            solver = eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda leaf: leaf is None)
        finder = getattr(solver, "root_finder", None)
        # What is no number stands for the tolerances of the step control.
        lacks = finder is not None and not eqx.is_array_like(finder.rtol)
        tolerances = control.tolerances((accuracy.rtol, accuracy.atol)) if lacks else None
        return Projected(solver, tolerances, accuracy.projection in ("both", "step"), control.is_final)

    def _stepping(self, problem, y0, duration):
        """The solver for one step: its root finder measures what it finds as errors of the step are measured."""
        if self.tolerances is None:
            return self.solver
        finder = self.solver.root_finder
        if type(finder) is diffrax.VeryChord:
            finder = Chord(0.0, 1.0, kappa=finder.kappa, linear_solver=finder.linear_solver)
        norm = StageNorm(problem, y0, duration, self.tolerances)
        return dataclasses.replace(self.solver, root_finder=dataclasses.replace(finder, rtol=0.0, atol=1.0, norm=norm))

    @property
    def interpolation_cls(self):
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):
        return self.solver.term_compatible_contr_kwargs

    def order(self, terms):
        return self.solver.order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)

    def init(self, terms, t0, t1, y0, args):
        one = jnp.ones((), args.system.dtype)
        return self.solver.init(terms, t0, t1, y0, args), one, one

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        step = Projected._step
        if self.is_final:
            step = partial(in_one_kernel, step, jnp.all(jnp.isfinite(y0)))
        return step(self, terms, t0, t1, y0, args, solver_state, made_jump)

    def _step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        inner, leaves, closest = solver_state
        # Solvers that begin with the last derivative of the step before must not where the state has moved since.
        switching = len(args.sides(y0)) > 0
        made_jump = True if switching or (self.after_step and args.method.moves_after_steps) else made_jump
        solver = self._stepping(args, y0, t1 - t0)
        y1, error, dense_info, inner, result = solver.step(terms, t0, t1, y0, args, inner, made_jump)
        stages = self._stages(dense_info, t1 - t0)
        if self.after_step:
            y1, error, arrives = _corrected(args, t1, y1, error)
        else:
            arrives = leaves if stages is None else stages[-1]
            error = None if error is None else args.errors(y1, error)
        if stages is None:
            leaves_now, passes, retry = leaves, arrives, jnp.ones_like(arrives)
        else:
            nearest = jnp.argmin(stages[1:])
            leaves_now, passes = stages[0], stages[1:][nearest]
            retry = jnp.asarray(placements(self.solver.tableau.c), passes.dtype)[nearest]
        closest = jnp.minimum(closest, jnp.minimum(passes, arrives))
        switch = None
        if switching:
            within = self.interpolation_cls(t0=t0, t1=t1, **dense_info).evaluate
            switch, sides = lax.stop_gradient(meet(*lax.stop_gradient((args, t0, t1, y0, y1)), within))
            y1 = args.on_sides(y1, sides) if self.is_final else crossed(args, t1, y1, sides)
        return y1, StepError(error, leaves_now, passes, retry, switch), dense_info, (inner, arrives, closest), result

    def corrected(self, problem: Problem, t1, y1, sides):
        """The state that a step leaves, on these sides of switches."""
        return crossed(problem, t1, _corrected(problem, t1, y1, None)[0] if self.after_step else y1, sides)

    def _stages(self, dense_info, duration):
        """Distances at the stages of a Runge-Kutta step, where this is one."""
        if not (isinstance(dense_info, dict) and "k" in dense_info and hasattr(self.solver, "tableau")):
            return None
        return lax.stop_gradient(dense_info["k"][:, -1] / duration)


def _corrected(problem, t1, y1, error):
    """State and error estimate after the correction, and the distance d there."""
    errors = () if error is None else problem.errors(y1, error)

    def correct(y):
        q, v, errors_left, distance = problem.method.correct(problem.system, t1, *problem.unpacked(y), errors)
        return problem.packed(q, v, y[-1], problem.sides(y)), errors_left, distance

    undefined = jax.tree.map(lambda array: jnp.full_like(array, jnp.nan), (y1, errors))
    y1, errors, distance = _apart(correct, y1, (*undefined, jnp.ones((), y1.dtype)))
    return y1, None if error is None else errors, distance


class MechanismControl(diffrax.AbstractStepSizeController):
    """Any diffrax step size controller, measuring errors in the units of the mechanism.

    The controller inside sees coordinates in radians and lengths of the mechanism, all of
    magnitude one, and speeds in the same units, all of the magnitude of the largest: a joint
    that has made many turns, or that stands still for a moment, does not change the tolerance.
    The error it sees has rounding taken off, which no smaller step would lower, and which grows
    near a singular configuration.

    An adaptive step that has a stage close to a singular configuration is tried again, shorter,
    so that the configuration falls between two stages. Where a few tries do not help, or the step
    begins in the singular configuration, it is left as it is. One that goes past a switch of a force element is tried
    again up to there, see `linkax.simulation.switches`.

    `is_final`: see `Projected`.
    """

    controller: diffrax.AbstractStepSizeController
    is_final: bool = eqx.field(static=True, default=False)

    def wrap(self, direction):
        return MechanismControl(self.controller.wrap(direction), self.is_final)

    @property
    def is_adaptive(self) -> bool:
        """Whether the controller inside chooses the steps by their errors."""
        return isinstance(self.innermost, diffrax.AbstractAdaptiveStepSizeController)

    def tolerances(self, otherwise):
        """Relative and absolute tolerance of the controller inside; others where it has none."""
        inner = self.innermost
        return (inner.rtol, inner.atol) if self.is_adaptive else otherwise

    @property
    def innermost(self) -> diffrax.AbstractStepSizeController:
        """The controller inside others that hold one."""
        inner = self.controller
        while hasattr(inner, "controller"):
            inner = inner.controller
        return inner

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        _, v = args.unpacked(y0)
        if dt0 is None and self.is_adaptive:
            # Not diffrax's choice, which would compile the equations of motion twice more.
            fastest = jnp.max(jnp.abs(v / args.system.units), initial=0.0)
            most = jnp.where(args.from_singular, FIRST_TURN_SINGULAR, FIRST_TURN)
            turning = jnp.where(fastest > 0.0, most / jnp.where(fastest > 0.0, fastest, 1.0), jnp.inf)
            dt0 = jnp.minimum(FIRST_STEP * (t1 - t0), turning)
            dt0 = lax.stop_gradient(dt0)
        first, state = self.controller.init(terms, t0, t1, (v, v), dt0, args, func, error_order)
        return first, (state, jnp.zeros((), int))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        adapt = (
            partial(in_one_kernel, MechanismControl._adapt, jnp.isfinite(t0))
            if self.is_final
            else MechanismControl._adapt
        )
        return adapt(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state)

    def _adapt(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        units = args.system.units
        scales = tuple(_magnitudes(args.unpacked(y), units) for y in (y0, y1_candidate))
        scaled = None
        if y_error.error is not None and self.is_adaptive:
            noise = _noise(jnp.minimum(y_error.leaves, y_error.passes), args.method.nearest)
            # The second is none where the step has led to no numbers.
            largest = jax.tree.map(lambda a, b: jnp.maximum(a, jnp.where(jnp.isfinite(b), b, 0.0)), *scales)
            # An estimate that is rounding alone must not choose the next step: in a batch it would be another one.
            least = jnp.minimum(SEEN_ULPS * jnp.finfo(units.dtype).eps, SEEN * self.innermost.rtol)
            scaled = tuple(
                jnp.maximum(jnp.abs(_less(e / units, noise * scale)), least * scale)
                for e, scale in zip(y_error.error, largest, strict=True)
            )
        before, retries = controller_state
        keep, next_t0, next_t1, jump, after, result = self.controller.adapt_step_size(
            t0, t1, *scales, args, scaled, error_order, before
        )
        # A step size that is not a number does not proceed either.
        proceeds = next_t1 - next_t0 > SMALLEST_STEP_ULPS * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t1), 1e-3)
        keep = keep & args.sound
        result = diffrax.RESULTS.where(keep | (proceeds & args.sound), result, diffrax.RESULTS.dt_min_reached)
        if not self.is_adaptive:
            finite = jnp.all(jnp.isfinite(y1_candidate))
            result = diffrax.RESULTS.where(finite, result, diffrax.RESULTS.dt_min_reached)
            return keep & finite, jnp.where(finite, next_t0, t0), next_t1, jump, (after, retries), result
        near = jnp.minimum(args.accuracy.clearance, FEASIBLE * y_error.leaves)
        again = keep & (y_error.passes < near) & (retries < MOST_RETRIES)
        end = t0 + y_error.retry * (t1 - t0)
        if y_error.switch is not None:
            late = y_error.switch < 1.0
            to_switch = t0 + y_error.switch * (t1 - t0)
            end = jnp.where(late, jnp.where(keep, to_switch, jnp.minimum(to_switch, next_t1)), end)
            again = again | late
        either = lambda retry, otherwise: jax.tree.map(lambda a, b: jnp.where(again, a, b), retry, otherwise)
        return (
            keep & jnp.logical_not(again),
            either(t0, next_t0),
            either(end, next_t1),
            jump & jnp.logical_not(again),
            (either(before, after), jnp.where(again, retries + 1, jnp.where(keep, 0, retries))),
            result,
        )


def _magnitudes(state, units):
    """What the tolerances are relative to: one for coordinates, the largest speed for speeds."""
    q, v = state
    fastest = jnp.max(jnp.abs(v / units), initial=0.0)
    return jnp.where(jnp.all(jnp.isfinite(q)), jnp.ones_like(v), jnp.nan), jnp.broadcast_to(fastest, v.shape)


def _noise(distance, nearest):
    """Rounding along the motion, relative: it grows like 1/d, up to 1/`nearest`.

    Across the motion it grows like 1/d², but that the correction takes off.
    """
    return NOISE_ULPS * jnp.finfo(distance.dtype).eps / jnp.maximum(distance, nearest)


def _less(error, noise):
    """An error less the noise in it."""
    return jnp.where(jnp.abs(error) > noise, error - jnp.sign(error) * noise, 0.0 * error)
