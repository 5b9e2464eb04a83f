"""Functions of time through given values, which are numbers of a mechanism: controls to fit or to optimise."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Vector, number, real, require
from linkax.xla.arrays import Array


class _Piecewise(eqx.Module):
    """A polynomial of t − tᵢ between each two times tᵢ; before the first and after the last its end values."""

    times: Float[Array, " n"]
    coefficients: Float[Array, "k n_pieces *shape"]  # the highest power first

    def __call__(self, t: Any, *unused: Any) -> jax.Array:
        """Compute the value at time t [s]; what else a law is given, such as the motion, does not matter."""
        times = jnp.asarray(self.times)
        within = jnp.clip(t, times[0], times[-1])
        piece = jnp.clip(jnp.searchsorted(times, within, side="right") - 1, 0, len(times) - 2)
        return jnp.polyval(jnp.asarray(self.coefficients)[:, piece], within - times[piece])


def _times_and_values(times, values, kind, least):
    """Check times in rising order, (n,), and values for each, (n, ...)."""
    what = f"{kind}: times [s]"
    times = real(times, what)
    if times.ndim != 1 or len(times) < least:
        raise ValueError(f"{what} have shape {times.shape}; give a list of {least} or more")
    rising = lambda ts: (ts[1:] > ts[:-1]).all()
    times = require(number(times, times.shape, what), rising, what, "they must rise from each to the next")
    values = real(values, f"{kind}: values")
    if values.ndim < 1 or len(values) != len(times):
        raise ValueError(f"{kind}: values have shape {values.shape}; give one for each of the {len(times)} times")
    return times, number(values, values.shape, f"{kind}: values")


class PiecewiseLinear(_Piecewise):
    """A function of time, linear between given values: a voltage, a valve's opening, a torque.

    Give it wherever a law is taken but to a `linkax.Drive`, whose motion must be smooth, and which takes a
    `linkax.Spline`. Before the first time and after the last one it keeps its end values. Steps of a run that adapt end
    at its times, as at the `times` of any callable that has some.

    **Arguments:**

    - `times`: rising [s], (n,). `values`: at these, (n,), or (n, 3) for a vector. Both are numbers of the mechanism,
      with derivatives.

    **Raises:** `ValueError` for times that do not rise, and for values of another number.
    """

    def __init__(self, times: Vector, values: Any) -> None:
        self.times, values = _times_and_values(times, values, "PiecewiseLinear", 2)
        xp = _namespace(self.times, values)
        slopes = xp.diff(values, axis=0) / _across(xp.diff(self.times), values)
        self.coefficients = xp.stack([slopes, values[:-1]])


class Spline(_Piecewise):
    """A function of time by a cubic spline through given values, with a continuous second derivative: a drive's motion.

    Before the first time and after the last one it keeps its end values, which is smooth where `end_slopes` are zero,
    as they are by default. Steps of a run that adapt end at its times.

    **Arguments:**

    - `times`: rising [s], (n,). `values`: at these, (n,), or (n, 3) for a vector. `end_slopes`: derivatives by time at
      the first and the last one. All are numbers of the mechanism, with derivatives.

    de Boor (1978), A Practical Guide to Splines, ch. IV (the complete spline).

    **Raises:** `ValueError` for times that do not rise, for fewer than two, and for values of another number.
    """

    def __init__(self, times: Vector, values: Any, *, end_slopes: tuple[Any, Any] = (0.0, 0.0)) -> None:
        self.times, values = _times_and_values(times, values, "Spline", 2)
        ends = [_end_slope(slope, values.shape[1:]) for slope in end_slopes]
        xp = _namespace(self.times, values, *ends)
        widths = _across(xp.diff(self.times), values)
        chords = xp.diff(values, axis=0) / widths
        slopes = _slopes(xp, xp.diff(self.times), chords, *ends)
        bend = (slopes[:-1] + slopes[1:] - 2.0 * chords) / widths
        self.coefficients = xp.stack([bend / widths, (chords - slopes[:-1]) / widths - bend, slopes[:-1], values[:-1]])


def _end_slope(entry, shape):
    what = "Spline: an end slope"
    entry = real(entry, what)
    return number(np.zeros(shape) + entry, shape, what)


def _namespace(*arrays):
    """NumPy for arrays that are NumPy's all, as constants of a model are, so that nothing compiles; else jax.numpy."""
    return np if all(isinstance(array, np.ndarray) for array in arrays) else jnp


def _across(widths, values):
    return widths.reshape(-1, *(1,) * (values.ndim - 1))


def _slopes(xp, widths, chords, first, last):
    """Slopes at all times that make the second derivative continuous, (n, ...)."""
    # SciPy's splines need known times; these may be traced, such as the duration of a motion.
    before, after, zero, one = widths[:-1], widths[1:], xp.zeros(1), xp.ones(1)
    diagonals = [after, zero], [one, 2.0 * (before + after), one], [zero, before]
    matrix = sum(xp.diag(xp.concatenate(parts), offset) for parts, offset in zip(diagonals, (-1, 0, 1), strict=True))
    inner = 3.0 * (_across(after, chords) * chords[:-1] + _across(before, chords) * chords[1:])
    right = xp.concatenate([first[None], inner, last[None]])
    return xp.linalg.solve(matrix, right.reshape(len(right), -1)).reshape(right.shape)
