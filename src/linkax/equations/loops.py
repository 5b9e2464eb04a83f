"""Loop constraints of the cut joints: c(q) = 0, J v = 0, J v̇ = γ, rows of the paper's Table 1.

With h₁ⁱ, h₂ʲ the joint's axes on parent and child and s the separation of their origins, a
rotation row is h₁ⁱ·h₂ʲ and a translation row h₁ⁱ·s / ℓ, ℓ half the way around the loop.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.equations.kinematics import Configuration, Motion
from linkax.spatial.rotations import compose, cross, dot, rotate, transpose


class Cuts(eqx.Module):
    """The two sides of every cut joint, in ground axes.

    - `parent_axes`, `child_axes`: h₁ and h₂ as columns, (n_cut, 3, 3).
    - `separation`: from the origin on the parent to that on the child [m], (n_cut, 3). It is
      summed around the loop from the common ancestor, not from the world's origin.
    """

    configuration: Configuration
    parent_axes: Float[Array, "n_cut 3 3"]
    child_axes: Float[Array, "n_cut 3 3"]
    separation: Float[Array, "n_cut 3"]


def bodies_of_cuts(topology):
    """Parent and child body of each cut joint, and the joints' indices."""
    cuts = np.arange(topology.num_bodies, len(topology.joints))
    return np.array(topology.parent, dtype=int)[cuts], np.array(topology.child, dtype=int)[cuts], cuts


def cut_frames(configuration: Configuration) -> Cuts:
    """Axes and separations of all cut joints."""
    system, topology = configuration.system, configuration.system.topology
    parent, child, cuts = bodies_of_cuts(topology)

    def anchor(body):
        root = topology.root[body]
        return system.anchor[np.where(root < 0, cuts, root)]

    around = jnp.asarray(topology.loop, system.dtype) @ configuration.link
    ends = configuration.child_arm[cuts] - configuration.parent_arm[cuts]
    return Cuts(
        configuration=configuration,
        parent_axes=configuration.joint_axes[cuts],
        child_axes=compose(configuration.rotation[child], system.child_axes[cuts]),
        separation=around + ends + (anchor(child) - anchor(parent)),
    )


class Rows(NamedTuple):
    """The vectors that the chosen rows are made of: h₁ⁱ and h₂ʲ, and h₁ⁱ with its loop's ℓ."""

    rotation_cut: np.ndarray
    translation_cut: np.ndarray
    first: Float[Array, "n_rot 3"]
    second: Float[Array, "n_rot 3"]
    direction: Float[Array, "n_tr 3"]
    length: Float[Array, " n_tr"]


def mobile_rows(cuts: Cuts) -> Rows:
    """The rows that motion can change, rotation rows first."""
    topology = cuts.configuration.system.topology
    return _chosen(cuts, topology.rotation_rows, topology.translation_rows)


def _chosen(cuts: Cuts, rotation_rows, translation_rows) -> Rows:
    rotation = np.array(rotation_rows, dtype=int).reshape(-1, 3)
    translation = np.array(translation_rows, dtype=int).reshape(-1, 2)
    columns, other = transpose(cuts.parent_axes), transpose(cuts.child_axes)
    return Rows(
        rotation_cut=rotation[:, 0],
        translation_cut=translation[:, 0],
        first=columns[rotation[:, 0], rotation[:, 1]],
        second=other[rotation[:, 0], rotation[:, 2]],
        direction=columns[translation[:, 0], translation[:, 1]],
        length=cuts.configuration.system.loop_length[translation[:, 0]],
    )


def _residual(cuts: Cuts, rows: Rows):
    rotation = dot(rows.first, rows.second)
    translation = dot(rows.direction, cuts.separation[rows.translation_cut]) / rows.length
    return jnp.concatenate([rotation, translation])


def residual(cuts: Cuts) -> Float[Array, " m"]:
    """c(q): the rows that motion can change."""
    return _residual(cuts, mobile_rows(cuts))


def immobile_residual(cuts: Cuts) -> Float[Array, " m_immobile"]:
    """The rows that no motion can change; nonzero where the loop cannot be closed."""
    topology = cuts.configuration.system.topology
    return _residual(cuts, _chosen(cuts, topology.immobile_rotation_rows, topology.immobile_translation_rows))


