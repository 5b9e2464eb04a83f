"""Loop constraints: c(q, t) = 0, J v = b, J v̇ = γ.

Rows of cut joints are those of the paper's Table 1: with h₁ⁱ, h₂ʲ the joint's axes on parent and
child and s the separation of their origins, a rotation row is h₁ⁱ·h₂ʲ and a translation row
h₁ⁱ·s / ℓ, ℓ half the way around the loop. Some joint types combine several of these in one row. The
last rows are constraints on coordinates of the tree and ropes, in radians and lengths of the mechanism.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.equations.configuration import Configuration, along_speeds, bodies_of_cuts, sum_by_speed
from linkax.equations.coordinates import coordinates_by_speed
from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.linalg.static_sparse import StaticSparse, constant_product, products_of_pairs
from linkax.model.ropes import Rope
from linkax.spatial.rotations import rotate, transpose
from linkax.spatial.vectors import cross, dot
from linkax.xla.tracing import jit_inline

FLIP_WEIGHT = 2.0  # more than one: axes that point apart are farther from being in line than those at a right angle


class RowVectors(NamedTuple):
    """The vectors that rows of cut joints are made of: h₁ⁱ and h₂ʲ, and h₁ⁱ with its loop's ℓ."""

    rotation_cut: np.ndarray
    translation_cut: np.ndarray
    first: Float[Array, "n_rot 3"]
    second: Float[Array, "n_rot 3"]
    direction: Float[Array, "n_tr 3"]
    length: Float[Array, " n_tr"]


def _chosen(configuration: Configuration, rotation_rows, translation_rows) -> RowVectors:
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
    return _chosen(configuration, topology.rotation_rows, topology.translation_rows)


def immobile_rows(configuration: Configuration) -> RowVectors:
    """The rotation and translation rows that no motion can change."""
    topology = configuration.system.topology
    return _chosen(configuration, topology.immobile_rotation_rows, topology.immobile_translation_rows)


def combined_rows(configuration: Configuration) -> RowVectors:
    """The rotation and translation rows that combined rows are functions of."""
    topology = configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    rotations = [(cut, i, j) for cut in topology.combining for i, j in kinds[cut].combined_rotations]
    translations = [(cut, i) for cut in topology.combining for i in kinds[cut].combined_translations]
    return _chosen(configuration, rotations, translations)


def _combine(system: System, rows: Float[Array, " n"]) -> Float[Array, " n_combined"]:
    """Combined rows from those of `combined_rows`."""
    topology, found = system.topology, []
    kinds = topology.joint_types[topology.num_bodies :]
    count = sum(len(kinds[cut].combined_rotations) for cut in topology.combining)
    rotations, translations = rows[:count], rows[count:]
    for cut in topology.combining:
        turns, moves = len(kinds[cut].combined_rotations), len(kinds[cut].combined_translations)
        number = system.joint_parameter[topology.num_bodies + cut] / system.loop_length[cut]
        found.append(kinds[cut].combined(rotations[:turns], translations[:moves], number))
        rotations, translations = rotations[turns:], translations[moves:]
    return jnp.stack(found)


def _residual(configuration: Configuration, rows: RowVectors):
    rotation = dot(rows.first, rows.second)
    translation = dot(rows.direction, configuration.separation[rows.translation_cut]) / rows.length
    return jnp.concatenate([rotation, translation])


def _right_sides(system: System, t):
    """Right sides of the constraints on coordinates, (k,)."""
    sides = [jnp.asarray(constraint.right_side(t), system.dtype) for constraint in system.constraints]
    return jnp.stack(sides) / system.coupling_unit


def is_driven(system: System) -> bool:
    """Whether a constraint moves the mechanism with time."""
    return any(constraint.is_driven for constraint in system.constraints)


def ropes(system: System) -> list[tuple[int, Rope]]:
    """The ropes, and which of the constraints they are."""
    return [(row, rope) for row, rope in enumerate(system.constraints) if isinstance(rope, Rope)]


def residual(configuration: Configuration) -> Float[Array, " m"]:
    """c(q, t): the rows that motion can change."""
    system = configuration.system
    rows = [_residual(configuration, plain_rows(configuration))]
    if system.topology.combining:
        rows.append(_combine(system, _residual(configuration, combined_rows(configuration))))
    if system.constraints:
        coordinates = coordinates_by_speed(system.topology, configuration.q)
        values = system.coupling @ coordinates
        for row, rope in ropes(system):
            values = values.at[row].set(rope.value(configuration))
        rows.append(values / system.coupling_unit - _right_sides(system, configuration.t))
    return jnp.concatenate(rows)


