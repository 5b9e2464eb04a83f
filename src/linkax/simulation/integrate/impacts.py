"""Impacts: the jump of speeds at a rigid stop, and what a run keeps of them.

Behind the sides of switches the vector y has, for each `linkax.Impact`, how many impacts it had, and what energy they
took. Its side is 1 while motion goes on, `RESTS` where it has come to rest on the stop, and `DRIVEN_IN` where a drive
leads into the stop.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import rates
from linkax.equations.system import System
from linkax.formulations.formulation import linear_system
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.forces.impacts import Impact
from linkax.model.mechanism import Mechanism
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

Problem = Any  # that of `linkax.simulation.integrate.problem`, which imports `switches`

RESTS = -1.0
DRIVEN_IN = -2.0


def impacts_of(mechanism: Mechanism | System) -> list[Impact]:
    """The impacts of a mechanism, in the order of its forces."""
    return [force for force in mechanism.forces if isinstance(force, Impact)]


def places(mechanism: Mechanism | System) -> Int[np.ndarray, " k"]:
    """The indices of impacts among the switches."""
    switches = [force for force in mechanism.forces if force.has_switch]
    return np.array([index for index, force in enumerate(switches) if isinstance(force, Impact)], dtype=int)


def record(mechanism: Mechanism | System, kept: Float[Array, "*batch n"]) -> Float[Array, "*batch 2 k"]:
    """Of y, or what it keeps of switches: numbers of impacts so far, and the energy that they took [J]."""
    first, count = _record_begins(mechanism), len(impacts_of(mechanism))
    return kept[..., first : first + 2 * count].reshape(*kept.shape[:-1], 2, count)


def _record_begins(mechanism):
    return sum(force.has_switch for force in mechanism.forces)


def has_ended(system: System, kept: Float[Array, " kept"]) -> Bool[Array, ""]:
    """Whether no motion of a system with impacts leads on from a stop, by what y keeps of switches."""
    return jnp.any(kept[places(system)] < 0.0)


def is_driven_in(system: System, kept: Float[Array, " kept"]) -> Bool[Array, ""]:
    """Whether a drive leads into a stop, likewise."""
    return jnp.any(kept[places(system)] == DRIVEN_IN)


def struck(problem: Problem, t: Float[Array, ""], y: Float[Array, " n"], index: Int[Array, ""]) -> Float[Array, " n"]:
    """Put the impact of an index into y: speeds after it, its energy, and whether motion leads on.

    v⁺ = v⁻ + M⁻¹ (∇gᵀ Λ + Jᵀ λ) with J (v⁺ − v⁻) = 0, from the constrained solve with the force ∇gᵀ. Where loops and
    drives leave the gap no speed of its own, that solve finds nothing but rounding.
    """
    system, impacts, (q, v) = problem.system, impacts_of(problem.system), problem.unpacked(y)
    of = lambda numbers: jnp.stack([jnp.asarray(number, q.dtype) for number in numbers])[index]

    def closing(q, v):
        """dg/dt."""
        gap = lambda q: jnp.stack([impact.gap(configure(system, t, q)) for impact in impacts])[index]
        return jax.jvp(gap, (q,), (rates(system.topology, q, v),))[1]

    before, row = jax.value_and_grad(closing, argnums=1)(q, v)
    method = problem.method if isinstance(problem.method, TangentSpace) else TangentSpace().prepared(q.dtype)
    linear = linear_system(system, t, q)
    split, none = method.split(lax.stop_gradient(linear)), jnp.zeros(linear.jacobian.shape[0], q.dtype)
    response, _ = method.solve_accelerations(linear, split, row, none, refinements=1)
    largest = jnp.linalg.norm(row * system.scales) * jnp.linalg.norm(response / system.scales)
    gives_way = row @ method.tangential_part(linear, split, response) > jnp.sqrt(jnp.finfo(q.dtype).eps) * largest
    hits = (before < 0.0) & lax.stop_gradient(gives_way)
    factor = 1.0 + of([impact.restitution for impact in impacts])
    change = response * ratio(jnp.where(hits, -factor * before, 0.0), row @ response, 0.0)
    taken = -(v + change / 2.0) @ (linear.mass @ change)
    first, count = _record_begins(system), len(impacts)
    recorded = jnp.asarray(y).at[first + index].add(hits).at[first + count + index].add(taken)
    after = problem.with_speeds(recorded, v + change)
    # Where the gap opens slowly, and forces close it again, infinitely many impacts would follow.
    still = lax.stop_gradient(after)
    opens, pushed = jax.jvp(closing, problem.unpacked(still), problem.unpacked(problem.derivative(t, still)))
    slowest = of([impact.slowest for impact in impacts])
    rests = jnp.where((opens < slowest) & (pushed < 0.0), RESTS, 1.0)
    place = jnp.asarray(places(system))[index]
    return after.at[place].set(jnp.where(opens < -slowest, DRIVEN_IN, rests))
