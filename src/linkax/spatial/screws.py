"""Rigid motions, (..., 4, 4), as exponentials of screws, (..., 6).

A motion [[R, d], [0, 1]] takes a point p to R p + d; the columns of R are the rotated axes. A screw is a turn a
and an advance b, which stand for the matrix [[â, b], [0, 0]], where â p = a × p. All functions are smooth at every
argument, and made of few operations, since beams differentiate them several times.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.spatial.rotations import compose, transpose
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array

TERMS = 16  # enough for turns of π to rounding
# (1 − cos a) / a² and (a − sin a) / a³ as power series in a².
SERIES = np.array([[(-1.0) ** k / math.factorial(2 * k + 2 + i) for i in range(2)] for k in range(TERMS)])

LEVI_CIVITA = np.array([[[(i - j) * (j - k) * (k - i) / 2.0 for k in range(3)] for j in range(3)] for i in range(3)])


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


def bracket(first: Float[Array, "*batch 6"], second: Float[Array, "*batch 6"]) -> Float[jax.Array, "*batch 6"]:
    """Compute the Lie bracket of screws, of their matrices X Y − Y X."""
    (turn, advance), (second_turn, second_advance) = (jnp.split(screw, 2, axis=-1) for screw in (first, second))
    along = cross(turn, second_advance) - cross(second_turn, advance)
    return jnp.concatenate([cross(turn, second_turn), along], axis=-1)


def exponential(screw: Float[Array, "*batch 6"]) -> Float[jax.Array, "*batch 4 4"]:
    """Move along a constant screw (..., 6), by Rodrigues' formula.

    R = cos a + (sin a) / a â + (1 − cos a) / a² a aᵀ and d = b + (1 − cos a) / a² a × b + (a − sin a) / a³ a × (a × b),
    where a is the turn, or its angle [rad].
    """
    turn, advance = jnp.split(screw, 2, axis=-1)
    square = dot(turn, turn)[..., None]
    first, second = jnp.split(_series(0, square[..., 0]), 2, axis=-1)
    across = cross(turn, advance)
    shift = advance + first * across + second * cross(turn, across)
    cosine = 1.0 - first * square
    sine_by_angle = 1.0 - second * square
    rotation = (
        cosine[..., None] * jnp.eye(3, dtype=screw.dtype)
        + sine_by_angle[..., None] * jnp.tensordot(turn, jnp.asarray(-LEVI_CIVITA, screw.dtype), 1)
        + first[..., None] * (turn[..., :, None] * turn[..., None, :])
    )
    moved = jnp.concatenate([rotation, shift[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 0.0, 1.0], screw.dtype), (*moved.shape[:-2], 1, 4))
    return jnp.concatenate([moved, last], axis=-2)


def turn_rate(change: Float[Array, "*#batch 3 3"], rotation: Float[Array, "*#batch 3 3"]) -> Float[jax.Array, "... 3"]:
    """Compute the angular velocity (..., 3) from a rotation R and its rate Ṙ: the antisymmetric part of Ṙ Rᵀ."""
    across = compose(change, transpose(rotation))
    return jnp.tensordot(across, jnp.asarray(np.swapaxes(LEVI_CIVITA, 0, 2) / 2.0, across.dtype), 2)