def immobile_residual(configuration: Configuration) -> Float[Array, " m_immobile"]:
    """The rows that no motion can change; nonzero where the loop cannot be closed."""
    return _residual(configuration, immobile_rows(configuration))


def _jacobian(configuration: Configuration, rows: RowVectors) -> StaticSparse:
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


def _combination(configuration: Configuration):
    """Values of the rows that combined rows are functions of, and their Jacobian."""
    rows = combined_rows(configuration)
    return _residual(configuration, rows), _jacobian(configuration, rows).dense()


def _combining_factors(configuration: Configuration, values) -> Float[Array, "n_combined n"]:
    return jax.jacfwd(lambda values: _combine(configuration.system, values))(values)


def jacobian(configuration: Configuration) -> Float[Array, "m n_v"]:
    """J = ∂ċ/∂v."""
    return jacobian_entries(configuration).dense()


def jacobian_entries(configuration: Configuration) -> StaticSparse:
    """`jacobian` by its entries: those of speeds that move a loop."""
    system = configuration.system
    rows = [_jacobian(configuration, plain_rows(configuration))]
    if system.topology.combining:
        values, slopes = _combination(configuration)
        rows.append(StaticSparse.whole(_combining_factors(configuration, values) @ slopes))
    if system.constraints:
        slopes = system.coupling
        for row, rope in ropes(system):
            unit_load = rope.load(configuration, 1.0)
            slopes = slopes.at[row].set(along_speeds(configuration, unit_load.force, unit_load.moment))
        rows.append(StaticSparse.whole(slopes / system.coupling_unit[:, None]))
    return StaticSparse.stacked(rows)


def rate(system: System, t) -> Float[Array, " m"]:
    """b of J v = b: what drives ask for."""
    nothing = jnp.zeros(system.topology.num_rows, system.dtype)
    if not is_driven(system):
        return nothing
    sides = jax.jvp(lambda t: _right_sides(system, t), (t,), (jnp.ones_like(t),))[1]
    return nothing.at[-len(system.constraints) :].set(sides)


def drive_acceleration(system: System, t) -> Float[Array, " m"]:
    """The part of γ that drives ask for."""
    nothing = jnp.zeros(system.topology.num_rows, system.dtype)
    if not is_driven(system):
        return nothing
    sides = jax.jvp(lambda t: rate(system, t), (t,), (jnp.ones_like(t),))[1]
    return sides


def _bias(motion: Motion, rows: RowVectors):
    """Minus all terms of c̈ that velocities alone cause, of rotation and translation rows."""
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


@jit_inline
def velocity_gamma(motion: Motion) -> Float[Array, " m"]:
    """γ of J v̇ = γ less `drive_acceleration`: quadratic in the speeds."""
    system, configuration = motion.system, motion.configuration
    rows = [_bias(motion, plain_rows(configuration))]
    if system.topology.combining:
        values, slopes = _combination(configuration)
        turn = slopes @ motion.v
        combine = lambda values: _combine(system, values)
        along = lambda values: jax.jvp(combine, (values,), (turn,))[1]
        bent = jax.jvp(along, (values,), (turn,))[1]
        factors = _combining_factors(configuration, values)
        rows.append(factors @ _bias(motion, combined_rows(configuration)) - bent)
    if system.constraints:
        biases = jnp.zeros(len(system.constraints), system.dtype)
        for row, rope in ropes(system):
            biases = biases.at[row].set(rope.bias(motion) / system.coupling_unit[row])
        rows.append(biases)
    return jnp.concatenate(rows)


def gamma(motion: Motion) -> Float[Array, " m"]:
    """γ of J v̇ = γ."""
    return velocity_gamma(motion) + drive_acceleration(motion.system, motion.configuration.t)


class Multipliers(NamedTuple):
    """Multipliers sorted by what they act on.

    - `plain`, `combined`: of the rows of cut joints in `plain_rows` and `combined_rows`.
    - `constraints`: generalised force of each constraint on coordinates, per unit of coefficient; of ropes their
      tension.
    """

    plain: Float[Array, " n"]
    combined: Float[Array, " n"]
    constraints: Float[Array, " k"]


