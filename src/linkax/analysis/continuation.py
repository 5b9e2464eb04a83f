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
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.system import System
from linkax.linalg.saddle_inverse import SaddleInverse, invert
from linkax.model.constraints.constraint import Coupling
from linkax.simulation.start.closing import CLOSED, LoopClosure, close_loops
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import nearest_solution, rank_tolerance
from linkax.simulation.start.state import State
from linkax.spatial.vectors import dot, largest, length
from linkax.xla.arrays import Array
from linkax.xla.derivatives import positive_or_one, ratio
from linkax.xla.tracing import jit_inline
from scalarjit import scalarised

MOST_CORRECTIONS = 5
CONVERGED = 1e-8  # correction after which the next one is rounding [rad, lengths of the mechanism]
FAITHFUL = 0.1  # largest correction of a step, relative to it, with which it is on the same branch
ARC_CORRECTIONS = 3
ANYHOW = 10.0 * CONVERGED  # correction that leads to no other branch, and the shortest step
OF_VALUES = 1e-2  # weight of values beside that of loops
MOVES = 1e-6  # rate of rows, relative to that of coordinates, up to which it is none
PROBE = 1e-4  # how far beside its start a way has the rank that it has elsewhere [rad, lengths of the mechanism]


class Place(NamedTuple):
    """A position on the way, and how it goes on.

    - `q`: coordinates; `v`, `acceleration`: their first and second derivative by s.
    - `distance`: |R_rr| / |R₁₁| of all rows, zero where another branch crosses or what is asked for turns back.
    - `rank`: the largest of all rows, here and before; in a singular configuration itself it is smaller.
    """

    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]
    distance: Float[Array, ""]
    rank: Int[Array, ""]

    def ahead(self, h: Float[Array, ""]) -> Float[Array, " n_v"]:
        """The change of coordinates until s + h, but for the third power of h."""
        return h * self.v + 0.5 * h**2 * self.acceleration

    def before(self, h: Float[Array, ""]) -> "Before":
        """What a place at s + h continues: derivatives but for the second power of h, and the first."""
        return Before(self.v + h * self.acceleration, self.acceleration, self.rank)


