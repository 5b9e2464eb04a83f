"""A diffrax step size controller for motion on a manifold with singular configurations and switches."""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.formulations.formulation import NEAR
from linkax.simulation.integrate.diffrax_contract import StepError
from linkax.simulation.integrate.step_record import LoopState, Size, StepRecord
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

NOISE_ULPS = 1.0
AMPLIFIED = 0.1  # of turn / d²: what of rounding at a stage is in the estimate of a step's error
SEEN_ULPS = 512.0  # of estimates: rounding changes larger ones by less than a hundredth
SEEN = 1e-3  # of the tolerance, which is as small
OPENS = 1e-3  # radians, or lengths of the mechanism: what loops may open between steps
FIRST_STEP = 1e-3  # of the whole time
FIRST_TURN = 1e-2  # radians, or lengths of the mechanism
FIRST_TURN_SINGULAR = 1e-3  # from a singular configuration, where the first stage does not know all of the loops
SMALLEST_STEP_ULPS = 4.0
MOST_RETRIES = 4
# Radians that joints may turn in a step between bodies whose force elements switch, and beyond which it is tried again:
# what comes back with each turn would be passed over between two samples of a step that has no error to shorten it.
TURN = 4.0
TURN_AT_MOST = 6.0


class ControlState(NamedTuple):
    """The state of the controller inside, and of steps that must end at a time.

    - `retries`: how often the step was tried again. `free`: how long the next one may be that need not end at a switch,
      or at a known time of a law; zero where the controller inside knows that.
    - `record`: the steps so far, where derivatives need them, else None.
    """

    inner: Any
    retries: Int[Array, ""]
    free: Float[Array, ""]
    record: StepRecord | None = None


