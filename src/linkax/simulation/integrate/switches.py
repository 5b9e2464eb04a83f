"""Switches of force elements: the side of each that a motion is on, and steps that end at them.

Each step is computed with all force elements held on the sides on which it begins, so that nothing in it has a kink.
A step that goes past a switch is tried again, up to there, and the next begins on the other side.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

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
from linkax.model.forces import AbstractForce, Load, has_switch
from linkax.xla.arrays import Array

SAMPLES = 8  # of a step: between two of them a force element must not switch twice
ON_ULPS = 256.0  # of a switch: what counts as there
TIME_ULPS = 8.0
SHORTEN = 1e-3  # a step that begins past a switch
ITERATIONS = 60

Sides = Float[Array, " m"] | tuple[()]  # of all switches, 1 or −1; () without switches
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
    """Hold the force elements of a system on the given sides of their switches, (m,), 1 or −1."""
    each = iter(sides)
    forces = tuple(Held(force, next(each)) if has_switch(force) else force for force in system.forces)
    return dataclasses.replace(system, forces=forces, known=None)


def values(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Float[Array, " m"]:
    """Values of all switches of force elements, (m,)."""
    motion = move(configure(system, t, q), v)
    return jnp.stack([force.switched(t, motion) for force in system.forces if has_switch(force)])


def start_sides(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Sides:
    """The sides of switches, (m,), 1 or −1, at a state; () without switches."""
    if not any(map(has_switch, system.forces)):
        return ()
    return jnp.where(values(system, t, q, v) > 0.0, 1.0, -1.0).astype(q.dtype)


def meet(
    problem: Problem,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    y0: Float[Array, " n"],
    y1: Float[Array, " n"],
    within: Callable[[Float[Array, ""]], Float[Array, " n"]],
) -> tuple[Float[Array, ""], Float[Array, " m"]]:
    """Find where a step goes past a switch, and on which sides it ends.

    **Arguments:** `within(t)`: interpolates in the step.

    **Returns:** the share of the step up to the first switch, one for none; the sides after a step that goes past none.
    """
    sides, on = problem.sides(y0), ON_ULPS * jnp.finfo(y0.dtype).eps
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
    return jnp.where(resolved, jnp.maximum(share, SHORTEN), 1.0), jnp.where(arrives, -sides, sides)


def crossed(problem: Problem, t: Float[Array, ""], y: Float[Array, " n"], sides: Sides) -> Float[Array, " n"]:
    """Put a state on other sides of its switches; its derivative knows that the time of crossing moves.

    Where forces jump, a later crossing changes the motion after it: (f₋ − f₊) dt, with dt = −dg / ġ for a
    switch g (the saltation matrix; Leine and Nijmeijer (2004), Dynamics and Bifurcations of Non-Smooth Mechanical
    Systems, ch. 7). Forces with a kink alone do not jump.
    """
    before = problem.sides(y)
    if not len(before):
        return y
    crosses = sides != before

    def jumps(y):
        each = jnp.concatenate([before[None], jnp.where(np.eye(len(before), dtype=bool), -before, before)])
        rates = jax.vmap(lambda sides: problem.derivative(t, problem.on_sides(y, sides)))(each)
        _, speeds = jax.jvp(problem.switches, (t, y), (jnp.ones_like(t), rates[0]))
        moves = crosses & (speeds != 0.0)
        jump = (rates[0] - rates[1:]) / jnp.where(moves, speeds, 1.0)[:, None]
        return jnp.where(moves[:, None], jump, 0.0)

    none = jnp.zeros((len(before), len(y)), y.dtype)
    jump = lax.cond(jnp.any(crosses), jumps, lambda y: none, lax.stop_gradient(y))
    value = problem.switches(t, y)
    delay = lax.stop_gradient(value) - value
    return problem.on_sides(y + delay @ lax.stop_gradient(jump), sides)
