"""Linear least squares between bounds, in `jax.numpy`."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import ArrayLike, Float

from linkax.xla.arrays import Array

TURNS = 3  # for each unknown, in which the best point is found


def least_squares_within(
    matrix: Float[Array, "k p"],
    residual: Float[Array, " k"],
    damping: ArrayLike,
    low: Float[Array, " p"],
    high: Float[Array, " p"],
) -> Float[Array, " p"]:
    """The x between `low` and `high`, around zero, that minimises |matrix x + residual|² + damping |x|².

    By active sets: on the way from zero to the best x, entries are held where they meet a bound, and one is let go
    where that lowers the sum (Stark and Parker, Bounded-variable least-squares: an algorithm and applications, 1995).
    """
    index = jnp.arange(len(low))

    def best(held, x):
        left, values, right = jnp.linalg.svd(jnp.where(held, 0.0, matrix), full_matrices=False)
        rest = left.T @ (residual + matrix @ jnp.where(held, x, 0.0))
        return jnp.where(held, x, -right.T @ (rest * values / (values**2 + damping)))

    def turn(found):
        x, held, _, count = found
        way = best(held, x) - x
        ends = jnp.where(way < 0.0, low, high)
        parts = jnp.where(held | (way == 0.0), jnp.inf, (ends - x) / way)
        part, met = jnp.min(parts), (index == jnp.argmin(parts)) & (jnp.min(parts) < 1.0)
        x = jnp.where(met, ends, x + jnp.minimum(part, 1.0) * way)
        slope = matrix.T @ (residual + matrix @ x) + damping * x
        inwards = jnp.where(held, jnp.where(x <= low, -slope, slope), 0.0)
        freed = (index == jnp.argmax(inwards)) & (inwards > 0.0) & (part >= 1.0)
        return x, (held | met) & ~freed, jnp.any(met | freed), count + 1

    begin = jnp.zeros_like(low), jnp.zeros(low.shape, bool), jnp.array(True), 0
    return lax.while_loop(lambda found: found[2] & (found[3] < TURNS * len(low)), turn, begin)[0]
