"""Where the stages of a step fall next to a singular configuration, and how to keep them away from it.

Rounding reaches the accelerations of a stage multiplied by 1/d², d its distance from the singular configuration. A step
of full length that goes through has room for the passage between two of its stages; a step that begins close to it has
not, nor has any that follows, as each may come closer still. So a step is placed before it comes close: it ends where
the next one has room.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

GROWTH = 2.0  # of a step after one that was cut, whose error is rounding alone
BETTER = 2.0  # times as far from the singular configuration: what is worth another try
LOCKED = (
    7e-3  # distance from a singular configuration below which a driven motion may lock: d² is straight to 2e-2 there
)
STRAIGHT = 0.1  # of one: how far the ratios of a motion that locks may be off
FALLS = 0.9  # the most that is left of d after a step that tells a motion that locks from one that stays beside


class Placement(NamedTuple):
    """How close a step comes to a singular configuration, and a change of its length that keeps it farther away.

    - `passes`: the smallest distance d at a stage after the first. `follows`: the same of the next step, if it is as
      long, and goes through a singular configuration that this one ends close to; else infinite.
    - `retry`: by how much to change the step. `gains`: the smallest d then, of both steps; zero where no change helps,
      such as from a singular configuration.
    """

    passes: Float[Array, ""]
    follows: Float[Array, ""]
    retry: Float[Array, ""]
    gains: Float[Array, ""]

    @staticmethod
    def unknown(passes: Float[Array, ""]) -> "Placement":
        """Of a step that tells d at its end alone."""
        zero = jnp.zeros_like(passes)
        return Placement(passes, zero + jnp.inf, zero + 1.0, zero)

    @staticmethod
    def of(
        nodes: Float[np.ndarray, " stages"],
        leaves: Float[Array, ""],
        stages: Float[Array, " stages"],
        arrives: Float[Array, ""],
    ) -> "Placement":
        """Place a step from d where it begins, at the nodes of a Runge-Kutta tableau after that, and where it ends.

        d falls to zero and rises again like |t − t*|: three of its values tell t*.
        """
        nodes = nodes.astype(leaves.dtype)
        ends = np.unique([0.0, *nodes[nodes < 1.0], 1.0]).astype(leaves.dtype)
        middles, clear = (ends[1:] + ends[:-1]) / 2, (ends[1:] - ends[:-1]) / 2
        widest, half = np.argmax(clear), np.argmin(np.abs(nodes - 0.5))
        room, span = middles[widest], clear[widest]
        line = lambda end: jnp.abs(stages[half] - jnp.abs(leaves + (end - leaves) * nodes[half]))
        travel = leaves + jnp.where(line(-arrives) < line(arrives), arrives, -arrives)
        place = jnp.where(travel > 0.0, ratio(leaves, travel, jnp.inf), jnp.inf)  # of t*, in steps
        # Cut so that t* is in the middle of a gap between stages, or in the widest one of the step that follows.
        into = jnp.where(middles >= place, place / middles, 0.0)
        before = jnp.minimum(place / (1.0 + GROWTH * room), 1.0 / GROWTH)
        before = jnp.where(place > 1.0 / GROWTH + room, place - room, before)
        before = jnp.where(before < 1.0, before, 0.0)
        cuts = jnp.append(into, before)
        beyond = jnp.abs(place - before * np.max(nodes))  # for methods with stages after the end of a step
        distances = travel * jnp.append(into * clear, jnp.minimum(jnp.minimum(GROWTH * before, 1.0) * span, beyond))
        best = jnp.argmax(jnp.where(place < jnp.inf, distances, 0.0))
        after = place - 1.0
        follows = travel * jnp.max(jnp.where(middles >= after, after / middles * clear, 0.0))
        return Placement(
            jnp.min(stages),
            jnp.where((after > 0.0) & (after < room), follows, jnp.inf),
            jnp.where(place < jnp.inf, cuts[best], 1.0),
            jnp.where(place < jnp.inf, distances[best], 0.0),
        )

    def misplaced(self, clearance: Float[Array, ""], keep: Bool[Array, ""]) -> Bool[Array, ""]:
        """Whether a try at another length is worth it; what follows counts only where the step is accepted."""
        nearest = jnp.where(keep, jnp.minimum(self.passes, self.follows), self.passes)
        return (nearest < clearance) & (self.gains > BETTER * nearest)


def lock_ahead(
    nodes: Float[np.ndarray, " stages"],
    leaves: Float[Array, ""],
    stages: Float[Array, " stages"],
    arrives: Float[Array, ""],
    growth: Float[Array, ""],
) -> Float[Array, ""]:
    """How many steps after the end of this one a driven mechanism locks, if its drives go on; zero for none.

    There loops close by σ² = c (t* − t), σ the singular value that vanishes: d² falls to zero in a straight line of
    time, and driven speeds grow like 1/d. A motion that passes, through a singular configuration or beside one, has d²
    of a parabola, and speeds that stay bounded.

    **Arguments:** as `Placement.of`; `growth`: by how much the largest speed grows in the step.
    """
    half = np.argmin(np.abs(nodes - 0.5))
    middle = nodes[half].astype(leaves.dtype)
    rise, rise_to_middle = arrives**2 - leaves**2, stages[half] ** 2 - leaves**2
    # d² = leaves² + slope τ + curvature τ², τ in steps, whose discriminant is slope² − 4 curvature leaves².
    curvature = (rise - rise_to_middle / middle) / (1.0 - middle)
    slope = rise - curvature
    is_straight = jnp.abs(4.0 * curvature * leaves**2) < STRAIGHT * slope**2
    grows = jnp.abs(growth * arrives - leaves) < STRAIGHT * leaves
    tells = is_straight & grows & (arrives < LOCKED) & (arrives < FALLS * leaves)
    return jnp.where(tells, ratio(arrives**2, -rise), 0.0)
