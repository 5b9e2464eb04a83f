"""Switches of force elements: the side of each that a motion is on, and steps that end at them.

Each step is computed with all force elements held on the sides on which it begins, so that nothing in it has a kink.
A step that goes past a switch is tried again, up to there, and the next begins on the other side; that of a
`linkax.Impact` on the same one, with other speeds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.internal_states import bound
from linkax.equations.motion import Motion, move
from linkax.equations.system import System
from linkax.model.elements import Time
from linkax.model.forces.force import AbstractForce, Load
from linkax.simulation.integrate import impacts
from linkax.spatial.vectors import length
from linkax.xla.arrays import Array
from linkax.xla.derivatives import positive_or_one, ratio

SAMPLES = 8  # of a step, and of a window of it
WINDOWS = 64  # of a step that are looked at
KEPT = 8  # of these that are kept, with intervals that wait to be looked at
ON_ULPS = 1024.0  # what counts as there, in units of what rounding of the state changes
BEYOND_ULPS = 512.0  # how far beyond a switch a step ends: an event with the same condition sees it on the other side
START_ULPS = 1e5  # how far beyond a stop a run may begin, as rounding of its assembly
TIME_ULPS = 8.0
JUMPS = 1.25  # times the changes beside it: what no convex value has, nor one that is a little concave beside a kink
SHORTEN = 1e-3  # a step that begins past a switch
ITERATIONS = 60
PROBE = 1e-5  # relative change of numbers, by which it is seen what switches change with
SEEDS = (0, 1)  # of their signs, so that changes that cancel in one do not in the other

# What y keeps of switches: the side of each, 1 or −1, then the record of impacts (see `impacts`); () without switches.
Sides = Float[Array, " kept"] | tuple[()]
Moves = Literal["nothing", "state", "time"]
Problem = Any  # that of `linkax.simulation.integrate.problem`, which imports this module


class Held(eqx.Module):
    """A force element held on one side of its switch."""

    force: AbstractForce
    side: Array

    def applied(self, t: Time, motion: Motion) -> Load:
        return self.force.applied(t, motion, self.side > 0.0)

    def state_rates(self, t: Time, motion: Motion) -> Float[jax.Array, " n"]:
        return self.force.state_rates(t, motion, self.side > 0.0)


def held(system: System, sides: Sides) -> System:
    """Hold the force elements of a system on the given sides of their switches."""
    each = iter(sides)
    forces = tuple(Held(force, next(each)) if force.has_switch else force for force in system.forces)
    return dataclasses.replace(system, forces=forces)


def values(
    system: System,
    t: Float[Array, ""],
    q: Float[Array, " n_q"],
    v: Float[Array, " n_v"],
    apart: Bool[Array, " m"] | None = None,
) -> Float[Array, " m"]:
    """Values of all switches of force elements, (m,); of those `apart` how far they are from where they may act."""
    motion = move(configure(system, t, q), v)
    switches = jnp.stack([force.switched(t, motion) for force in system.forces if force.has_switch])
    return switches if apart is None else jnp.where(apart, -_separations(system, motion), switches)


def are_apart(
    system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"], least: Float[Array, " m"]
) -> Bool[Array, " m"]:
    """Which force elements with a switch are so far, or farther, from where they may act, (m,); see `values`."""
    return _separations(system, move(configure(system, t, q), v)) > least


def _separations(system, motion):
    """Of force elements with a switch, (m,); −∞ where the switch alone tells."""
    found = [force.separation(motion.configuration) for force in system.forces if force.has_switch]
    return jnp.stack([jnp.asarray(-jnp.inf if each is None else each, system.dtype) for each in found])


def start_sides(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Sides:
    """The sides of switches at a state where a run begins, without impacts so far; () without switches."""
    if not any(force.has_switch for force in system.forces):
        return ()
    found, stops = values(system, t, q, v), impacts.places(system)
    least = np.zeros(len(found))
    least[stops] = -START_ULPS * float(jnp.finfo(q.dtype).eps)
    sides = jnp.where(found > least, 1.0, -1.0).astype(q.dtype)
    return jnp.concatenate([sides, jnp.zeros(2 * len(stops), q.dtype)]) if len(stops) else sides


def turning(
    system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> Float[Array, ""] | None:
    """How fast the joints between the bodies of a force element turn, all of them together, of the element where it is
    most [rad/s]; None where no element with a switch attaches to bodies.
    """
    path = system.topology.path
    between = []
    for force in system.forces:
        if force.has_switch and (frames := force.itself.frames):
            ways = path[[system.topology.body_index(frame.body) for frame in frames]]
            between.append(np.max(ways, axis=0) - np.min(ways, axis=0))
    if not between:
        return None
    turns = length(move(configure(system, t, q), v).edge_turn)
    return jnp.max(np.stack(between).astype(turns.dtype) @ turns)


class _Search(NamedTuple):
    """A search for the first place of a step past a switch, in a window of it at a time.

    - `count`: of windows. `left`: values of the switches at samples of the whole step, (SAMPLES + 1, m).
    - `windows`: ends of the first window and the latest ones, by shares of the step, (KEPT, 2).
    - `lowest`: how low each switch may be in the intervals between their samples that wait to be looked at, (KEPT,
      SAMPLES, m), as it may be passed and come back there; infinite for all others.
    - `before`, `past`: (share, least value), of the last sample before a switch is passed, and the first after it.
    """

    count: Array
    left: Array
    windows: Array
    lowest: Array
    before: tuple[Array, Array]
    past: tuple[Array, Array]
    finds: Array


def meet(
    problem: Problem,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    y0: Float[Array, " n"],
    y1: Float[Array, " n"],
    within: Callable[[Float[Array, ""]], Float[Array, " n"]],
) -> tuple[Float[Array, ""], Float[Array, " kept"]]:
    """Find where a step goes past a switch, and on which sides it ends.

    **Arguments:** `within(share)`: the motion at a share of the step, from y0 to y1 without a jump.

    **Returns:** the share of the step up to the first switch, one for none; the sides after a step that goes past none,
    with impacts counted, and not yet happened.
    """
    kept = problem.sides(y0)
    eps = jnp.finfo(y0.dtype).eps
    stops, num = impacts.places(problem.system), sum(force.has_switch for force in problem.system.forces)
    sides = kept[:num]
    duration = t1 - t0
    # In units of what rounding makes of each, so that the unit of a switch does not matter.
    ulps = sides / positive_or_one(eps * _sensitivity(problem, t0, t1, y0, y1, problem.switches(t1, y1)))
    # A switch that looks at how fast bodies part is far from zero as soon as they have passed each other.
    apart = (sides < 0.0) & problem.are_apart(t0, y0, ON_ULPS / ulps)

    def inside(share):
        """Values of the switches at a share of the step, positive on the sides where it begins."""
        return ulps * problem.switches(t0 + share * duration, within(share), apart)

    at_end = ulps * problem.switches(t1, y1, apart)
    search = _searched(inside, at_end, 2.0 * TIME_ULPS * eps)

    def closer(carry):
        count, (a, of_a), (b, of_b), _ = carry
        # From where the switch is as good as there, and leaves it, to where it comes back.
        leaves = of_a <= ON_ULPS
        c = jnp.where(leaves, (a + b) / 2.0, jnp.clip(b - of_b * (b - a) / (of_b - of_a), a, b))
        of_c = jnp.min(inside(c)) + BEYOND_ULPS
        # False position, which halves the value of an end that stays (the Illinois method).
        before = of_c > 0.0
        ends = jax.tree.map(
            lambda after, ahead: jnp.where(before, after, ahead),
            ((c, of_c), (b, of_b / 2.0)),
            ((a, of_a / 2.0), (c, of_c)),
        )
        found = (jnp.abs(of_c) <= BEYOND_ULPS / 8.0) & ~(leaves & before)
        return jnp.where(found | (b <= a), ITERATIONS, count + 1), *ends, c

    (a, of_a), past = search.before, search.past
    begin = jnp.where(search.finds, 0, ITERATIONS), (a, jnp.maximum(of_a, 0.0)), past, past[0]
    *_, share = lax.while_loop(lambda carry: carry[0] < ITERATIONS, closer, begin)
    least = TIME_ULPS * eps * jnp.maximum(jnp.abs(t1), duration)
    resolved = search.finds & ((1.0 - share) * duration > least)
    arrives = (at_end <= ON_ULPS) & (at_end < jnp.max(search.left[:-1], axis=0))
    after = kept.at[:num].set(jnp.where(arrives, -sides, sides))
    if len(stops):
        after = after.at[stops].set(sides[stops]).at[num : num + len(stops)].add(arrives[stops])
    # A step that begins past a switch, and would end where it begins, would be followed by none but such.
    shortest = jnp.maximum(jnp.where(jnp.min(search.left[0]) < 0.0, SHORTEN, 0.0), least / (2.0 * duration))
    return jnp.where(resolved, jnp.maximum(share, shortest), 1.0), after


def _sensitivity(problem, t0, t1, y0, y1, at_end):
    """By how much more than itself a small relative change of all numbers changes each switch, (m,): an estimate.

    All are the state, the time, and the numbers of force elements, each changed up or down at random. A switch that
    none of these change has what it changes in the step.
    """
    (q, v), internal = problem.unpacked(y1), problem.internal(y1)
    system = problem.system

    def changed(seed):
        random = np.random.default_rng(seed)
        either = lambda number: jnp.asarray(PROBE * random.choice([-1.0, 1.0], np.shape(number)), number.dtype)
        other = lambda leaf: leaf * (1.0 + either(leaf)) if eqx.is_inexact_array(leaf) else leaf
        forces = jax.tree.map(other, system.forces)
        near = dataclasses.replace(system, forces=forces)
        near = near if internal is None else bound(near, other(internal))
        turned = either(v) * system.scales
        return values(near, other(t1), retract(system.topology, q, turned), v + system.fastest(v) * turned)

    moved = jnp.stack([jnp.abs(changed(seed) - at_end) for seed in SEEDS])
    return jnp.maximum(jnp.max(moved, axis=0) / PROBE, jnp.abs(at_end - problem.switches(t0, y0)))


def _searched(inside, at_end, narrowest) -> _Search:
    """Look for the first sample past a switch: of the step, then of intervals in which one may be passed and come back.

    Between two samples a value may fall as fast as it changes beside them, and no faster while the gap of two convex
    bodies, or what else is convex in time, is small. Intervals in which that may lead past zero are sampled, those
    where it may lead farthest first, until one sample is past it or none may be. `narrowest`: the share of a step that
    is as good as nothing.
    """
    places = jnp.asarray(np.linspace(0.0, 1.0, SAMPLES + 1), at_end.dtype)
    zero = jnp.zeros_like(at_end[0])
    one = jnp.ones_like(at_end[0])
    num = len(at_end)

    def look(search):
        first = search.count == 0
        window, interval, switch = jnp.unravel_index(jnp.argmin(search.lowest), search.lowest.shape)
        a, b = search.windows[window]
        shares = jnp.where(first, places, a + (places + interval) / SAMPLES * (b - a))
        values = jax.vmap(inside)(shares)
        values = values.at[-1].set(jnp.where(first, at_end, values[-1]))
        nearest = jnp.min(values, axis=1)
        past = nearest[1:] < -ON_ULPS
        place = jnp.argmax(past)
        slack, lowest = _between(values)
        may_pass = (slack < 0.0) & (first | (np.arange(num) == switch)) & (shares[1] - shares[0] > narrowest)
        begins = (shares[0] == 0.0) & _rises_straight(values)
        ends = (shares[-1] == 1.0) & _rises_straight(values[::-1])
        may_pass = may_pass.at[0].set(may_pass[0] & ~begins).at[-1].set(may_pass[-1] & ~ends)
        slot = jnp.where(first, 0, 1 + search.count % (KEPT - 1))
        waiting = search.lowest.at[window, interval, switch].set(jnp.inf)
        waiting = waiting.at[slot].set(jnp.where(may_pass, lowest, jnp.inf))
        fails = jnp.logical_not(jnp.all(jnp.isfinite(values)))
        return _Search(
            search.count + 1,
            jnp.where(first, values, search.left),
            search.windows.at[slot].set(shares[jnp.array([0, SAMPLES])]),
            jnp.where(fails, jnp.inf, waiting),
            (shares[place], nearest[place]),
            (shares[place + 1], nearest[place + 1]),
            jnp.any(past),
        )

    def goes_on(search):
        waits = (search.count == 0) | jnp.any(search.lowest < jnp.inf)
        return waits & ~search.finds & (search.count < WINDOWS)

    begin = _Search(
        jnp.zeros((), int),
        jnp.zeros((SAMPLES + 1, num), at_end.dtype),
        jnp.zeros((KEPT, 2), at_end.dtype),
        jnp.full((KEPT, SAMPLES, num), jnp.inf, at_end.dtype),
        (zero, zero),
        (one, one),
        jnp.zeros((), bool),
    )
    return lax.while_loop(goes_on, look, begin)


def _rises_straight(values):
    """Whether values rise from a switch where they begin, in a straight line, (m,): else the steps before and after a
    contact begins or ends are searched there down to rounding.
    """
    rise = values[1] - values[0]
    next_rise = values[2] - values[1]
    is_straight = (rise < JUMPS * next_rise) & (next_rise < JUMPS * rise)
    return (values[0] <= ON_ULPS) & (rise > 0.0) & is_straight


def _between(values):
    """How far values stay from zero between each two samples, at least, negative where they may pass, (SAMPLES, m); and
    how low they are there where they are convex in time, with kinks, or jump up, (SAMPLES, m).
    """
    one = values[:-1]
    other = values[1:]
    nearest = jnp.minimum(one, other)
    changes = jnp.abs(jnp.diff(values, axis=0))
    at_begin = jnp.max(changes[:2], axis=0, keepdims=True)
    at_end = jnp.max(changes[-2:], axis=0, keepdims=True)
    before = jnp.concatenate([at_begin, changes[:-1]])
    after = jnp.concatenate([changes[1:], at_end])
    most = jnp.maximum(before, after)
    # Lines that go on as steep as they are beside meet below what is convex; in it no change is larger than both are.
    meeting = ratio(after * one + before * other - before * after, before + after, nearest)
    lowest = jnp.where(changes > JUMPS * most, nearest - jnp.where(one < other, before, after), meeting)
    return nearest - jnp.maximum(changes, most), lowest


def crossed(
    problem: Problem, t: Float[Array, ""], y: Float[Array, " n"], after: Sides, moves: Moves = "state"
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Put a state past the switches where it is, one after the other; its derivative knows that crossings move in time.

    A switch g is crossed later by dt = −dg / ġ. From there the motion goes on, with speeds that jump at an impact. At
    the time t, which does not move, the state changes by (f₋ − f₊) dt (the saltation matrix; Leine and Nijmeijer
    (2004), Dynamics and Bifurcations of Non-Smooth Mechanical Systems, ch. 7).

    **Arguments:** `after`: what `meet` returned. `moves`: "state" for its derivative at the time t; "time" for that of
    the time of the last crossing, too, and of the state then: steps that move along begin exactly at the switch;
    "nothing" for no derivatives.
    """
    before, stops = problem.sides(y), impacts.places(problem.system)
    if not len(before):
        return t, y
    num = len(before) - 2 * len(stops)
    if moves == "nothing":
        y = problem.on_sides(y, jnp.concatenate([jnp.asarray(after[:num]), before[num:]]))
        crosses = jnp.zeros(num, bool)
    else:
        crosses = after[:num] != before[:num]
    crosses = crosses.at[stops].set(after[num : num + len(stops)] > before[num : num + len(stops)])
    if moves == "nothing" and not len(stops):
        return t, y
    order = np.full(num, -1)
    order[stops] = np.arange(len(stops))
    flip = lambda t, y, index: y.at[index].multiply(-1.0)

    def cross(index, t, y):
        switch = lambda t, y: problem.switches(t, y)[index]
        rate = lax.stop_gradient(problem.derivative(t, y))
        value, speed = lax.stop_gradient(jax.jvp(switch, (t, y), (jnp.ones_like(t), rate)))
        delay = jnp.where(speed != 0.0, (value - switch(t, y)) / jnp.where(speed != 0.0, speed, 1.0), 0.0)
        return delay, t + delay, y + delay * rate

    def past(index, t, y):
        if not len(stops):
            return flip(t, y, index)
        hit = lambda: impacts.struck(problem, t, y, jnp.asarray(order)[index])
        return lax.cond(jnp.asarray(order)[index] >= 0, hit, lambda: flip(t, y, index))

    def one(at, index):
        return lax.cond(crosses[index], lambda at: whole(index, *at), lambda at: at, at), None

    def whole(index, t, y):
        if moves == "nothing":
            return t, past(index, t, y)
        delay, later, moved = cross(index, t, y)
        moved = past(index, later, moved)
        if moves == "time":
            return later, moved
        return t, moved - delay * lax.stop_gradient(problem.derivative(later, moved))

    return lax.scan(one, (t, y), np.arange(num))[0]
