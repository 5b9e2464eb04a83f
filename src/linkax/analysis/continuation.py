"""Follow the closed loops of a mechanism without time: joints at given values one after another, or by arc length.

Predictor and corrector (Allgower, Georg, Introduction to Numerical Continuation Methods, 2003): a step along velocity
and acceleration, then Newton's method back onto the loops, so short that the second stays small next to the first.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.system import System
from linkax.linalg.saddle_inverse import invert
from linkax.model.constraints import Coupling
from linkax.simulation.start.closing import LoopClosure, close_loops
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import nearest_solution, rank_tolerance
from linkax.simulation.start.state import State
from linkax.spatial.vectors import largest, length
from linkax.straight_line.transform import straight_line
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

MOST_CORRECTIONS = 5
CONVERGED = 1e-8  # correction after which the next one is rounding [rad, lengths of the mechanism]
FAITHFUL = 0.1  # largest correction of a step, relative to it, with which it is on the same branch
ARC_CORRECTIONS = 3
OF_VALUES = 1e-2  # weight of values beside that of loops
SHORTEST = 2.0**-10  # of the way from one position to the next


class Place(NamedTuple):
    """A position on the way, and how it goes on.

    - `q`: coordinates; `v`, `acceleration`: their first and second derivative by s.
    - `distance`: |R_rr| / |R₁₁| of all rows, zero where another branch crosses or what is asked for turns back.
    - `rank`: of all rows, smaller there.
    """

    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]
    distance: Float[Array, ""]
    rank: Int[Array, ""]

    def ahead(self, h: Float[Array, ""]) -> Float[Array, " n_v"]:
        """The change of coordinates until s + h, but for the third power of h."""
        return h * self.v + 0.5 * h**2 * self.acceleration

    def rates_ahead(self, h: Float[Array, ""]) -> "Rates":
        """Derivatives at s + h, but for the second power of h, and the first."""
        return Rates(self.v + h * self.acceleration, self.acceleration)


class Rates(NamedTuple):
    """First and second derivative of coordinates by s, roughly: they choose where the rows leave them open.

    Such is a branch in a singular configuration, and how fast a rod between two balls turns about itself.
    """

    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]


class Asked(NamedTuple):
    """What is asked for at some s: values, and their first and second derivative by s, (k,) each."""

    values: Float[Array, "*n k"]
    rates: Float[Array, "*n k"]
    accelerations: Float[Array, "*n k"]


class Piece(NamedTuple):
    """What is asked for between two positions: cubic polynomials of u in [0, 1], s = s₀ + h u.

    `coefficients`: of 1, u, u², u³, (4, k).
    """

    h: Float[Array, "*n"]
    coefficients: Float[Array, "*n 4 k"]

    @staticmethod
    def between(h: Float[Array, "*n"], start: Asked, end: Asked) -> "Piece":
        """Hermite's polynomial."""
        width = h[..., None]
        rise, first, last = end.values - start.values, width * start.rates, width * end.rates
        rows = [start.values, first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise]
        return Piece(h, jnp.stack(rows, axis=-2))

    @staticmethod
    def straight(start: Float[Array, " k"], end: Float[Array, " k"]) -> "Piece":
        """From values to others, in s = 0 to 1."""
        rise = end - start
        return Piece(jnp.ones_like(rise, shape=()), jnp.stack([start, rise, 0.0 * rise, 0.0 * rise]))

    def at(self, u: Float[Array, ""]) -> Asked:
        """Values at u, and their derivatives by s."""
        one, zero = jnp.ones_like(u), jnp.zeros_like(u)
        powers = jnp.stack([one, u, u**2, u**3]), jnp.stack([zero, one, 2.0 * u, 3.0 * u**2])
        bends = jnp.stack([zero, zero, 2.0 * one, 6.0 * u])
        values, rates, accelerations = (each @ self.coefficients for each in (*powers, bends))
        h = jnp.where(self.h == 0.0, 1.0, self.h)
        return Asked(values, rates / h, accelerations / h**2)


