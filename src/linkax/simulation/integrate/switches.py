"""Switches of force elements: the side of each that a motion is on, and steps that end at them.

Each step is computed with all force elements held on the sides on which it begins, so that nothing in it has a kink.
A step that goes past a switch is tried again, up to there, and the next begins on the other side; that of a
`linkax.Impact` on the same one, with other speeds.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from linkax.equations.configuration import configure
from linkax.equations.motion import Motion, move
from linkax.equations.system import System
from linkax.model.elements import Time
from linkax.model.forces.force import AbstractForce, Load
from linkax.simulation.integrate import impacts
from linkax.xla.arrays import Array

SAMPLES = 8  # of a step: between two of them a force element must not switch twice
ON_ULPS = 256.0  # of a switch: what counts as there
START_ULPS = 1e5  # how far beyond a stop a run may begin, as rounding of its assembly
TIME_ULPS = 8.0
SHORTEN = 1e-3  # a step that begins past a switch
ITERATIONS = 60

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
    return dataclasses.replace(system, forces=forces, known=None)


def values(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Float[Array, " m"]:
    """Values of all switches of force elements, (m,)."""
    motion = move(configure(system, t, q), v)
    return jnp.stack([force.switched(t, motion) for force in system.forces if force.has_switch])


def start_sides(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Sides:
    """The sides of switches at a state where a run begins, without impacts so far; () without switches."""
    if not any(force.has_switch for force in system.forces):
        return ()
    found, stops = values(system, t, q, v), impacts.places(system)
    least = np.zeros(len(found))
    least[stops] = -START_ULPS * float(jnp.finfo(q.dtype).eps)
    sides = jnp.where(found > least, 1.0, -1.0).astype(q.dtype)
    return jnp.concatenate([sides, jnp.zeros(2 * len(stops), q.dtype)]) if len(stops) else sides


def meet(
    problem: Problem,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    y0: Float[Array, " n"],
    y1: Float[Array, " n"],
    within: Callable[[Float[Array, ""]], Float[Array, " n"]],
) -> tuple[Float[Array, ""], Float[Array, " kept"]]:
    """Find where a step goes past a switch, and on which sides it ends.

    **Arguments:** `within(t)`: interpolates in the step.

    **Returns:** the share of the step up to the first switch, one for none; the sides after a step that goes past none,
    with impacts counted, and not yet happened.
    """
    kept, on = problem.sides(y0), ON_ULPS * jnp.finfo(y0.dtype).eps
    stops, num = impacts.places(problem.system), sum(force.has_switch for force in problem.system.forces)
    sides = kept[:num]
    duration = t1 - t0
    inside = lambda share: sides * problem.switches(t0 + share * duration, within(t0 + share * duration))
    shares = jnp.asarray(np.linspace(0.0, 1.0, SAMPLES + 1), t1.dtype)
    left = jnp.concatenate([jax.vmap(inside)(shares[:-1]), (sides * problem.switches(t1, y1))[None]])
    nearest = jnp.min(left, axis=1)
    past = nearest[1:] < -on
    first = jnp.argmax(past)

    def closer(carry):
        count, a, of_a, b, of_b, _ = carry
        c = jnp.clip(b - of_b * (b - a) / (of_b - of_a), a, b)
        of_c = jnp.min(inside(c))
        # False position, which halves the value of an end that stays (the Illinois method).
        before = of_c > 0.0
        a, of_a, b, of_b = jax.tree.map(
            lambda after, ahead: jnp.where(before, after, ahead), (c, of_c, b, of_b / 2.0), (a, of_a / 2.0, c, of_c)
        )
        count = jnp.where((jnp.abs(of_c) <= on / 4.0) | (b <= a), ITERATIONS, count + 1)
        return count, a, of_a, b, of_b, c

    begin = jnp.where(jnp.any(past), 0, ITERATIONS), shares[first], jnp.maximum(nearest[first], 0.0)
    begin = (*begin, shares[first + 1], nearest[first + 1], shares[first + 1])
    *_, share = lax.while_loop(lambda carry: carry[0] < ITERATIONS, closer, begin)
    least = TIME_ULPS * jnp.finfo(t1.dtype).eps * jnp.maximum(jnp.abs(t1), duration)
    resolved = jnp.any(past) & ((1.0 - share) * duration > least)
    arrives = (left[-1] <= on) & (left[-1] < left[-2])
    after = kept.at[:num].set(jnp.where(arrives, -sides, sides))
    if len(stops):
        after = after.at[stops].set(sides[stops]).at[num : num + len(stops)].add(arrives[stops])
    # A step that would end where it begins would be followed by none but such.
    shortest = jnp.maximum(SHORTEN, least / (2.0 * duration))
    return jnp.where(resolved, jnp.maximum(share, shortest), 1.0), after


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
