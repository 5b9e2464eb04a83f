"""Rigid motions, (..., 4, 4), as exponentials of screws, (..., 6).

A motion [[R, d], [0, 1]] takes a point p to R p + d; the columns of R are the rotated axes. A screw is a turn a
and an advance b, or the matrix [[â, b], [0, 0]] of both, where â p = a × p. All functions are smooth at every
argument, and made of few operations, since beams differentiate them several times.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.spatial.rotations import compose, transpose
from linkax.xla.arrays import Array

TERMS = 16  # enough for turns of π to rounding
# (1 − cos a) / a² and (a − sin a) / a³ as power series in a².
SERIES = np.array([[(-1.0) ** k / math.factorial(2 * k + 2 + i) for i in range(2)] for k in range(TERMS)])

LEVI_CIVITA = np.array([[[(i - j) * (j - k) * (k - i) / 2.0 for k in range(3)] for j in range(3)] for i in range(3)])
GENERATORS = np.zeros((6, 4, 4))
GENERATORS[:3, :3, :3] = -LEVI_CIVITA
GENERATORS[[3, 4, 5], [0, 1, 2], 3] = 1.0


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _series(order: int, x: Float[Array, "*batch"]) -> Float[jax.Array, "*batch 2"]:
    """Evaluate both series, or their derivatives of that order, (..., 2), in few operations whatever the order."""
    coefficients = np.zeros_like(SERIES)
    coefficients[: TERMS - order] = SERIES[order:]
    coefficients *= np.array([math.perm(k + order, order) for k in range(TERMS)])[:, None]
    powers, square = jnp.stack([jnp.ones_like(x), x], axis=-1), x
    while powers.shape[-1] < TERMS:
        square = square * square
        powers = jnp.concatenate([powers, square[..., None] * powers], axis=-1)
    return powers @ jnp.asarray(coefficients, x.dtype)


@_series.defjvp
def _series_jvp(order, primals, tangents):
    (x,), (change,) = primals, tangents
    return _series(order, x), _series(order + 1, x) * change[..., None]


def screw_matrix(screw: Float[Array, "*batch 6"]) -> Float[jax.Array, "*batch 4 4"]:
    """Write screws (..., 6) as matrices (..., 4, 4)."""
    return jnp.tensordot(screw, jnp.asarray(GENERATORS, screw.dtype), 1)


def exponential(screw: Float[Array, "*batch 4 4"]) -> Float[jax.Array, "*batch 4 4"]:
    """Move along a constant screw, given as its matrix S (..., 4, 4), by Rodrigues' formula.

    exp S = 1 + S + (1 − cos a) / a² S² + (a − sin a) / a³ S³, where a is the angle of its turn [rad].
    """
    square = compose(screw, screw)
    # The trace is −2 a².
    series = _series(0, -jnp.trace(square, axis1=-2, axis2=-1) / 2.0)[..., None, None]
    return (
        jnp.eye(4, dtype=screw.dtype)
        + screw
        + series[..., 0, :, :] * square
        + series[..., 1, :, :] * compose(square, screw)
    )


def turn_rate(change: Float[Array, "*#batch 3 3"], rotation: Float[Array, "*#batch 3 3"]) -> Float[jax.Array, "... 3"]:
    """Compute the angular velocity (..., 3) from a rotation R and its rate Ṙ: the antisymmetric part of Ṙ Rᵀ."""
    across = compose(change, transpose(rotation))
    return jnp.tensordot(across, jnp.asarray(np.swapaxes(LEVI_CIVITA, 0, 2) / 2.0, across.dtype), 2)