def jacobian(cuts: Cuts) -> Float[Array, "m n_v"]:
    """J = ∂ċ/∂v."""
    configuration, topology = cuts.configuration, cuts.configuration.system.topology
    parent, child, joints = bodies_of_cuts(topology)
    rows, body = mobile_rows(cuts), topology.column_body
    loop = topology.loop[:, body]
    turning = cross(rows.second, rows.first) @ configuration.angular.T
    # The twist of each joint at the point where the loop is cut, reached along its own side.
    on_child = configuration.position[child] + configuration.child_arm[joints]
    on_parent = configuration.position[parent] + configuration.parent_arm[joints] + cuts.separation
    at, along = rows.translation_cut, rows.direction
    swept = jnp.where(
        loop[at] > 0.0,
        cross(on_child[at], along) @ configuration.angular.T,
        cross(on_parent[at], along) @ configuration.angular.T,
    )
    moving = (along @ configuration.linear.T + swept) / rows.length[:, None]
    signs = jnp.asarray(np.concatenate([loop[rows.rotation_cut], loop[at]]), along.dtype)
    return signs * jnp.concatenate([turning, moving])


def bias(cuts: Cuts, motion: Motion) -> Float[Array, " m"]:
    """γ of J v̇ = γ: minus all terms of c̈ that velocities alone cause."""
    configuration, topology = motion.configuration, motion.system.topology
    parent, child, joints = bodies_of_cuts(topology)
    rows, loop = mobile_rows(cuts), jnp.asarray(topology.loop, cuts.separation.dtype)
    omega, alpha = motion.angular_velocity, motion.angular_bias

    at = rows.rotation_cut
    turning = (loop @ motion.edge_turn)[at]
    turning_bias = (loop @ motion.edge_angular_bias)[at]
    second_rate, first_rate = cross(omega[child[at]], rows.second), cross(omega[parent[at]], rows.first)
    normal = cross(rows.second, rows.first)
    normal_rate = cross(second_rate, rows.first) + cross(rows.second, first_rate)
    rotation = dot(normal, turning_bias) + dot(normal_rate, turning)

    def arm_rate(bodies, arms):
        return cross(omega[bodies], arms)

    def arm_bias(bodies, arms):
        return cross(alpha[bodies], arms) + cross(omega[bodies], arm_rate(bodies, arms))

    parent_arm, child_arm = configuration.parent_arm[joints], configuration.child_arm[joints]
    rate = loop @ motion.edge_rate + arm_rate(child, child_arm) - arm_rate(parent, parent_arm)
    acceleration = loop @ motion.edge_bias + arm_bias(child, child_arm) - arm_bias(parent, parent_arm)
    # Seen from the parent: Coriolis and the parent's own turning taken off.
    seen = acceleration - 2.0 * cross(omega[parent], rate) - cross(alpha[parent], cuts.separation)
    seen = seen + cross(omega[parent], cross(omega[parent], cuts.separation))
    translation = dot(rows.direction, seen[rows.translation_cut]) / rows.length
    return -jnp.concatenate([rotation, translation])


def locked_separation(cuts: Cuts) -> Float[Array, "n_cut 3"]:
    """The part of the separations along locked directions, in joint axes of the parent [m]."""
    topology = cuts.configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    locked = np.array([[i in kind.locked_translations for i in range(3)] for kind in kinds]).reshape(-1, 3)
    return jnp.where(locked, rotate(transpose(cuts.parent_axes), cuts.separation), 0.0)


def as_if_closed(cuts: Cuts) -> Cuts:
    """The same cuts without the separation that should not be there.

    The Jacobian of these is the better direction to close a loop in from far away: rows along
    axes that turn with the parent would otherwise trade turning against closing.
    """
    return eqx.tree_at(
        lambda c: c.separation, cuts, cuts.separation - rotate(cuts.parent_axes, locked_separation(cuts))
    )


class Gap(NamedTuple):
    """How far each cut joint is open.

    - `distance`: along its locked directions [m]; `angle`: between axes that it holds in line
      [rad], (n_cut,) each.
    """

    distance: Float[Array, " n_cut"]
    angle: Float[Array, " n_cut"]


def gaps(cuts: Cuts) -> Gap:
    """How far each cut joint is open, rows that no motion changes included."""
    topology = cuts.configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    held = np.array([[i in kind.aligned_axes for i in range(3)] for kind in kinds]).reshape(-1, 3)
    across = jnp.linalg.norm(cross(transpose(cuts.parent_axes), transpose(cuts.child_axes)), axis=-1)
    angle = jnp.arctan2(across, jnp.sum(cuts.parent_axes * cuts.child_axes, axis=-2))
    return Gap(
        distance=jnp.linalg.norm(locked_separation(cuts), axis=-1),
        angle=jnp.max(jnp.where(held, angle, 0.0), axis=-1, initial=0.0),
    )


def measure(cuts: Cuts, joint: int) -> Float[Array, " n"]:
    """Coordinates of the cut joint of that index in the mechanism's joints [rad, m]."""
    topology = cuts.configuration.system.topology
    cut = joint - topology.num_bodies
    axes = cuts.parent_axes[cut]
    kind = topology.joint_types[joint]
    return kind.measure(axes.T @ cuts.child_axes[cut], axes.T @ cuts.separation[cut])