class Way(eqx.Module):
    """Closed loops at time t with coordinates of some joints, `held`, at values that change with s.

    - `followed`: drives that move one of these joints, and which of the values: (constraint, value). They hold it there
      instead of where they would at time t.
      Where nothing is held, s is the arc length of q [rad, lengths of the mechanism].
    """

    system: System
    t: Float[Array, ""]
    held: JointValues
    followed: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def demand(self, values: Float[Array, " k"]) -> LoopClosure:
        """The problem of closing the loops with these values."""
        constraints = [*self.system.constraints]
        for row, value in self.followed:
            drive = constraints[row]
            constraints[row] = Coupling(drive.name, {drive.terms[0]: 1.0}, values[value])
        system = self.system
        if self.followed:
            system = dataclasses.replace(system, constraints=tuple(constraints), known=None)
        return LoopClosure(system, self.t, self.held.filled(values))

    @property
    def weights(self) -> Float[np.ndarray, " n"]:
        """Of rows: where the values contradict each other between two positions, the loops stay closed."""
        values = len(self.held.slides())
        rows = self.system.topology.num_rows + sum(len(kind.aligned_axes) for kind in self.system.topology.cut_types)
        return np.concatenate([np.ones(rows), np.full(values, OF_VALUES)])

    @straight_line
    def correction(
        self, q: Float[Array, " n_q"], values: Float[Array, " k"]
    ) -> tuple[Float[Array, " n_v"], Float[Array, ""], Float[Array, ""]]:
        """The change of q by one step of Newton's method, and how far off the loops and the values are."""
        (rows, slopes), weights = self.demand(values).linearised(q), self.weights
        nothing = jnp.zeros_like(self.system.scales)
        step = nearest_solution(self.system, nothing, weights[:, None] * slopes, -weights * rows)
        of_loops = weights == 1.0
        return step, largest(rows[of_loops]), largest(rows[~of_loops])

    @straight_line
    def place(self, q: Float[Array, " n_q"], asked: Asked, nearby: Rates) -> Place:
        """How the way goes on from coordinates q on it.

        **Arguments:** `nearby`: derivatives before, by any multiple of s.
        """
        topology, scales, demand = self.system.topology, self.system.scales, self.demand(asked.values)
        slopes, weights = demand.linearised(q)[1], self.weights

        def along(v):
            def rows(step):
                values = asked.values + step * asked.rates + 0.5 * step**2 * asked.accelerations
                moved = self.demand(values)
                return moved.rows(configure(moved.system, self.t, retract(topology, q, step * v)))

            return rows

        here = jnp.zeros((), q.dtype)
        opens = _rate(along(jnp.zeros_like(scales)), here)
        if self.held.groups:
            # −opens are the rates that are asked for, and slopes @ v those of v.
            before = slopes @ nearby.v
            near = nearby.v * ratio(-(opens @ before), before @ before, 0.0)
            v = nearest_solution(self.system, near, weights[:, None] * slopes, -weights * opens)
        else:
            v = nearest_solution(self.system, nearby.v, slopes, -opens)
            v = v / length(v / scales)
        bends = weights * _rate(partial(_rate, along(v)), here)
        acceleration = nearest_solution(self.system, nearby.acceleration, weights[:, None] * slopes, -bends)
        split = invert(None, slopes, scales, rank_tolerance(q.dtype))
        return Place(q, v, acceleration, split.distance, split.rank)

    def corrected(
        self, place: Place, h: Float[Array, ""], values: Float[Array, " k"], at_end: Bool[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Bool[Array, ""]]:
        """Coordinates at s + h, and whether they lie on the same branch, and at the end of a piece have the values."""
        fastest, change = self.system.fastest, place.ahead(h)
        begin = retract(self.system.topology, place.q, change)
        allowed = FAITHFUL * jnp.maximum(fastest(change), CONVERGED)

        def unfinished(carry):
            count, _, last, total = carry
            return (count < MOST_CORRECTIONS) & (last > CONVERGED) & (total <= allowed)

        def correct(carry):
            count, q, before, total = carry
            step, gap, miss = self.correction(q, values)
            # What no change closes is no success.
            size = jnp.maximum(fastest(step), jnp.maximum(gap, jnp.where(at_end, miss, 0.0)))
            # One that grows leads nowhere, one that is no number neither.
            grows = jnp.logical_not(size <= jnp.maximum(0.5 * before, CONVERGED))
            q = retract(self.system.topology, q, step)
            return count + 1, q, size, jnp.where(grows, jnp.inf, total + size)

        far = jnp.asarray(jnp.inf, begin.dtype)
        start = jnp.zeros((), int), begin, far, jnp.zeros_like(far)
        _, q, last, total = lax.while_loop(unfinished, correct, start)
        return q, (last <= CONVERGED) & (total <= allowed)

    def through(
        self, q: Float[Array, " n_q"], nearby: Rates, piece: Piece, going: Bool[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Rates, Bool[Array, ""]]:
        """Go from q through a piece, in as many steps as it takes.

        **Returns:** coordinates and rough derivatives at its end, and whether that is reached.
        """

        def unfinished(carry):
            *_, u, fraction = carry
            return (u < 1.0) & (fraction >= SHORTEST)

        def advance(carry):
            q, nearby, u, fraction = carry
            to = jnp.where(u + 1.01 * fraction >= 1.0, 1.0, u + fraction)
            h = (to - u) * piece.h
            place = self.place(q, piece.at(u), nearby)
            there, reached = self.corrected(place, h, piece.at(to).values, to == 1.0)
            longer = jnp.where(reached, jnp.minimum(2.0 * fraction, 1.0), 0.5 * fraction)
            moved = there, place.rates_ahead(h), to
            q, nearby, u = jax.tree.map(lambda new, old: jnp.where(reached, new, old), moved, (q, nearby, u))
            return q, nearby, u, longer

        begin = jnp.where(going, 0.0, 1.0).astype(q.dtype)
        q, nearby, _, fraction = lax.while_loop(unfinished, advance, (q, nearby, begin, jnp.ones_like(begin)))
        return q, nearby, going & (fraction >= SHORTEST)


def _rate(function, at):
    """The derivative of a function of one number."""
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


def follow_values(
    way: Way, start: State, own: Float[Array, " k"], s: Float[Array, " n"], asked: Asked, going: Bool[Array, ""]
) -> tuple[Place, Bool[Array, " n"]]:
    """Places where what is asked for at each s holds, and whether they are reached from the start, (n, ...) each.

    Differentiable in the numbers of the way and what is asked for, in both modes, to any order.

    **Arguments:** `own`: values of what is held at the start; `going`: whether the way begins there.
    """
    given = lax.stop_gradient((way, start, own, s, asked, going))
    found, nearby, reached = lax.stop_gradient(_search(*given))

    def at(found, asked, nearby):
        return way.place(close_loops(way.demand(asked.values), found, found), asked, nearby)

    return jax.vmap(at)(found, asked, nearby), reached


def _search(way, start, own, s, asked, going):
    """Coordinates and rough derivatives for each s, and whether they are reached."""
    approach = jax.tree.map(lambda array: array[None], Piece.straight(own, asked.values[0]))
    begin, end = (jax.tree.map(lambda array, part=part: array[part], asked) for part in (slice(-1), slice(1, None)))
    pieces = jax.tree.map(lambda *parts: jnp.concatenate(parts), approach, Piece.between(jnp.diff(s), begin, end))

    def advance(carry, piece):
        carry = way.through(*carry[:2], piece, carry[2])
        return carry, carry

    nearby = Rates(start.v, jnp.zeros_like(start.v))
    return lax.scan(advance, (start.q, nearby, going), pieces)[1]


def follow_arc(
    way: Way, start: State, s: Float[Array, " n"], going: Bool[Array, ""]
) -> tuple[Place, Bool[Array, " n"]]:
    """Places at arc lengths s from the start, through turning points, and whether they are reached, (n, ...) each.

    One step leads from each to the next, which makes all of it differentiable in both modes, to any order.

    The way goes in the direction of the start's speeds. **Arguments:** `going`: whether it begins.
    """
    nothing = jnp.zeros_like(start.q[:0])
    nowhere = Asked(nothing, nothing, nothing)

    def advance(carry, h):
        place, going = carry
        change = place.ahead(h)
        q, total, last = retract(way.system.topology, place.q, change), 0.0, 0.0
        for _ in range(ARC_CORRECTIONS):
            step, gap, _ = way.correction(q, nothing)
            q, last = retract(way.system.topology, q, step), jnp.maximum(way.system.fastest(step), gap)
            total = total + last
        there = way.place(q, nowhere, place.rates_ahead(h))
        faithful = total <= FAITHFUL * jnp.maximum(way.system.fastest(change), CONVERGED)
        going = going & faithful & (last <= CONVERGED)
        return (there, going), (there, going)

    begin = way.place(start.q, nowhere, Rates(start.v, jnp.zeros_like(start.v))), going
    return lax.scan(advance, begin, jnp.diff(s, prepend=0.0))[1]
