"""Bind force elements to values of their internal states, and compute the rates of these."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.model.forces.force import Bound
from linkax.model.forces.internal_states import shapes_of, size_of
from linkax.xla.arrays import Array


def num_states(system: System) -> int:
    """Count the internal states of all force elements."""
    return sum(size_of(shapes_of(force.itself.states)) for force in system.forces)


def bound(system: System, internal: Float[Array, " n_s"] | None) -> System:
    """Bind the force elements of a system to values of their internal states, (n_s,); None where they have none."""
    if internal is None:
        return system
    forces, start = [], 0
    for force in system.forces:
        stop = start + size_of(shapes_of(force.itself.states))
        forces.append(Bound(force.itself, internal[start:stop]) if stop > start else force)
        start = stop
    return dataclasses.replace(system, forces=tuple(forces))


def internal_rates(motion: Motion) -> Float[jax.Array, " n_s"]:
    """Rates of the internal states to which the system of a motion is bound, (n_s,)."""
    rates = [force.state_rates(motion.configuration.t, motion) for force in motion.system.forces]
    return jnp.concatenate(rates)
