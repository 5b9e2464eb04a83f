"""Rows of cut joints by the vectors that they are made of: the paper's Table 1.

With h₁ⁱ, h₂ʲ the joint's axes on parent and child and s the separation of their origins, a rotation row is h₁ⁱ·h₂ʲ and
a translation row h₁ⁱ·s / ℓ, ℓ half the way around the loop. Combined rows are functions of several of these.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import Configuration, bodies_of_cuts
from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.equations.tree_sums import sum_by_speed
from linkax.linalg.static_sparse import StaticSparse, constant_product, products_of_pairs
from linkax.spatial.rotations import transpose
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array


class RowVectors(NamedTuple):
    """The vectors of rotation rows, h₁ⁱ (`first`) and h₂ʲ (`second`), and translation rows, h₁ⁱ (`direction`) and ℓ."""

    rotation_cut: np.ndarray
    translation_cut: np.ndarray
    first: Float[Array, "n_rot 3"]
    second: Float[Array, "n_rot 3"]
    direction: Float[Array, "n_tr 3"]
    length: Float[Array, " n_tr"]


def chosen_rows(
    configuration: Configuration,
    rotation_rows: Sequence[tuple[int, int, int]],
    translation_rows: Sequence[tuple[int, int]],
) -> RowVectors:
    rotation = np.array(rotation_rows, dtype=int).reshape(-1, 3)
    translation = np.array(translation_rows, dtype=int).reshape(-1, 2)
    columns, other = transpose(configuration.parent_axes), transpose(configuration.child_axes)
    return RowVectors(
        rotation_cut=rotation[:, 0],
        translation_cut=translation[:, 0],
        first=columns[rotation[:, 0], rotation[:, 1]],
        second=other[rotation[:, 0], rotation[:, 2]],
        direction=columns[translation[:, 0], translation[:, 1]],
        length=configuration.system.loop_length[translation[:, 0]],
    )


def plain_rows(configuration: Configuration) -> RowVectors:
    """The rotation and translation rows that motion can change."""
    topology = configuration.system.topology
    return chosen_rows(configuration, topology.rotation_rows, topology.translation_rows)


def immobile_rows(configuration: Configuration) -> RowVectors:
    """The rotation and translation rows that no motion can change."""
    topology = configuration.system.topology
    return chosen_rows(configuration, topology.immobile_rotation_rows, topology.immobile_translation_rows)


def combined_rows(configuration: Configuration) -> RowVectors:
    """The rotation and translation rows that combined rows are functions of."""
    topology = configuration.system.topology
    kinds = topology.cut_types
    rotations = [(cut, i, j) for cut in topology.combining for i, j in kinds[cut].combined_rotations]
    translations = [(cut, i) for cut in topology.combining for i in kinds[cut].combined_translations]
    return chosen_rows(configuration, rotations, translations)


def combine(system: System, rows: Float[Array, " n"]) -> Float[Array, " n_combined"]:
    """Combined rows from those of `combined_rows`."""
    topology, found = system.topology, []
    kinds = topology.cut_types
    count = sum(len(kinds[cut].combined_rotations) for cut in topology.combining)
    rotations, translations = rows[:count], rows[count:]
    for cut in topology.combining:
        turns, moves = len(kinds[cut].combined_rotations), len(kinds[cut].combined_translations)
        number = system.joint_parameter[topology.num_bodies + cut] / system.loop_length[cut]
        found.append(kinds[cut].combined(rotations[:turns], translations[:moves], number))
        rotations, translations = rotations[turns:], translations[moves:]
    return jnp.stack(found)


def row_residual(configuration: Configuration, rows: RowVectors) -> Float[Array, " n"]:
    rotation = dot(rows.first, rows.second)
    translation = dot(rows.direction, configuration.separation[rows.translation_cut]) / rows.length
    return jnp.concatenate([rotation, translation])


def row_jacobian(configuration: Configuration, rows: RowVectors) -> StaticSparse:
    topology = configuration.system.topology
    parent, child, joints = bodies_of_cuts(topology)
    # The twist of each joint at the point where the loop is cut, reached along its own side.
    on_child = configuration.position[child] + configuration.child_arm[joints]
    on_parent = configuration.position[parent] + configuration.parent_arm[joints] + configuration.separation
    at, along, around = rows.translation_cut, rows.direction / rows.length[:, None], cross(rows.second, rows.first)
    loop, count = topology.loop[:, topology.moved_body], len(rows.rotation_cut)
    sign = np.concatenate([loop[rows.rotation_cut], loop[at]])
    first = np.concatenate([np.arange(count), 2 * count + np.arange(len(at))])[:, None]
    other = first + np.concatenate([np.full(count, count), np.full(len(at), len(at))])[:, None]
    turning = jnp.concatenate([around, -around, cross(on_child[at], along), -cross(on_parent[at], along)])
    moving = jnp.concatenate([jnp.zeros((2 * count, 3), along.dtype), along, -along])
    found = products_of_pairs(
        np.where(sign > 0.0, first, np.where(sign < 0.0, other, -1)),
        np.broadcast_to(np.arange(sign.shape[1]), sign.shape),
        jnp.concatenate([turning, moving], axis=1),
        jnp.concatenate([configuration.angular, configuration.linear], axis=1),
    )
    return found if topology.motion_column is None else StaticSparse.whole(sum_by_speed(topology, found.dense()))


def combination(configuration: Configuration) -> tuple[Float[Array, " n"], Float[Array, "n n_v"]]:
    """Values of the rows that combined rows are functions of, and their Jacobian."""
    rows = combined_rows(configuration)
    return row_residual(configuration, rows), row_jacobian(configuration, rows).dense()


def combining_factors(configuration: Configuration, values: Float[Array, " n"]) -> Float[Array, "n_combined n"]:
    return jax.jacfwd(lambda values: combine(configuration.system, values))(values)


def row_gamma(motion: Motion, rows: RowVectors) -> Float[Array, " n"]:
    """γ of rotation and translation rows: minus the terms of c̈ without v̇.

    A rotation row has c̈ = n·α + ṅ·ω with n = h₂ʲ × h₁ⁱ and ω, α the child's angular velocity and acceleration relative
    to the parent; a translation row has ℓ c̈ = h₁ⁱ·(s̈ − 2 ω₁ × ṡ − α₁ × s + ω₁ × (ω₁ × s)), s̈ and ṡ in ground axes
    and ω₁, α₁ of the parent.
    """
    configuration, topology = motion.configuration, motion.system.topology
    parent, child, joints = bodies_of_cuts(topology)
    separation = configuration.separation
    around = partial(constant_product, topology.loop)
    omega, alpha = motion.angular_velocity, motion.angular_bias

    at = rows.rotation_cut
    turning = around(motion.edge_turn)[at]
    turning_bias = around(motion.edge_angular_bias)[at]
    second_rate, first_rate = cross(omega[child[at]], rows.second), cross(omega[parent[at]], rows.first)
    normal = cross(rows.second, rows.first)
    normal_rate = cross(second_rate, rows.first) + cross(rows.second, first_rate)
    rotation = dot(normal, turning_bias) + dot(normal_rate, turning)

    def arm_rate(bodies, arms):
        return cross(omega[bodies], arms)

    def arm_bias(bodies, arms):
        return cross(alpha[bodies], arms) + cross(omega[bodies], arm_rate(bodies, arms))

    parent_arm, child_arm = configuration.parent_arm[joints], configuration.child_arm[joints]
    rate = around(motion.edge_rate) + arm_rate(child, child_arm) - arm_rate(parent, parent_arm)
    acceleration = around(motion.edge_bias) + arm_bias(child, child_arm) - arm_bias(parent, parent_arm)
    # Seen from the parent: Coriolis and the parent's own turning taken off.
    seen = acceleration - 2.0 * cross(omega[parent], rate) - cross(alpha[parent], separation)
    seen = seen + cross(omega[parent], cross(omega[parent], separation))
    translation = dot(rows.direction, seen[rows.translation_cut]) / rows.length
    return -jnp.concatenate([rotation, translation])