class Before(NamedTuple):
    """How the way came to a place, which chooses the branch in a singular configuration.

    - `v`, `acceleration`: first and second derivative of coordinates by s, roughly. `rank`: of all rows.
    """

    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]
    rank: Int[Array, ""]


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

    Where nothing is held, s is the arc length of q [rad, lengths of the mechanism].

    - `followed`: drives that move one of these joints, and which of the values: (constraint, value). They hold it there
      instead of where they would at time t.
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
            system = dataclasses.replace(system, constraints=tuple(constraints))
        return LoopClosure(system, self.t, self.held.filled(values))

    @property
    def num_loop_rows(self) -> int:
        """Number of the rows of `LoopClosure` before those of values."""
        topology = self.system.topology
        return topology.num_rows + sum(len(kind.aligned_axes) for kind in topology.cut_types)

    def in_scales(self, rows: Float[Array, "n ..."], weight: float = 1.0) -> Float[Array, "n ..."]:
        """Rows of `LoopClosure`, with those of values in radians and lengths of the mechanism, times a weight."""
        values = weight * jnp.where(self.held.slides(), 1.0 / self.system.length, 1.0)
        factors = jnp.concatenate([jnp.ones(self.num_loop_rows, rows.dtype), values.astype(rows.dtype)])
        return rows * factors.reshape(-1, *(1,) * (rows.ndim - 1))

    @jit_inline
    def correction(
        self, q: Float[Array, " n_q"], values: Float[Array, " k"]
    ) -> tuple[Float[Array, " n_v"], Float[Array, ""], Float[Array, ""]]:
        """The change of q by one step of Newton's method, and how far off the loops and the values are."""
        rows, slopes = self.demand(values).linearised(q)
        step = self.solution(jnp.zeros_like(self.system.scales), slopes, -rows)
        gap, miss = jnp.split(self.in_scales(rows), [self.num_loop_rows])
        return step, largest(gap), largest(miss)

    def solution(
        self, near: Float[Array, " n_v"], slopes: Float[Array, "n n_v"], right: Float[Array, " n"]
    ) -> Float[Array, " n_v"]:
        """Solve slopes @ y = right for the y nearest to another; of right sides that contradict each other, the loops'.

        Values do, between two positions, where more are followed than the mechanism can move.
        """
        return nearest_solution(self.system, near, self.in_scales(slopes, OF_VALUES), self.in_scales(right, OF_VALUES))

    def rank(self, q: Float[Array, " n_q"], values: Float[Array, " k"]) -> Int[Array, ""]:
        """Of all rows."""
        return self.split(self.demand(values).linearised(q)[1]).rank

    def split(self, slopes: Float[Array, "n n_v"]) -> SaddleInverse:
        """Split the space of speeds by all rows, in the identity metric."""
        return invert(None, self.in_scales(slopes), self.system.scales, rank_tolerance(slopes.dtype))

    @jit_inline
    def place(self, q: Float[Array, " n_q"], asked: Asked, before: Before) -> Place:
        """How the way goes on from coordinates q on it.

        **Arguments:** `before`: by any multiple of s.
        """
        topology, scales = self.system.topology, self.system.scales
        slopes = self.demand(asked.values).linearised(q)[1]
        split = self.split(slopes)
        # Where fewer rows are independent than before, they leave open which branch goes on.
        is_singular, nothing = split.rank < before.rank, jnp.zeros_like(scales)

        def along(v):
            def rows(step):
                values = asked.values + step * asked.rates + 0.5 * step**2 * asked.accelerations
                moved = self.demand(values)
                return moved.rows(configure(moved.system, self.t, retract(topology, q, step * v)))

            return rows

        here = jnp.zeros((), q.dtype)
        opens = _rate(along(nothing), here)
        if self.held.groups:
            # −opens are the rates that are asked for, and `moves` those of the speeds before.
            moves, size = self.in_scales(slopes @ before.v), dot(before.v / scales, before.v / scales)
            moving = jnp.where(dot(moves, moves) > MOVES**2 * size, dot(moves, moves), 0.0)
            near = before.v * ratio(-dot(self.in_scales(opens), moves), moving, 0.0)
            v = self.solution(jnp.where(is_singular, near, nothing), slopes, -opens)
        else:
            v = self.solution(before.v, slopes, -opens)
            v = v / positive_or_one(length(v / scales))
        bends = _rate(partial(_rate, along(v)), here)
        acceleration = self.solution(jnp.where(is_singular, before.acceleration, nothing), slopes, -bends)
        if not self.held.groups:
            acceleration = acceleration - v * dot(acceleration / scales, v / scales)  # |v| is one
        distance = jnp.where(is_singular, 0.0, split.distance)
        return Place(q, v, acceleration, distance, jnp.maximum(split.rank, before.rank))

    def corrected(
        self, place: Place, h: Float[Array, ""], values: Float[Array, " k"], at_end: Bool[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Bool[Array, ""]]:
        """Coordinates at s + h, and whether they lie on the same branch, and at the end of a piece have the values."""
        fastest, change = self.system.fastest, place.ahead(h)
        begin = retract(self.system.topology, place.q, change)
        allowed = FAITHFUL * fastest(change) + ANYHOW

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
        self, q: Float[Array, " n_q"], before: Before, piece: Piece, going: Bool[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Before, Bool[Array, ""]]:
        """Go from q through a piece, in as many steps as it takes.

        **Returns:** coordinates at its end, how the way came there, and whether that is reached.
        """

        def unfinished(carry):
            *_, u, fraction = carry
            return (u < 1.0) & (fraction > 0.0)

        def advance(carry):
            place, before, u, fraction = carry
            to = jnp.where(u + 1.01 * fraction >= 1.0, 1.0, u + fraction)
            h = (to - u) * piece.h
            q, reached = self.corrected(place, h, piece.at(to).values, to == 1.0)
            # What does not move has no direction.
            moves = self.system.fastest(place.v) > 0.0
            came = jax.tree.map(lambda new, old: jnp.where(moves, new, old), place.before(h), before)
            there, change = self.place(q, piece.at(to), came), place.ahead(h)
            # From another branch, next to where both meet, the way back does not lead to where it came from.
            allowed = FAITHFUL * self.system.fastest(change) + ANYHOW
            reached = reached & (self.system.fastest(change + there.ahead(-h)) <= allowed)
            # Next to where it turns back, steps get as short as the rest of the way.
            shorter = jnp.where(self.system.fastest(change) > ANYHOW, 0.5 * fraction, 0.0)
            fraction = jnp.where(reached, jnp.minimum(2.0 * fraction, 1.0), shorter)
            moved = there, came, to
            place, before, u = jax.tree.map(lambda new, old: jnp.where(reached, new, old), moved, (place, before, u))
            return place, before, u, fraction

        u = jnp.where(going, 0.0, 1.0).astype(q.dtype)
        begin = self.place(q, piece.at(u), before), before, u, jnp.ones_like(u)
        place, before, _, fraction = lax.while_loop(unfinished, advance, begin)
        return place.q, before, going & (fraction > 0.0)

    def start(self, start: State, own: Float[Array, " k"]) -> Before:
        """How a way comes to its start: by the speeds there; the rank is that a little farther on."""
        ahead = start.v * ratio(jnp.full((), PROBE, start.v.dtype), self.system.fastest(start.v), 0.0)
        rank = self.rank(retract(self.system.topology, start.q, ahead), own)
        return Before(start.v, jnp.zeros_like(start.v), rank)


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
    found, before, reached = lax.stop_gradient(_search(*given))

    def at(found, asked, before):
        demand = way.demand(asked.values)
        met = length(demand.rows_at(found)) <= CLOSED  # up to which there are derivatives
        return way.place(close_loops(demand, found, found), asked, before), lax.stop_gradient(met)

    places, met = jax.vmap(scalarised(at))(found, asked, before)
    return places, reached & (jnp.cumsum(~met) == 0)


def _search(way, start, own, s, asked, going):
    """Coordinates for each s, how the way comes there, and whether it does."""
    approach = jax.tree.map(lambda array: array[None], Piece.straight(own, asked.values[0]))
    begin, end = (jax.tree.map(lambda array, part=part: array[part], asked) for part in (slice(-1), slice(1, None)))
    pieces = jax.tree.map(lambda *parts: jnp.concatenate(parts), approach, Piece.between(jnp.diff(s), begin, end))

    def advance(carry, piece):
        carry = way.through(*carry[:2], piece, carry[2])
        return carry, carry

    return lax.scan(advance, (start.q, way.start(start, own), going), pieces)[1]


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
        h = jnp.where(going, h, 0.0)
        change = place.ahead(h)
        q, total, last = retract(way.system.topology, place.q, change), 0.0, 0.0
        for _ in range(ARC_CORRECTIONS):
            step, gap, _ = way.correction(q, nothing)
            q, last = retract(way.system.topology, q, step), jnp.maximum(way.system.fastest(step), gap)
            total = total + last
        there = way.place(q, nowhere, place.before(h))
        faithful = total <= FAITHFUL * way.system.fastest(change) + ANYHOW
        going = going & faithful & (last <= CONVERGED)
        place = jax.tree.map(lambda new, old: jnp.where(going, new, old), there, place)
        return (place, going), (place, going)

    begin = way.place(start.q, nowhere, way.start(start, nothing))
    moves = way.system.fastest(begin.v) > 0.0
    return lax.scan(advance, (begin, going & moves), jnp.diff(s, prepend=0.0))[1]
