"""What diffrax lacks for motion on a manifold: a solver that projects, a step control that knows it.

The two work as a pair: `Projected` corrects the state after each step and passes the distance
from the nearest singular configuration on with its error estimate, `MechanismControl` measures
that estimate in the units of the mechanism and takes off the rounding noise that a singular
configuration amplifies.
"""

from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from linkax.equations.system import System
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism

NOISE_FACTOR = 100.0
LARGEST_NOISE = 1e-8
FIRST_STEP = 1e-3  # of the whole time
FIRST_TURN = 1e-2  # radians, or lengths of the mechanism
SMALLEST_STEP_ULPS = 4.0


class Problem(eqx.Module):
    """The right-hand side's arguments: a mechanism, its numbers, and the method that solves it."""

    mechanism: Mechanism
    system: System
    method: TangentSpace
    projection: str = eqx.field(static=True)

    def derivative(self, t, state):
        """(q̇, v̇) for diffrax."""
        correct = self.projection in ("both", "stage")
        return _apart(lambda q, v: self.method.derivative(self.system, t, q, v, correct), state, _undefined(state))

    def close(self, state):
        """The state on the manifold to rounding."""
        return self.method.close(self.system, *state)


def _apart(function, state, otherwise):
    """function(q, v), as a branch of its own, taken where the state is finite.

    The branch is for speed: XLA runs a computation on the CPU without the cost of scheduling
    its parts (half of the time for a small mechanism) where it touches small arrays only, and
    inlined into a solver's step it would touch the tables of the solver.
    """
    q, v = state
    finite = jnp.all(jnp.isfinite(q)) & jnp.all(jnp.isfinite(v))
    return lax.cond(finite, function, lambda q, v: otherwise, q, v)


def _undefined(state):
    return jax.tree.map(lambda array: jnp.full_like(array, jnp.nan), state)


class StepError(NamedTuple):
    """A step's error estimate, and the smaller d of its two ends (see `Inverse.distance`).

    Both ends count: at a start exactly in a singular configuration the rank is lower, and the
    distance is that of the rows left.
    """

    error: Any
    distance: Float[Array, ""]


class Projected(diffrax.AbstractAdaptiveSolver):
    """Any diffrax solver, with the state put back on the closed loops after each step.

    Not an `AbstractWrappedSolver`: diffrax would look through it for fields it does not have.
    """

    solver: diffrax.AbstractSolver
    after_step: bool = eqx.field(static=True)

    term_structure: ClassVar = diffrax.AbstractTerm

    @staticmethod
    def around(solver, accuracy, adjoint) -> "Projected":
        """Wrap a solver. Forward mode needs another kind of loop inside Runge-Kutta steps, which
        diffrax chooses itself only where it sees the solver."""
        kind = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}.get(type(adjoint))
        if kind and getattr(solver, "scan_kind", kind) is None:
            solver = eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda leaf: leaf is None)
        return Projected(solver, accuracy.projection in ("both", "step"))

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
        return self.solver.init(terms, t0, t1, y0, args), jnp.ones((), args.system.dtype)

    def func(self, terms, t0, y0, args):
        return self.solver.func(terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        inner, distance = solver_state
        y1, error, dense_info, inner, result = self.solver.step(terms, t0, t1, y0, args, inner, made_jump)
        next_distance = distance
        if self.after_step:
            q, v, next_distance = _apart(
                lambda q, v: args.method.correct(args.system, q, v), y1, (*_undefined(y1), distance)
            )
            y1 = (q, v)
        return y1, StepError(error, jnp.minimum(distance, next_distance)), dense_info, (inner, next_distance), result


class MechanismControl(diffrax.AbstractStepSizeController):
    """Any diffrax step size controller, measuring errors in the units of the mechanism.

    The controller inside sees coordinates in radians and lengths of the mechanism, all of
    magnitude one, and speeds in the same units, all of the magnitude of the largest: a joint
    that has made many turns, or that stands still for a moment, does not change the tolerance.
    From the error it sees, noise of rounding is taken off that no smaller step would lower.
    """

    controller: diffrax.AbstractStepSizeController

    def wrap(self, direction):
        return MechanismControl(self.controller.wrap(direction))

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if dt0 is None and isinstance(self.controller, diffrax.AbstractAdaptiveStepSizeController):
            # Not diffrax's choice, which would compile the equations of motion twice more.
            fastest = jnp.max(jnp.abs(y0[1] / args.system.coordinate_units), initial=0.0)
            turning = jnp.where(fastest > 0.0, FIRST_TURN / jnp.where(fastest > 0.0, fastest, 1.0), jnp.inf)
            dt0 = jnp.minimum(FIRST_STEP * (t1 - t0), turning)
            dt0 = lax.stop_gradient(dt0)
        return self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        units = args.system.coordinate_units
        if y_error.error is not None:
            noise = _noise(y_error.distance)
            q_error, v_error = (_less(error / units, noise) for error in y_error.error)
            scales = _magnitudes(y0, units), _magnitudes(y1_candidate, units)
            scaled = q_error, v_error
        else:
            scaled, scales = None, (y0, y1_candidate)
        keep, next_t0, next_t1, jump, controller_state, result = self.controller.adapt_step_size(
            t0, t1, *scales, args, scaled, error_order, controller_state
        )
        stalled = next_t1 - next_t0 <= SMALLEST_STEP_ULPS * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t1), 1e-3)
        result = diffrax.RESULTS.where(stalled & jnp.logical_not(keep), diffrax.RESULTS.dt_min_reached, result)
        return keep, next_t0, next_t1, jump, controller_state, result


def _magnitudes(state, units):
    """What the tolerances are relative to: one for coordinates, the largest speed for speeds."""
    q, v = state
    fastest = jnp.max(jnp.abs(v / units), initial=0.0)
    return jnp.where(jnp.isfinite(q), 1.0, q), jnp.broadcast_to(fastest, v.shape)


def _noise(distance):
    """Rounding in v̇, amplified by the distance from a singular configuration."""
    epsilon = jnp.finfo(distance.dtype).eps
    return jnp.minimum(NOISE_FACTOR * epsilon / distance**2, LARGEST_NOISE)


def _less(error, noise):
    size = jnp.max(jnp.abs(error), initial=0.0)
    kept = jnp.where(size > 0.0, jnp.maximum(1.0 - noise / jnp.where(size > 0.0, size, 1.0), 0.0), 1.0)
    return error * lax.stop_gradient(kept)
