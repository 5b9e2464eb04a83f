"""Values at a state close to a singular configuration, as limits along the motion.

At a distance d from a singular configuration rounding reaches accelerations multiplied by 1/d², and a gap of the loops
by 1/d. Yet on a branch of the motion positions, speeds and accelerations are smooth through the passage. So close to it
they are interpolated between states before and behind it, where nothing is amplified:
f(0) ≈ Σ wₖ (f(kh) + f(−kh)), with Lagrange's weights w = (56, −28, 8, −1) / 70 for k = 1, …, 4.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, PyTree

from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import ratio
from linkax.xla.primitives import bounded_while_loop

NEAR = 3e-3  # distance d below which values are limits
REACH = 0.02  # between neighbouring states, radians or lengths of the mechanism
CLOSED = 1e-12  # what an interpolated state may be off the loops, radians or lengths of the loop
SMOOTH = 1e-6  # what the interpolations of order six and eight may differ, relative
ALIKE = 1e-2  # the same of extrapolations from the two sides: what grows without bound cancels in the others

# Lagrange's weights at zero: of eight states, of these less those of the inner six, and of the four before less
# those of the four behind. The first trip is the state itself, the last one the interpolated state.
PLACES = np.array([0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0, 0.0])
EIGHT = np.array([0.0, 56.0, 56.0, -28.0, -28.0, 8.0, 8.0, -1.0, -1.0, 0.0]) / 70.0
SIX = np.array([0.0, 15.0, 15.0, -6.0, -6.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 20.0
SIDES = np.array([0.0, 4.0, -4.0, -6.0, 6.0, 4.0, -4.0, -1.0, 1.0, 0.0])
WEIGHTS = np.stack([EIGHT, EIGHT - SIX, SIDES])
TOLERANCES = np.array([SMOOTH, ALIKE])
LAST = len(PLACES) - 1


class Value(NamedTuple):
    """A function of the coordinates at one state.

    - `answers`: a tuple of arrays, first the coordinates on the loops.
    - `distance`: d, from the nearest singular configuration.
    - `gap`: how far the loops were open before they were closed.
    """

    answers: Any
    distance: Float[Array, ""]
    gap: Float[Array, ""]


class _Trip(NamedTuple):
    count: Array
    itself: Any
    sums: Any
    distance: Array
    gap: Array


class Direction(NamedTuple):
    """A state, and how to step from it along the motion.

    - `t` [s]; `q`, (n_q,); `v`, (n_v,). `fastest`: the largest speed, in radians and lengths
      of the mechanism.
    - `retract`: (q, change (n_v,)) ↦ q.
    - `advances`: whether time goes on with the motion, as it must where drives prescribe it.
    """

    t: ScalarLike
    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    fastest: Float[Array, ""]
    retract: Callable[[Array, Array], Array]
    advances: bool


def singular_limit(
    function: Callable[[Any, Any, Array], Value], powers: tuple[int, ...], arguments: PyTree, direction: Direction
) -> tuple[Any, Float[Array, ""]]:
    """Evaluate a function of the coordinates, close to a singular configuration as a limit along v.

    Costs one evaluation where d ≥ NEAR, and ten where it is smaller. One loop serves both, so
    that the function is compiled once, and a batch pays for the limit only where a member needs
    it. Where the interpolated state does not close the loops (lengths slightly unlike, which
    unfold the passage), or the values are not smooth, the value at the state itself stands.

    **Arguments:**

    - `function`: (arguments, t, q) ↦ `Value`; a function of the module, not a closure.
    - `powers`: of a speed that each answer is of the order of: 0 for coordinates, 1 for speeds, 2 for accelerations.

    **Returns:** the answers, and d at the state itself. Differentiable in both modes.
    """
    t, q, v = direction.t, direction.q, direction.v
    fastest = direction.fastest
    # Where the neighbours lie has no influence on the limit, so it needs no derivative.
    duration = lax.stop_gradient(ratio(REACH, fastest, 0.0))
    stride = lax.stop_gradient(v) * duration
    places, weights = jnp.asarray(PLACES, q.dtype), jnp.asarray(WEIGHTS, q.dtype)

    def unfinished(trip):
        return (trip.count == 0) | ((trip.distance < NEAR) & (trip.count <= LAST))

    def body(trip):
        first = trip.count == 0
        place = places[trip.count]
        at = jnp.where(trip.count == LAST, trip.sums[0][0], direction.retract(q, place * stride))
        value = function(arguments, t + place * duration if direction.advances else t, at)
        weight = weights[:, trip.count]
        # What is no number at a state itself is not to spoil the limit.
        counts = jnp.any(weight != 0.0)
        add = lambda total, answer: total + jnp.multiply.outer(weight, jnp.where(counts, answer, 0.0))
        return _Trip(
            trip.count + 1,
            jax.tree.map(lambda answer, itself: jnp.where(first, answer, itself), value.answers, trip.itself),
            jax.tree.map(add, trip.sums, value.answers),
            jnp.where(first, value.distance, trip.distance),
            value.gap,
        )

    shapes = jax.eval_shape(lambda q: function(arguments, t, q).answers, q)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    pairs = jax.tree.map(lambda leaf: jnp.zeros((len(WEIGHTS), *leaf.shape), leaf.dtype), shapes)
    one = jnp.ones((), q.dtype)
    start = _Trip(jnp.zeros((), int), zeros, pairs, one, one)
    trip = bounded_while_loop(unfinished, body, start, max_steps=LAST + 1)
    holds = (trip.distance < NEAR) & (trip.gap < CLOSED) & _is_smooth(trip.sums, powers, fastest)
    answers = jax.tree.map(lambda pair, itself: jnp.where(holds, pair[0], itself), trip.sums, trip.itself)
    return answers, trip.distance


def _is_smooth(sums, powers, fastest):
    """Whether high differences of the values are small: of each answer first the limit, then its differences."""
    scales = [largest(pair[0]) + fastest**power for pair, power in zip(sums, powers, strict=True)]
    smooth = [
        largest(differences) <= tolerance * scale
        for pair, scale in zip(sums, scales, strict=True)
        for differences, tolerance in zip(pair[1:], TOLERANCES, strict=True)
    ]
    return jnp.all(jnp.stack(smooth))
