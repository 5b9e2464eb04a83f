"""Smooth curves through given values: in space, and around a turn."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Matrix, Vector, is_finite, number, real, require, require_bool
from linkax.xla.arrays import Array
from linkax.xla.tracing import concrete

DEGREE = 5  # with four continuous derivatives, where the motion needs two


class _Spline(eqx.Module):
    """Polynomials of degree five of a parameter u, piece by piece; beyond the ends as there, or repeated."""

    coefficients: Float[Array, "6 pieces dimensions"]  # the highest power first
    breaks: tuple[float, ...] = eqx.field(static=True)
    period: float | None = eqx.field(static=True)

    def _through(self, values: Float[Array, "n dimensions"], parameters: np.ndarray, periodic: bool) -> None:
        """Set the fields: coefficients are linear in the values, and SciPy finds the matrix."""
        from scipy.interpolate import make_interp_spline

        each = np.eye(len(values))
        each = np.concatenate([each, each[:1]]) if periodic else each
        spline = make_interp_spline(parameters, each, k=DEGREE, bc_type="periodic" if periodic else None)
        breaks = np.unique(np.clip(spline.t, parameters[0], parameters[-1]))[:-1]
        powers = [spline.derivative(m)(breaks) / math.factorial(m) for m in reversed(range(DEGREE + 1))]
        self.coefficients = jnp.asarray(np.stack(powers)) @ values
        self.breaks, self.period = tuple(breaks.tolist()), float(parameters[-1]) if periodic else None

    def _at(self, u: Any) -> Float[jax.Array, " dimensions"]:
        u = jnp.asarray(u) if self.period is None else jnp.mod(u, self.period)
        breaks = jnp.asarray(np.array(self.breaks), u.dtype)
        piece = jnp.sum(u >= breaks[1:])
        return jnp.polyval(jnp.asarray(self.coefficients, u.dtype)[:, piece], u - breaks[piece])


class SplineCurve(_Spline):
    """A smooth curve through points in space: a function of a parameter u [m] near its arc length.

    u counts straight distances from point to point, from zero at the first. Between points the curve is a polynomial of
    degree five, with four continuous derivatives. An open curve goes on beyond its ends as its first and last pieces
    do; a closed one repeats.

    **Arguments:**

    - `points`: [m], (n, 3), or (n, 2) in the plane z = 0. Numbers of the mechanism, with derivatives.
    - `closed`: whether the last point leads back to the first, which is not repeated.
    - `parameters`: u at the points, (n,), and of a closed curve once more at the first, (n + 1,); rising from zero.
      They are structure. Left out, they follow from the points, which must be known then.

    **Raises:** `ValueError` for fewer than six points, two equal ones in a row, and parameters that do not rise.
    """

    parameters: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, points: Matrix, closed: bool = False, parameters: Vector | None = None) -> None:
        closed, points = require_bool(closed, "curve: closed"), real(points, "curve: points [m]")
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) <= DEGREE:
            raise ValueError(f"curve: points have shape {points.shape}; give {DEGREE + 1} or more, (n, 3) or (n, 2)")
        points = number(points, points.shape, "curve: points [m]")
        points = jnp.pad(jnp.asarray(points), ((0, 0), (0, 3 - points.shape[1])))
        given = _distances(points, closed) if parameters is None else np.asarray(real(parameters, "curve: parameters"))
        if given.shape != (len(points) + closed,):
            raise ValueError(f"curve: parameters have shape {given.shape}; give {len(points) + closed}")
        rises = lambda u: is_finite(u) & (u[0] == 0.0) & (u[1:] > u[:-1]).all()
        require(given, rises, "curve: parameters [m]", "they must rise from zero, without equal points in a row")
        self.parameters = tuple(given.tolist())
        self._through(points, given, closed)

    def __call__(self, u: Any) -> Float[jax.Array, "3"]:
        """Compute the position at u [m], (3,)."""
        return self._at(u)


class PeriodicSpline(_Spline):
    """A smooth function of an angle that repeats with each turn, such as the profile of a cam.

    Between the values it is a polynomial of degree five, with four continuous derivatives.

    **Arguments:** `values`: at angles 2π i / n, (n,). Numbers of the mechanism, with derivatives.

    **Raises:** `ValueError` for fewer than six values.
    """

    def __init__(self, values: Vector) -> None:
        values = real(values, "periodic spline: values")
        if values.ndim != 1 or len(values) <= DEGREE:
            raise ValueError(f"periodic spline: values have shape {values.shape}; give {DEGREE + 1} or more, (n,)")
        values = number(values, values.shape, "periodic spline: values")
        self._through(jnp.asarray(values)[:, None], np.linspace(0.0, 2.0 * np.pi, len(values) + 1), True)

    def __call__(self, angle: Any) -> Float[jax.Array, ""]:
        """Compute the value at an angle [rad]."""
        return self._at(angle)[0]


def _distances(points, closed):
    """Straight distances along points, from zero."""
    known = concrete(points)
    if known is None:
        raise ValueError("curve: points are traced; give their parameters too, such as straight distances along them")
    along = np.concatenate([known, known[:1]]) if closed else np.asarray(known)
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(along, axis=0), axis=1))])