def sorted_multipliers(configuration: Configuration, multipliers: Float[Array, " m"]) -> Multipliers:
    """The multipliers λ of all rows by what they act on."""
    system, topology = configuration.system, configuration.system.topology
    count = topology.num_rows - len(system.constraints)
    plain, combined, constraints = jnp.split(multipliers, [count - len(topology.combining), count])
    if topology.combining:
        combined = combined @ _combining_factors(configuration, _residual(configuration, combined_rows(configuration)))
    return Multipliers(plain, combined, constraints / system.coupling_unit)


def locked_separation(configuration: Configuration) -> Float[Array, "n_cut 3"]:
    """The part of the separations along locked directions, in joint axes of the parent [m]."""
    topology = configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    locked = np.array([[i in kind.locked_translations for i in range(3)] for kind in kinds]).reshape(-1, 3)
    return jnp.where(locked, rotate(transpose(configuration.parent_axes), configuration.separation), 0.0)


def as_if_closed(configuration: Configuration) -> Configuration:
    """The same configuration without the separations that should not be there.

    The Jacobian of it is the better direction to close a loop in from far away: rows along
    axes that turn with the parent would otherwise trade turning against closing.
    """
    apart = rotate(configuration.parent_axes, locked_separation(configuration))
    return eqx.tree_at(lambda c: c.separation, configuration, configuration.separation - apart)


def flips(configuration: Configuration):
    """Rows that vanish unless axes that a cut joint holds in line point apart, and their Jacobian.

    Locked rotations alone would also be satisfied by axes that point opposite ways.
    """
    topology = configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    rows = _chosen(configuration, [(cut, i, i) for cut, kind in enumerate(kinds) for i in kind.aligned_axes], [])
    cosine, slopes = _residual(configuration, rows), _jacobian(configuration, rows).dense()
    apart = cosine < 0.0
    return jnp.where(apart, FLIP_WEIGHT * cosine, 0.0), jnp.where(apart[:, None], FLIP_WEIGHT * slopes, 0.0)


class Gap(NamedTuple):
    """How far constraints are open.

    - `distance`: of each cut joint along its locked directions [m], its combined row included;
      `angle`: between axes that it holds in line [rad], (n_cut,) each.
    - `constraints`: of each constraint on coordinates, in the units of its sum, (k,).
    """

    distance: Float[Array, " n_cut"]
    angle: Float[Array, " n_cut"]
    constraints: Float[Array, " k"]

    def in_scales(self, system: System) -> "Gap":
        """The same in radians and lengths of the mechanism."""
        return Gap(self.distance / system.length, self.angle, self.constraints / system.coupling_unit)

    def widest(self) -> Float[Array, ""]:
        """The largest of all; not a number where one is none."""
        return jnp.max(jnp.concatenate(self), initial=0.0)


def gaps(configuration: Configuration) -> Gap:
    """How far constraints are open, rows that no motion changes included."""
    system, topology = configuration.system, configuration.system.topology
    kinds = topology.joint_types[topology.num_bodies :]
    held = np.array([[i in kind.aligned_axes for i in range(3)] for kind in kinds]).reshape(-1, 3)
    parent_axes, child_axes = configuration.parent_axes, configuration.child_axes
    across = jnp.linalg.norm(cross(transpose(parent_axes), transpose(child_axes)), axis=-1)
    angle = jnp.arctan2(across, jnp.sum(parent_axes * child_axes, axis=-2))
    rows = residual(configuration)
    first, last = topology.num_rows - len(topology.combining) - len(system.constraints), len(system.constraints)
    combined = jnp.zeros(topology.num_cuts, system.dtype)
    if topology.combining:
        cuts = np.array(topology.combining)
        combined = combined.at[cuts].set(rows[first : topology.num_rows - last] * system.loop_length[cuts])
    distance = jnp.concatenate([locked_separation(configuration), combined[:, None]], axis=1)
    return Gap(
        distance=jnp.linalg.norm(distance, axis=-1),
        angle=jnp.max(jnp.where(held, angle, 0.0), axis=-1, initial=0.0),
        constraints=jnp.abs(rows[topology.num_rows - last :] * system.coupling_unit),
    )
