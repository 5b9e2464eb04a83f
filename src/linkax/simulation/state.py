"""A state of motion, and the joints' coordinates in it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from linkax.equations.kinematics import configure
from linkax.equations.loops import cut_frames, measure
from linkax.equations.system import System


class State(eqx.Module):
    """Coordinates and speeds of the joints in the spanning tree, in the tree's order.

    - `q`: coordinates [rad or m], (n_q,). `v`: speeds [rad/s or m/s], (n_v,).

    `linkax.assemble` makes a consistent one from the joints' names.
    """

    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]


def joint_coordinates(system: System, name: str, q) -> Float[Array, " n"]:
    """Coordinates of a joint, in the tree or cut, at coordinates q [rad or m]."""
    topology = system.topology
    if name in topology.coordinates:
        return q[topology.coordinates[name]]
    return measure(cut_frames(configure(system, q)), topology.joints.index(name))


def wrapped(angles, is_angle):
    """Differences of angles brought into [-π, π); lengths left as they are."""
    return jnp.where(is_angle, jnp.mod(angles + jnp.pi, 2.0 * jnp.pi) - jnp.pi, angles)