class MechanismControl(diffrax.AbstractStepSizeController):
    """Wrap any diffrax step size controller: it measures errors in the scales of the mechanism.

    The controller inside sees coordinates in radians and lengths of the mechanism, all of
    magnitude one, and speeds in the same scales, all of the magnitude of the largest: a joint
    that has made many turns, or that stands still for a moment, does not change the tolerance.
    Internal states of force elements it sees in scales of their own.
    The error it sees has rounding taken off, which no smaller step would lower, and which grows
    near a singular configuration.

    An adaptive step with a stage close to a singular configuration is tried again, shorter, so that the configuration
    falls between two stages, whatever its error: that is rounding of this stage. So is one that ends where the next one
    could not be placed, see `linkax.simulation.integrate.placement`. A step that goes past a switch of a force element
    is tried again up to there, see `linkax.simulation.integrate.switches`; the next one is as long as it was before.
    After a step that leads up to where the mechanism locks there is none.

    - `is_undifferentiated`: see `ProjectedSolver`.
    - `records`: the size of the record of steps; None where there is none.
    - `start`: from where an integration goes on; None where it begins.
    - `solver`: a state of the solver, of which a record keeps others.
    """

    controller: diffrax.AbstractStepSizeController
    is_undifferentiated: bool = eqx.field(static=True, default=False)
    records: Size | None = eqx.field(static=True, default=None)
    start: LoopState | None = None
    solver: Any = None

    def wrap(self, direction: int | Array) -> "MechanismControl":
        return dataclasses.replace(self, controller=self.controller.wrap(direction))

    @property
    def is_adaptive(self) -> bool:
        """Whether the controller inside chooses the steps by their errors."""
        return isinstance(self.innermost, diffrax.AbstractAdaptiveStepSizeController)

    def tolerances(self, otherwise: tuple[Any, Any]) -> tuple[Any, Any]:
        """Relative and absolute tolerance of the controller inside; `otherwise` where it has none."""
        inner = self.innermost
        return (inner.rtol, inner.atol) if self.is_adaptive else otherwise

    @property
    def innermost(self) -> Any:
        """The controller inside all wrappers."""
        inner: Any = self.controller
        while hasattr(inner, "controller"):
            inner = inner.controller
        return inner

    def init(
        self,
        terms: Any,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y0: Float[Array, " n"],
        dt0: Float[Array, ""] | None,
        args: Any,
        func: Any,
        error_order: Any,
    ) -> tuple[Any, ControlState]:
        if self.start is not None:
            return self.start.t1, self._recording(self.start)
        (_, v), internal = args.unpacked(y0), args.internal(y0)
        if dt0 is None and self.is_adaptive:
            # Not diffrax's choice, which would compile the equations of motion twice more.
            most = jnp.where(args.from_singular, FIRST_TURN_SINGULAR, FIRST_TURN)
            turning = ratio(most, args.system.fastest(v), jnp.inf)
            dt0 = jnp.minimum(FIRST_STEP * (t1 - t0), turning)
            dt0 = lax.stop_gradient(dt0)
        alike = (v, v) if internal is None else (v, v, internal)
        first: Any
        first, state = self.controller.init(terms, t0, t1, alike, dt0, args, func, error_order)
        first, free = self._until_known(args, t0, first, jnp.zeros_like(t0))
        return first, self._recording(
            LoopState(t0, first, y0, ControlState(state, jnp.zeros((), int), free), self.solver)
        )

    def _recording(self, start):
        """The state of the step control from a start, with a record where one is kept."""
        if self.records is None:
            return start.control
        return start.control._replace(record=StepRecord.empty(start, self.records))

    def adapt_step_size(
        self,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y0: Float[Array, " n"],
        y1_candidate: Float[Array, " n"],
        args: Any,
        y_error: StepError,
        error_order: Any,
        controller_state: ControlState,
    ) -> tuple[Bool[Array, ""], Float[Array, ""], Any, Any, ControlState, diffrax.RESULTS]:
        """Accept or reject the step, and choose the next one; `y_error` is a `StepError`."""
        record = controller_state.record
        before = controller_state._replace(record=None)
        ends, next_t0, next_t1, jump, after, result = self._adapted(
            t0, t1, y0, y1_candidate, args, y_error, error_order, before
        )
        if record is not None:
            record = record.after(LoopState(t0, t1, y0, before, y_error.solver), ends, next_t0, y1_candidate)
        return ends, next_t0, next_t1, jump, after._replace(record=record), result

    def _adapted(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """The same without a record."""
        magnitude, candidate = (_magnitudes(args, y) for y in (y0, y1_candidate))
        measured = y_error.error is not None and self.is_adaptive
        turn = args.system.fastest(args.unpacked(y0)[1]) * (t1 - t0)
        scaled = self._scaled_error(args, y_error, turn, magnitude, candidate) if measured else None
        before, retries, free, _ = controller_state
        keep, next_t0, next_t1, jump, after, result = self.controller.adapt_step_size(
            t0, t1, magnitude, candidate, args, scaled, error_order, before
        )
        # A step size that is not a number does not proceed either.
        proceeds = next_t1 - next_t0 > SMALLEST_STEP_ULPS * jnp.finfo(t0.dtype).eps * jnp.maximum(jnp.abs(t1), 1e-3)
        goes_on = args.can_go_on(t0, y0)
        keep = keep & goes_on
        result = diffrax.RESULTS.where(keep | (proceeds & goes_on), result, diffrax.RESULTS.dt_min_reached)
        if not self.is_adaptive:
            holds = jnp.all(jnp.isfinite(y1_candidate))
            holds = holds if y_error.opens is None else holds & (y_error.opens <= NEAR)
            result = diffrax.RESULTS.where(holds, result, diffrax.RESULTS.dt_min_reached)
            state = ControlState(after, retries, free)
            return keep & holds, jnp.where(holds, next_t0, t0), next_t1, jump, state, result
        placement = y_error.placement
        again = placement.misplaced(args.accuracy.clearance, keep) & (retries < MOST_RETRIES)
        end = t0 + placement.retry * (t1 - t0)
        if y_error.switch is not None:
            late = y_error.switch < 1.0
            to_switch = t0 + y_error.switch * (t1 - t0)
            end = jnp.where(late, jnp.where(keep, to_switch, jnp.minimum(to_switch, next_t1)), end)
            again = again | late
            free = jnp.where(late, jnp.maximum(free, t1 - t0), free)
        longest = jnp.inf
        if y_error.turns is not None:
            # Where a step is rejected for its error, the speeds at its end say nothing.
            longest = jnp.where(keep, ratio(TURN, y_error.turns, jnp.inf), jnp.inf)
            far = t1 - t0 > TURN_AT_MOST / TURN * longest
            end, again = jnp.minimum(jnp.where(again, end, jnp.inf), t0 + longest), again | far
        free = jnp.where(keep, free, 0.0)
        # Controllers around the innermost one have times of their own to end steps at.
        longer = jnp.maximum(next_t1, next_t0 + free) if self.controller is self.innermost else next_t1
        next_t1 = jnp.where(again, end, jnp.minimum(longer, next_t0 + longest))
        ends = keep & jnp.logical_not(again)
        result = diffrax.RESULTS.where(ends & (y_error.locks > 0.0), diffrax.RESULTS.dt_min_reached, result)
        next_t0 = jnp.where(ends, next_t0, t0)
        next_t1, free = self._until_known(args, next_t0, next_t1, jnp.where(again, free, 0.0))
        either = lambda retry, otherwise: jax.tree.map(lambda a, b: jnp.where(again, a, b), retry, otherwise)
        return (
            ends,
            next_t0,
            next_t1,
            jump & jnp.logical_not(again),
            ControlState(either(before, after), jnp.where(again, retries + 1, jnp.where(keep, 0, retries)), free),
            result,
        )

    def _until_known(self, problem, t0, t1, free):
        """The end of a step, at the next known time of a law at most, and how long a free one would be."""
        if problem.times is None or not self.is_adaptive:
            return t1, free
        # One that rounding puts just ahead is where the step begins.
        beyond = t0 + SMALLEST_STEP_ULPS * jnp.finfo(t0.dtype).eps * jnp.abs(t0)
        index = jnp.searchsorted(problem.times, beyond, side="right")
        ahead = jnp.append(problem.times, jnp.inf)[index]
        return jnp.minimum(t1, ahead), jnp.where(t1 > ahead, jnp.maximum(free, t1 - t0), free)

    def _scaled_error(self, problem, y_error, turn, magnitude, candidate):
        """The error of q, v and internal states in their scales, with rounding taken off."""
        scales = problem.scales
        placement, floor = y_error.placement, problem.method.distance_floor
        # Where another try comes less close, that is what is to be tried. A singular configuration amplifies nothing,
        # as its rows count as dependent.
        nearest = jnp.maximum(placement.passes, jnp.minimum(placement.gains, problem.accuracy.clearance))
        nearest = jnp.where(y_error.leaves < floor, nearest, jnp.minimum(y_error.leaves, nearest))
        closest = jnp.minimum(y_error.leaves, placement.passes)
        noise = _noise(jnp.maximum(closest, floor), jnp.maximum(nearest, floor), turn)
        # The second is none where the step has led to no numbers.
        largest = jax.tree.map(lambda a, b: jnp.maximum(a, jnp.where(jnp.isfinite(b), b, 0.0)), magnitude, candidate)
        # An estimate that is rounding alone must not choose the next step: in a batch it would be another one.
        inner = self.innermost
        least = jnp.minimum(SEEN_ULPS * jnp.finfo(scales[0].dtype).eps, SEEN * inner.rtol)
        of_q, *others = (
            jnp.maximum(jnp.abs(_less(e / scale, noise * size)), least * size)
            for e, scale, size in zip(y_error.error, scales, largest, strict=True)
        )
        if y_error.opens is not None:
            of_q = jnp.maximum(of_q, y_error.opens / OPENS * (inner.rtol + inner.atol))
        return of_q, *others


def _magnitudes(problem, y):
    """The magnitudes that tolerances are relative to: one for coordinates, the largest speed for speeds, its own for
    each internal state.
    """
    (q, v), internal = problem.unpacked(y), problem.internal(y)
    fastest = jnp.broadcast_to(problem.system.fastest(v), v.shape)
    of_motion = jnp.where(jnp.all(jnp.isfinite(q)), jnp.ones_like(v), jnp.nan), fastest
    return of_motion if internal is None else (*of_motion, jnp.abs(internal / problem.scales[2]))


def _noise(closest, nearest, turn):
    """Relative rounding in a step that turns joints by so much [radians, lengths of the mechanism].

    It reaches coordinates multiplied by 1/d, however short the step, d the `closest` distance; accelerations and the
    direction of motion by 1/d², d the `nearest` that no placement avoids.
    """
    return NOISE_ULPS * jnp.finfo(closest.dtype).eps * (1.0 / closest + AMPLIFIED * turn / nearest**2)


def _less(error, noise):
    """Take the noise off an error."""
    return jnp.where(jnp.abs(error) > noise, error - jnp.sign(error) * noise, 0.0 * error)
