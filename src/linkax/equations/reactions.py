"""Reactions of all joints from accelerations and multipliers: the paper's Table 3 and Fig. 6."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import Configuration, bodies_of_cuts
from linkax.equations.constraint_rows import constraint_load
from linkax.equations.dynamics import applied_load, body_accelerations, inertial_wrench, less_joint_inertia
from linkax.equations.loop_rows import RowVectors, combined_rows, immobile_rows, plain_rows
from linkax.equations.loops import sorted_multipliers
from linkax.equations.motion import Motion
from linkax.equations.tree_sums import expand_to_motions, over_subtree, sum_by_body
from linkax.model.forces.force import Load
from linkax.spatial.rotations import compose, rotate, transpose
from linkax.spatial.vectors import cross
from linkax.tables import Table, among, by_axis, printed_as
from linkax.xla.arrays import Array

Side = Literal["child", "parent"]
Axes = Literal["ground", "joint"]


def _table(reaction: "Reaction") -> Table:
    decided = reaction.force.dtype == bool
    title = "Components of a reaction that are unique" if decided else "Reaction"
    units = ("", "") if decided else ("N", "N m")
    rows = zip(("force", "moment"), reaction, units, strict=True)
    return Table(title + among(reaction.force.shape[:-1]), [by_axis(*rows)])


@printed_as(_table)
class Reaction(NamedTuple):
    """The wrench of a joint on its child, in ground axes unless asked for otherwise.

    - `force` [N], and `moment` about the origin of the child's frame [N m], (…, 3) each. The
      parent receives the opposite force at the same point, and the opposite moment.
    """

    force: Float[Array, "... 3"]
    moment: Float[Array, "... 3"]


def cut_reactions(
    configuration: Configuration,
    multipliers: Float[Array, " m"],
    immobile: Float[Array, " m_immobile"] | None = None,
) -> Reaction:
    """Reactions of the cut joints on their children, (n_cut, 3) each, by virtual power: the paper's Table 3.

    A rotation row h₁ⁱ·h₂ʲ with multiplier λ is a moment λ h₂ʲ × h₁ⁱ, a translation row h₁ⁱ·s / ℓ a force λ h₁ⁱ / ℓ.

    **Arguments:** `immobile`: multipliers of the rows that no motion changes; zero by default.
    """
    found = sorted_multipliers(configuration, multipliers)
    nothing = jnp.zeros_like(configuration.separation)
    reaction = _added(Reaction(nothing, nothing), plain_rows(configuration), found.plain)
    if configuration.system.topology.combining:
        reaction = _added(reaction, combined_rows(configuration), found.combined)
    if immobile is not None:
        reaction = _added(reaction, immobile_rows(configuration), immobile)
    return reaction


def _added(reaction: Reaction, rows: RowVectors, multipliers) -> Reaction:
    of_rotations, of_translations = jnp.split(multipliers, [len(rows.rotation_cut)])
    moments = of_rotations[:, None] * cross(rows.second, rows.first)
    forces = (of_translations / rows.length)[:, None] * rows.direction
    return Reaction(
        jnp.asarray(reaction.force).at[rows.translation_cut].add(forces),
        jnp.asarray(reaction.moment).at[rows.rotation_cut].add(moments),
    )


def reactions(motion: Motion, acceleration: Float[Array, " n_v"], multipliers: Float[Array, " m"]) -> Reaction:
    """Reactions of all joints on their children, (n_j, 3) each, tree joints first.

    A tree joint carries what its subtree needs: inertial wrenches less applied loads less the reactions
    of cut joints on it (recursive Newton-Euler; the paper's Fig. 6).
    """
    load, cut = applied_load(motion), cut_reactions(motion.configuration, multipliers)
    force, moment = inertial_wrench(motion, *body_accelerations(motion, acceleration))
    along = less_joint_inertia(motion.system, load.joint_force, acceleration)
    needed = Load(jnp.asarray(force) - load.force, jnp.asarray(moment) - load.moment, along)
    return _carried(motion.configuration, needed, cut, multipliers)


def reactions_to(
    configuration: Configuration, multipliers: Float[Array, " m"], immobile: Float[Array, " m_immobile"]
) -> Reaction:
    """The part of all reactions that multipliers alone cause, (n_j, 3) each."""
    cut = cut_reactions(configuration, multipliers, immobile)
    return _carried(configuration, Load.none(configuration.system), cut, multipliers)


def seen_from(configuration: Configuration, reactions: Reaction, on: Side, axes: Axes) -> Reaction:
    """Refer reactions of all joints to a body, at its own frame's origin, in ground axes or its joint axes."""
    system, topology = configuration.system, configuration.system.topology
    parent, child = np.array(topology.parent), np.array(topology.child)
    force, moment = reactions
    joint_axes = configuration.joint_axes
    if on == "parent":
        apart = jnp.asarray(configuration.parent_arm - rotate(configuration.rotation[parent], system.parent_offset))
        apart = apart.at[topology.num_bodies :].add(configuration.separation)
        force, moment = -force, -moment - cross(apart, force)
    elif axes == "joint":
        joint_axes = compose(configuration.rotation[child], system.child_axes)
    if axes == "joint":
        force, moment = rotate(transpose(joint_axes), force), rotate(transpose(joint_axes), moment)
    return Reaction(force, moment)


def _carried(configuration: Configuration, needed: Load, cut: Reaction, multipliers) -> Reaction:
    """Reactions of all joints where bodies need wrenches, and tree joints have forces along their speeds already."""
    system, topology = configuration.system, configuration.system.topology
    count = topology.num_bodies
    force, moment, joint_force = needed
    held = constraint_load(configuration, sorted_multipliers(configuration, multipliers).constraints)
    force, moment, joint_force = force - held.force, moment - held.moment, joint_force + held.joint_force
    moment = moment + cross(configuration.position[:-1] + configuration.center_of_mass(), force)

    # All moments about the anchor of each body's tree from here on.
    parent, child, joints = bodies_of_cuts(topology)
    on_child = configuration.position[child] + configuration.child_arm[joints]
    on_parent = configuration.position[parent] + configuration.parent_arm[joints] + configuration.separation

    def onto_bodies(on_children, on_parents):
        padded = jnp.zeros((count + 1, 3), system.dtype).at[child].add(on_children).at[parent].add(-on_parents)
        return padded[:-1]

    force = force - onto_bodies(cut.force, cut.force)
    moment = moment - onto_bodies(cut.moment + cross(on_child, cut.force), cut.moment + cross(on_parent, cut.force))
    force, moment = over_subtree(system, force), over_subtree(system, moment)

    # From the body that the joint carries to its child, at the child's frame, less the joint's own force.
    joint_child = np.array(topology.child)[:count]
    point = configuration.position[joint_child] + configuration.child_arm[:count]
    moment = moment - cross(point, force)
    # On a screw it is a torque; of a joint that bends, the reaction is all that its section carries.
    kinds = topology.joint_types[:count]
    turns = np.array([kind.motion is None for kind in kinds])[topology.moved_body]
    slides = np.array([kind.motion is None and not kind.is_screw for kind in kinds])[topology.moved_body]
    along = expand_to_motions(topology, joint_force)[:, None]
    force = force - sum_by_body(system, slides[:, None] * along * configuration.sliding)
    moment = moment - sum_by_body(system, turns[:, None] * along * configuration.angular)
    sign = jnp.where(topology.reversed[:, None], -1.0, 1.0).astype(system.dtype)
    return Reaction(jnp.concatenate([sign * force, cut.force]), jnp.concatenate([sign * moment, cut.moment]))
