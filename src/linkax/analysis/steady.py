"""Steady motion: joints that go on at their speeds, as drives ask, and nothing else changes."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import applied_load, inertial_wrench
from linkax.equations.gaps import gaps
from linkax.equations.loops import jacobian, rate
from linkax.equations.motion import Motion
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.state import State
from linkax.spatial.vectors import largest
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import concrete

# Radians, or lengths of the mechanism, after which a motion is looked at again: incommensurable, so that what is
# periodic does not repeat there.
LATER = np.array([0.7, 1.9, 41.0])
AGREES = 1e-6  # of speeds, and of forces

eigh = one_by_one(jnp.linalg.eigh)


def may_move(state: State) -> bool:
    """Whether a state moves, as far as it is known."""
    v = concrete(state.v)
    return v is None or bool(np.any(v != 0.0))


def system_in(mechanism: Mechanism, state: State, t, moves: bool) -> System:
    """The mechanism's numbers, with drives that hold their joints at time t where the state is at rest."""
    system, unless = system_of(mechanism, state.q.dtype), jnp.any(state.v != 0.0) if moves else False
    return dataclasses.replace(system, constraints=tuple(each.held(t, unless) for each in system.constraints))


class Nearby(eqx.Module):
    """A mechanism near closed coordinates q, in coordinates y of the tangent space: q ⊕ T y.

    - `basis`: T, (n_v, n_v), columns orthonormal in a metric, zero where there is no tangent; `dual`: its inverse
      on the tangent space.
    """

    system: System
    method: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    basis: Float[Array, "n_v n_v"]
    dual: Float[Array, "n_v n_v"]

    def at(self, y):
        """Coordinates q."""
        return retract(self.system.topology, self.q, self.basis @ y)

    @staticmethod
    def slopes(function, rest):
        """A function of a vector at `rest`, and its derivative."""
        follow = lambda change: jax.jvp(function, (rest,), (change,))
        return jax.vmap(follow, out_axes=(None, 1))(jnp.eye(len(rest), dtype=rest.dtype))


class Instants(NamedTuple):
    """Where a motion at constant speeds leads: times [s], and what has moved by then, (k,) and (k, n_v)."""

    t: Float[Array, " k"]
    motion: Float[Array, "k n_v"]


def instants(system: System, t, v) -> Instants:
    """At `LATER`."""
    duration = ratio(LATER, lax.stop_gradient(system.fastest(v)), 0.0)
    return Instants(t + duration, duration[:, None] * v)


def widest_gap(system: System, t, q) -> Float[Array, ""]:
    """How far the loops are open, in radians and lengths of the mechanism."""
    return gaps(configure(system, t, q)).in_scales(system).widest()


def missed_rates(system: System, t, q, v) -> Float[Array, " m"]:
    """What the speeds of a state miss of those that the loops and drives ask for, relative to the largest of both."""
    asked = rate(system, t)
    size = jnp.maximum(system.fastest(v), largest(asked))
    return jnp.abs(jacobian(configure(system, t, q)) @ v - asked) / jnp.where(size > 0.0, size, 1.0)


def of_missed_rate(mechanism: Mechanism, missed, row: int, t) -> str:
    """What asks for a rate that speeds miss, and the remedy; of `missed` those of constraints come last."""
    constraint = row - len(missed) + len(mechanism.constraints)
    what = mechanism.constraints[constraint].display_name if constraint >= 0 else "a loop"
    return (
        f"{what} asks for a rate that the state's speeds miss by {missed[row]:.3g} of the largest "
        f"at t = {float(t):.6g} s; make the state with linkax.assemble at that time"
    )


def largest_force(motion: Motion) -> Float[Array, ""]:
    """The sum of sizes of all forces, in balance or not: what rounding of their sum is small against [N m]."""
    load, system = applied_load(motion), motion.system
    force, moment = inertial_wrench(motion, motion.angular_bias[:-1], motion.bias[:-1])
    size = lambda vectors: jnp.sum(jnp.abs(vectors))
    on_bodies = system.length * (size(load.force) + size(force)) + size(load.moment) + size(moment)
    return on_bodies + size(system.scales * load.joint_force)
