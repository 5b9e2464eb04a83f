"""The method of Levenberg and Marquardt, built on optimistix, whose steps and whose end do not depend on units."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import ArrayLike, Bool, Float, Int

from linkax.studies.fits.bounded_least_squares import least_squares_within
from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.studies.parameters.uncertainty import NO_INFLUENCE
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline

FIRST_DAMPING = 1e-2
LEAST_DAMPING = 1e-12
HIGHER, LOWER = 2.0, 5.0
SLOWLY, FASTEST = 2, 6  # steps that fail before the damping rises ever faster, and the highest power of HIGHER
ENOUGH = 0.25  # gain of a step, relative to the predicted one, above which the next is damped less
EXACT = 1e-11  # change of a free number, relative to its magnitude, that is rounding
ROUNDING = 1e-13  # of the residual, relative to its largest change where free numbers double
FALLEN = 1e-3  # sensitivity, relative to its largest so far, from which on slopes tell of no long way


class LinearModel(NamedTuple):
    """The residual near some z, as a linear function of the step from there.

    - `slopes`, `residual`: of fewer rows than the Jacobian and the residual, with the same products.
    - `sizes`: units of the free numbers, as one over each. `low`, `high`: least and largest step.
    - `magnitudes`: of the free numbers, which a change of them is small or large against.
    """

    slopes: Float[Array, "k p"]
    residual: Float[Array, " k"]
    sizes: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    magnitudes: Float[Array, " p"]

    @staticmethod
    @jit_inline
    def at(
        z: Float[Array, " p"], residual: Float[Array, " n"], slopes: Float[Array, "n p"], free: FreeParameters
    ) -> "LinearModel":
        """With the norms of the columns of the Jacobian as `sizes`."""
        turn, triangle = jnp.linalg.qr(slopes)
        low, high = map(jnp.asarray, free.room(z))
        sizes, magnitudes = jnp.linalg.norm(triangle, axis=0), free.magnitudes(jnp.asarray(z))
        return LinearModel(triangle, turn.T @ residual, sizes, low, high, magnitudes)

    def step(self, damping: ArrayLike) -> Float[Array, " p"]:
        """−(Jᵀ J + λ D²)⁻¹ Jᵀ r, with λ the damping and D the `sizes`; within the room, the best step there is."""
        # Parameters without influence, whose slopes are rounding, stay as they are.
        matters = self.sizes > NO_INFLUENCE * jnp.max(self.sizes)
        sizes = jnp.where(matters, self.sizes, 1.0)
        matrix = jnp.where(matters, self.slopes / sizes, 0.0)
        return least_squares_within(matrix, self.residual, damping, self.low * sizes, self.high * sizes) / sizes

    @eqx.filter_jit
    def undamped(self, reach: ArrayLike = np.inf) -> tuple[Float[Array, " p"], Float[Array, ""]]:
        """The step that should gain most, no longer than `reach`, and by how much it should lower the loss.

        The units are those of the slopes here: those of a place before may be so much larger that they damp it.
        """
        low, high = jnp.maximum(self.low, -jnp.asarray(reach)), jnp.minimum(self.high, reach)
        here = self._replace(sizes=jnp.linalg.norm(self.slopes, axis=0), low=low, high=high)
        step = here.step(LEAST_DAMPING)
        left = self.residual + self.slopes @ step
        return step, 0.5 * (self.residual @ self.residual - left @ left)

    @jit_inline
    def rounding(self) -> Float[Array, ""]:
        """The loss that rounding may leave of data without noise."""
        return 0.5 * (ROUNDING * jnp.max(jnp.linalg.norm(self.slopes, axis=0) * self.magnitudes)) ** 2


class _ScaledDescent(optx.AbstractDescent):
    """Steps of the `LinearModel`, with the largest norms so far of the columns of the Jacobian as `sizes`.

    optimistix damps by λ alone, which is too much for parameters and residuals of some magnitudes, and nothing for
    others. (Moré, The Levenberg-Marquardt algorithm, 1978, section 6, says why D must not fall.)
    """

    free: FreeParameters

    def init(self, y: Float[Array, " p"], f_info_struct: Any) -> LinearModel:
        none = jnp.zeros(min(len(y), f_info_struct.residual.shape[0]), y.dtype)
        return LinearModel(jnp.outer(none, jnp.asarray(y)), none, *4 * (jnp.zeros_like(y),))

    def query(self, y: Float[Array, " p"], f_info: Any, state: LinearModel) -> LinearModel:
        found = LinearModel.at(y, f_info.residual, f_info.jac.as_matrix(), self.free)
        # They rise no faster than λ falls: after a leap to where slopes are a million times as large, a damping
        # that was right for the leap would allow no step. Those of logarithms fall with the parameter.
        risen = jnp.where(state.sizes > 0.0, jnp.minimum(found.sizes, LOWER**0.5 * state.sizes), found.sizes)
        largest = jnp.where(jnp.isfinite(self.free.longest), found.sizes, jnp.maximum(state.sizes, risen))
        return found._replace(sizes=largest)

    def step(self, step_size: Float[Array, ""], state: LinearModel) -> tuple[Float[Array, " p"], optx.RESULTS]:
        # The least damping is that of the slopes here, or a start far away would damp for ever.
        damping = 1.0 / step_size
        sizes = jnp.where(damping < HIGHER * LEAST_DAMPING, jnp.linalg.norm(state.slopes, axis=0), state.sizes)
        return state._replace(sizes=sizes).step(damping), optx.RESULTS.successful


class SearchState(NamedTuple):
    """State of `_DelayedDamping`.

    - `damping`: λ.
    - `failures`: number of steps that have failed since one did not. `rough`: whether one did since the function is so.
    """

    damping: Float[Array, ""]
    failures: Int[Array, ""]
    rough: Bool[Array, ""]


class _DelayedDamping(optx.AbstractSearch):
    """λ that rises slowly where a step fails, unless many do, and falls quickly where one succeeds.

    Along a narrow valley, where long steps fail, this takes the fewest steps (Transtrum, Sethna, Improvements to the
    Levenberg-Marquardt algorithm for nonlinear least-squares minimization, 2012).
    """

    rtol: int | float
    free: FreeParameters

    def init(self, y: Float[Array, " p"], f_info_struct: Any) -> SearchState:
        return SearchState(jnp.asarray(FIRST_DAMPING, y.dtype), jnp.array(0), jnp.array(False))

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Float[Array, " p"],
        y_eval: Float[Array, " p"],
        f_info: Any,
        f_eval_info: Any,
        state: SearchState,
    ) -> tuple[Float[Array, ""], Bool[Array, ""], optx.RESULTS, SearchState]:
        before, after = f_info.as_min(), f_eval_info.as_min()
        expected = -optx.ClassicalTrustRegion().predict_reduction(y_eval - y, f_info)
        gained = before - after
        accept = first_step | (gained > 0.0)
        less = jnp.where(gained > ENOUGH * expected, state.damping / LOWER, state.damping)
        changed = jnp.where(accept, less, state.damping * HIGHER ** jnp.clip(state.failures - SLOWLY, 1, FASTEST))
        damping = jnp.maximum(jnp.where(first_step, state.damping, changed), LEAST_DAMPING)
        # A step that fails is the function's roughness where it is but rounding, or where little was expected, and no
        # more was lost, unless it led to where the function is not finite.
        little = self.rtol * before
        is_exact = jnp.all(jnp.abs(y_eval - y) <= EXACT * self.free.magnitudes(y))
        rough = ((jnp.abs(expected) <= little) & ~(gained < -little)) | is_exact
        found = SearchState(damping, jnp.where(accept, 0, state.failures + 1), ~accept & rough)
        return 1.0 / damping, accept, optx.RESULTS.successful, found


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """`optimistix.LevenbergMarquardt` with another damping, another rule to change it, and another end.

    It ends where the part of the residual that an undamped step should take away is small (Bates and Watts, A relative
    offset convergence criterion for nonlinear least squares, 1981), and where steps fail since the function is rough.
    Short steps and small gains of damped ones are no sign of a minimum, and residuals have no unit to be small in.

    - `rtol`: size of that part, relative to the residual; after a step that failed, its gain, relative to the loss.
    - `free`: the parameters that it steps in.
    """

    rtol: int | float
    atol: int | float
    norm: Callable
    descent: optx.AbstractDescent
    search: _DelayedDamping
    verbose: Callable

    def __init__(self, rtol: int | float, free: FreeParameters) -> None:
        self.rtol = self.atol = rtol
        self.norm, self.verbose = optx.max_norm, _silent
        self.descent, self.search = _ScaledDescent(free), _DelayedDamping(rtol, free)

    def terminate(
        self, fn: Callable, y: Any, args: Any, options: dict[str, Any], state: Any, tags: frozenset
    ) -> tuple[Bool[Array, ""], optx.RESULTS]:
        model, found, loss = state.descent_state, state.search_state, state.f_info.as_min()
        # Towards the zero of a parameter that enters by its square slopes vanish, and ask for ever longer steps; there
        # they fall as the way to the zero does.
        left = jnp.linalg.norm(model.slopes, axis=0) / jnp.maximum(model.sizes, jnp.finfo(loss.dtype).tiny)
        step, gain = model.undamped(jnp.where(left < FALLEN, left, jnp.inf))
        # A step that has to end early tells nothing of those that follow: where an exponential is small, a rising one
        # gains little.
        cut = jnp.any(step > 0.5 * self.search.free.longest)
        idle = (gain <= jnp.where(found.failures > 0, self.rtol, self.rtol**2) * loss) & ~cut
        exact = (loss <= model.rounding()) | jnp.all(jnp.abs(step) <= jnp.finfo(step.dtype).eps * model.magnitudes)
        return idle | exact | found.rough, optx.RESULTS.successful


def _silent(**values):
    pass
