"""Coordinates q that are not all integrals of speeds v: unit quaternions among them.

Without a quaternion q̇ = v, and all of this is addition. A quaternion turns the parent's axes into the child's; its
angular velocity is in axes of the parent.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Float, Int

from linkax.model.topology import Topology
from linkax.spatial.quaternions import conjugate, from_rotation_vector, multiply, normalised
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array
from linkax.xla.static_scatter import scatter_static


def quaternion_places(topology: Topology) -> tuple[Int[np.ndarray, "n 4"], Int[np.ndarray, "n 3"]]:
    """Indices of quaternions in q, and of their angular velocities in v."""
    starts = topology.quaternions
    return starts[:, :1] + np.arange(4), starts[:, 1:] + np.arange(3)


def _of_plain(topology, v):
    """Put speeds (n_v,) at their coordinates (n_q,); zero for quaternions."""
    return scatter_static(jnp.zeros(topology.num_coordinates, v.dtype), topology.plain[:, 0], v[topology.plain[:, 1]])


def neutral(topology: Topology, dtype: DTypeLike) -> Float[Array, " n_q"]:
    """Coordinates at which the frames of every joint in the tree coincide."""
    q = np.zeros(topology.num_coordinates)
    q[topology.quaternions[:, 0]] = 1.0
    return jnp.asarray(q, dtype)


def retract(topology: Topology, q: Float[Array, " n_q"], change: Float[Array, " n_v"]) -> Float[Array, " n_q"]:
    """Add a finite change (n_v,) to coordinates: q ⊕ δ."""
    if not len(topology.quaternions):
        return q + change
    in_q, in_v = quaternion_places(topology)
    turned = normalised(multiply(from_rotation_vector(change[in_v]), q[in_q]))
    return scatter_static(q + _of_plain(topology, change), in_q, turned)


def turn_rate(topology: Topology, v: Float[Array, " n_v"], change: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
    """The rate of a small change of q that is carried along at speeds v: quaternions turn it, by ω × δ."""
    if not len(topology.quaternions):
        return jnp.zeros_like(change)
    _, in_v = quaternion_places(topology)
    return scatter_static(jnp.zeros_like(change), in_v, cross(v[in_v], change[in_v]))


def on_manifold(topology: Topology, q: Float[Array, " n_q"]) -> Float[Array, " n_q"]:
    """Normalise the quaternions."""
    if not len(topology.quaternions):
        return q
    in_q, _ = quaternion_places(topology)
    return scatter_static(q, in_q, normalised(q[in_q]))


def rates(topology: Topology, q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Float[Array, " n_q"]:
    """q̇ at speeds v."""
    if not len(topology.quaternions):
        return v
    in_q, in_v = quaternion_places(topology)
    return scatter_static(_of_plain(topology, v), in_q, _quaternion_rates(q[in_q], v[in_v]))


def joint_rates(has_quaternion: bool, q: Float[Array, " n"], v: Float[Array, " k"]) -> Float[Array, " n"]:
    """Rates of one joint's coordinates at its speeds."""
    if not has_quaternion:
        return v
    return jnp.concatenate([_quaternion_rates(q[:4], v[:3]), v[3:]])


def _quaternion_rates(quaternion, omega):
    return 0.5 * multiply(jnp.concatenate([jnp.zeros_like(omega[..., :1]), omega], axis=-1), quaternion)


def speeds(topology: Topology, q: Float[Array, " n_q"], rates: Float[Array, " n_q"]) -> Float[Array, " n_v"]:
    """The speeds v with rates q̇; small changes of q likewise."""
    if not len(topology.quaternions):
        return rates
    in_q, in_v = quaternion_places(topology)
    omega = 2.0 * multiply(rates[in_q], conjugate(q[in_q]))[:, 1:]
    return scatter_static(coordinates_by_speed(topology, rates), in_v, omega)


def coordinates(
    topology: Topology, by_speed: Float[Array, " n_v"], quaternions: Float[Array, "n 4"]
) -> Float[Array, " n_q"]:
    """Coordinates q of those by speed, see `coordinates_by_speed`, and of quaternions."""
    plain = _of_plain(topology, by_speed)
    return scatter_static(plain, quaternion_places(topology)[0], quaternions) if len(topology.quaternions) else plain


def coordinates_by_speed(topology: Topology, q: Float[Array, " n_q"]) -> Float[Array, " n_v"]:
    """The coordinate of each speed, (n_v,); zero for those of quaternions."""
    if not len(topology.quaternions):
        return q
    return scatter_static(jnp.zeros(topology.num_speeds, q.dtype), topology.plain[:, 1], q[topology.plain[:, 0]])
