"""The method of Levenberg and Marquardt, built on optimistix, with damping that does not depend on units."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import optimistix as optx
from jax import lax
from jaxtyping import Array, Bool, Float

from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.studies.parameters.uncertainty import NO_INFLUENCE

FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-12
HIGHER, LOWER = 2.0, 5.0
ENOUGH = 0.25  # gain of a step, relative to the predicted one, above which the next is damped less
NOTHING = 1e-2  # gain that is not worth a step, relative to rtol


class DescentState(NamedTuple):
    """What steps from one place are computed from, in units of `sizes`.

    - `matrix`, `rest`: of fewer rows than the Jacobian and the residual, with the same products.
    - `low`, `high`: least and largest step. `largest`: norms so far of the columns of the Jacobian.
    """

    matrix: Float[Array, "k p"]
    rest: Float[Array, " k"]
    sizes: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    largest: Float[Array, " p"]


# The state of `_DelayedDamping`.
SearchState = tuple[Float[Array, ""], Bool[Array, ""]]


class _ScaledDescent(optx.AbstractDescent):
    """Steps −(Jᵀ J + λ D²)⁻¹ Jᵀ r, with λ one over the step size, D the largest norms so far of the columns of J.

    optimistix damps by λ alone, which is too much for parameters and residuals of some magnitudes, and nothing for
    others. (Moré, The Levenberg-Marquardt algorithm, 1978, section 6, says why D must not fall.)

    Where a step would leave the room that there is, it ends there for the parameter that is furthest out, and is the
    best one for the others, until all are within.
    """

    free: FreeParameters

    def init(self, y: Float[Array, " p"], f_info_struct: Any) -> DescentState:
        none = jnp.zeros(min(len(y), f_info_struct.residual.shape[0]), y.dtype)
        return DescentState(jnp.outer(none, y), none, *4 * (jnp.zeros_like(y),))

    def query(self, y: Float[Array, " p"], f_info: Any, state: DescentState) -> DescentState:
        slopes = f_info.jac.as_matrix()
        norms = jnp.linalg.norm(slopes, axis=0)
        # Those of logarithms fall with the parameter.
        largest = jnp.where(jnp.isfinite(self.free.longest), norms, jnp.maximum(state.largest, norms))
        # Parameters without influence, whose slopes are rounding, stay as they are.
        matters = largest > NO_INFLUENCE * jnp.max(largest)
        sizes = jnp.where(matters, largest, 1.0)
        left, values, right = jnp.linalg.svd(jnp.where(matters, slopes / sizes, 0.0), full_matrices=False)
        low, high = map(jnp.asarray, self.free.room(y))
        found = values[:, None] * right, left.T @ f_info.residual, sizes, low * sizes, high * sizes
        return DescentState(*found, largest)

    def step(self, step_size: Float[Array, ""], state: DescentState) -> tuple[Float[Array, " p"], optx.RESULTS]:
        def best(held, step):
            left, values, right = jnp.linalg.svd(jnp.where(held, 0.0, state.matrix), full_matrices=False)
            rest = left.T @ (state.rest + state.matrix @ jnp.where(held, step, 0.0))
            return jnp.where(held, step, -right.T @ (rest * values / (values**2 + 1.0 / step_size)))

        def overshoot(step):
            """How much too long the step is for each parameter."""
            return jnp.maximum(step - state.high, state.low - step) / state.sizes

        def within(found):
            held, step = found
            held = held | (jnp.arange(len(step)) == jnp.argmax(jnp.where(held, 0.0, overshoot(step))))
            return held, best(held, jnp.clip(step, state.low, state.high))

        none = jnp.zeros(state.low.shape, bool)
        begin = none, best(none, jnp.zeros_like(state.low))
        _, step = lax.while_loop(lambda found: jnp.any(~found[0] & (overshoot(found[1]) > 0.0)), within, begin)
        return step / state.sizes, optx.RESULTS.successful


class _DelayedDamping(optx.AbstractSearch):
    """λ that rises slowly where a step fails, and falls quickly where one succeeds.

    Along a narrow valley, where long steps fail, this takes the fewest steps (Transtrum, Sethna, Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization, 2012).

    The state is λ, and whether no further step can gain more than `rtol` of the loss.

    A step that has to end early for want of `room` tells nothing of those that follow: where an exponential is small,
    a rising one gains little.
    """

    rtol: int | float
    free: FreeParameters

    def init(self, y: Float[Array, " p"], f_info_struct: Any) -> SearchState:
        return jnp.asarray(FIRST_DAMPING, y.dtype), jnp.zeros((), bool)

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Float[Array, " p"],
        y_eval: Float[Array, " p"],
        f_info: Any,
        f_eval_info: Any,
        state: SearchState,
    ) -> tuple[Float[Array, ""], Bool[Array, ""], optx.RESULTS, SearchState]:
        damping, _ = state
        before, after = f_info.as_min(), f_eval_info.as_min()
        expected = -optx.ClassicalTrustRegion().predict_reduction(y_eval - y, f_info)
        gained = before - after
        accept = first_step | (gained > 0.0)
        less = jnp.where(gained > ENOUGH * expected, damping / LOWER, damping)
        changed = jnp.where(accept, less, damping * HIGHER)
        # A step that fails although little was expected shows the noise of the function.
        enough = jnp.where(gained > 0.0, NOTHING * self.rtol, self.rtol)
        cut = jnp.any(y_eval - y > 0.5 * self.free.longest)
        idle = jnp.logical_not(first_step | cut) & (jnp.abs(expected) <= enough * before)
        damping = jnp.maximum(jnp.where(first_step, damping, changed), LEAST_DAMPING)
        return 1.0 / damping, accept, optx.RESULTS.successful, (damping, idle)


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """`optimistix.LevenbergMarquardt` with another damping, another rule to change it, and another end.

    - `rtol`, `atol`: changes of parameters and residual at which it ends. Where steps fail, it also ends once the
      predicted gain is below `rtol` times the loss.
    - `free`: the parameters that it steps in.
    """

    rtol: int | float
    atol: int | float
    norm: Callable
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable

    def __init__(self, rtol: int | float, atol: int | float, free: FreeParameters) -> None:
        self.rtol, self.atol = rtol, atol
        self.norm, self.verbose = optx.max_norm, _silent
        self.descent, self.search = _ScaledDescent(free), _DelayedDamping(rtol, free)

    def terminate(
        self, fn: Callable, y: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        done, result = super().terminate(fn, y, args, options, state, tags)
        return done | state.search_state[1], result


def _silent(**values):
    pass
