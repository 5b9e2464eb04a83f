"""The method of Levenberg and Marquardt, built on optimistix, with damping that does not depend on units."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from linkax.studies.parameters.uncertainty import NO_INFLUENCE

FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-12
HIGHER, LOWER = 2.0, 5.0
ENOUGH = 0.25  # gain of a step, relative to the predicted one, above which the next is damped less
NOTHING = 1e-2  # gain that is not worth a step, relative to rtol

# The states of `_ScaledDescent` and `_DelayedDamping`.
DescentState = tuple[Float[Array, "k p"], Float[Array, " k"], Float[Array, " k"], Float[Array, " p"]]
SearchState = tuple[Float[Array, ""], Bool[Array, ""]]


class _ScaledDescent(optx.AbstractDescent):
    """Steps −(Jᵀ J + λ D²)⁻¹ Jᵀ r, with λ one over the step size, D the largest norms so far of the columns of J.

    optimistix damps by λ alone, which is too much for parameters and residuals of some magnitudes, and nothing for
    others. (Moré, The Levenberg-Marquardt algorithm, 1978, section 6, says why D must not fall.)
    """

    def init(self, y: Float[Array, " p"], f_info_struct: Any) -> DescentState:
        none = jnp.zeros(min(len(y), f_info_struct.residual.shape[0]), y.dtype)
        return jnp.outer(none, y), none, none, jnp.zeros_like(y)

    def query(self, y: Float[Array, " p"], f_info: Any, state: DescentState) -> DescentState:
        slopes = f_info.jac.as_matrix()
        largest = jnp.maximum(state[-1], jnp.linalg.norm(slopes, axis=0))
        # Parameters without influence, whose slopes are rounding, stay as they are.
        matters = largest > NO_INFLUENCE * jnp.max(largest)
        sizes = jnp.where(matters, largest, 1.0)
        left, values, right = jnp.linalg.svd(jnp.where(matters, slopes / sizes, 0.0), full_matrices=False)
        return right / sizes, left.T @ f_info.residual, values, largest

    def step(self, step_size: Float[Array, ""], state: DescentState) -> tuple[Float[Array, " p"], optx.RESULTS]:
        right, residual, values, _ = state
        return -right.T @ (residual * values / (values**2 + 1.0 / step_size)), optx.RESULTS.successful


class _DelayedDamping(optx.AbstractSearch):
    """λ that rises slowly where a step fails, and falls quickly where one succeeds.

    Along a narrow valley, where long steps fail, this takes the fewest steps (Transtrum, Sethna, Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization, 2012).

    The state is λ, and whether no further step can gain more than `rtol` of the loss.
    """

    rtol: int | float

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
        idle = jnp.logical_not(first_step) & (expected <= enough * before)
        damping = jnp.maximum(jnp.where(first_step, damping, changed), LEAST_DAMPING)
        return 1.0 / damping, accept, optx.RESULTS.successful, (damping, idle)


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """`optimistix.LevenbergMarquardt` with another damping, another rule to change it, and another end.

    - `rtol`, `atol`: changes of parameters and residual at which it ends. Where steps fail, it also ends once the
      predicted gain is below `rtol` times the loss.
    """

    rtol: int | float
    atol: int | float
    norm: Callable
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable

    def __init__(self, rtol: int | float, atol: int | float) -> None:
        self.rtol, self.atol = rtol, atol
        self.norm, self.verbose = optx.max_norm, _silent
        self.descent, self.search = _ScaledDescent(), _DelayedDamping(rtol)

    def terminate(
        self, fn: Callable, y: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        done, result = super().terminate(fn, y, args, options, state, tags)
        return done | state.search_state[1], result


def _silent(**values):
    pass
