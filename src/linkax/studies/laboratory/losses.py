"""What a residual costs: its square, or less where it may be an outlier."""

from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.xla.arrays import Array

Loss = Literal["squares", "huber", "cauchy"]
LOSSES = get_args(Loss)
# Residuals in units of the noise from which they count less: where errors are normal, estimates are as sure as a share
# of the measurements, EFFICIENCY, makes those of least squares.
FROM = {"huber": 1.345, "cauchy": 2.385}
EFFICIENCY = {"squares": 1.0, "huber": 0.95, "cauchy": 0.95}
NORMAL = 1.4826  # standard deviation of a normal error, over the median of its magnitude
SMALL = 1e-4


def as_square(loss: Loss, u: Float[Array, "..."]) -> Float[Array, "..."]:
    """A smooth, rising function of a residual u, in units of the noise, half whose square is the loss of u.

    Of Huber's loss, with c: u, and beyond c ±√(2 c |u| − c²); of Cauchy's ±c √(log(1 + (u/c)²)).
    """
    if loss == "squares":
        return u
    c = FROM[loss]
    if loss == "huber":
        beyond = jnp.abs(u) > c
        size = jnp.where(beyond, jnp.abs(u), c)
        return jnp.where(beyond, jnp.sign(u) * jnp.sqrt(2.0 * c * size - c**2), u)
    x = (u / c) ** 2
    # The series where rounding and a square root of zero would spoil the derivative.
    big = jnp.where(x > SMALL, x, 1.0)
    return u * jnp.where(x > SMALL, jnp.sqrt(jnp.log1p(big) / big), 1.0 - x / 4.0 + 13.0 * x**2 / 96.0)


class Influence(NamedTuple):
    """Derivatives by u of `as_square`, of the loss, and the second one of the loss."""

    of_square: Float[np.ndarray, "..."]
    first: Float[np.ndarray, "..."]
    second: Float[np.ndarray, "..."]


def influence(loss: Loss, u: Float[np.ndarray, " n"]) -> Influence:
    """How much residuals u, in units of the noise, count."""
    slope = np.asarray(jax.vmap(jax.grad(lambda u: as_square(loss, u)))(jnp.asarray(u)))
    if loss == "huber":
        c = FROM[loss]
        return Influence(slope, np.clip(u, -c, c), (np.abs(u) <= c).astype(float))
    if loss == "cauchy":
        x = (u / FROM[loss]) ** 2
        return Influence(slope, u / (1.0 + x), (1.0 - x) / (1.0 + x) ** 2)
    return Influence(slope, u, np.ones_like(u))


def spread(loss: Loss, errors: Float[np.ndarray, " n"]) -> float:
    """The standard deviation of errors of mean zero; that of most of them, where there may be outliers."""
    return float(np.sqrt(np.mean(errors**2)) if loss == "squares" else NORMAL * np.median(np.abs(errors)))
