"""Mass matrix, forces and energy of the spanning tree.

Featherstone (2008), ch. 5 (recursive Newton-Euler) and ch. 6 (composite rigid bodies). Inertias go from body to body
about each one's own reference point, so that small bodies far out on a mechanism keep their digits.
"""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import Configuration, along_speeds
from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.equations.tree_sums import along_path, expand_to_motions, over_subtree, sum_by_body
from linkax.linalg.static_sparse import StaticSparse, constant_product, products_of_pairs, sums_of_pairs
from linkax.model.forces.force import Load
from linkax.spatial.rotations import compose, rotate, transpose
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array, Scalar


def world_inertia(configuration: Configuration) -> Float[Array, "n_b 3 3"]:
    """Inertia tensor of each body about its centre of mass, in ground axes [kg m²]."""
    rotation = configuration.rotation[:-1]
    return compose(compose(rotation, configuration.system.inertia), transpose(rotation))


def _shifted(mass, first_moment, arm):
    """Gain of a second moment of mass when its reference point moves back by `arm`, (n_b, 3, 3)."""
    moved = mass[:, None] * arm + first_moment
    product = arm[:, :, None] * moved[:, None, :] + first_moment[:, :, None] * arm[:, None, :]
    trace = jnp.sum(arm * (moved + first_moment), axis=-1)
    return trace[:, None, None] * jnp.eye(3, dtype=arm.dtype) - product


def mass_matrix(configuration: Configuration) -> Float[Array, "n_v n_v"]:
    """Mass matrix M of the tree by composite rigid bodies [kg m², kg m, kg]."""
    return mass_entries(configuration).dense()


def mass_entries(configuration: Configuration) -> StaticSparse:
    """Entries of M that may differ from zero: pairs of speeds that move a common body."""
    by_bodies = configuration.system.topology.motion_column is not None
    found = _mass_by_bodies(configuration) if by_bodies else _composite_mass(configuration)
    added = configuration.system.joint_inertia
    return found if added is None else found.plus_diagonal(added)


def _composite_mass(configuration):
    """M by composite rigid bodies, of speeds that move one body each."""
    system, topology = configuration.system, configuration.system.topology
    above = lambda carried: _onto_carrier(np.array(topology.predecessor), carried)
    arm = configuration.center_of_mass()
    own_moment = system.mass[:, None] * arm
    nothing = jnp.zeros_like(arm)
    own_inertia = world_inertia(configuration) + _shifted(system.mass, nothing, arm)
    mass = over_subtree(system, system.mass)
    first = over_subtree(system, own_moment + above(mass[:, None] * configuration.link))
    second = over_subtree(system, own_inertia + above(_shifted(mass, first, configuration.link)))

    body = topology.moved_body
    position = configuration.position[body]
    angular, at_anchor = configuration.angular, configuration.linear
    at_body = at_anchor + cross(angular, position)
    momentum = mass[body][:, None] * at_body + cross(angular, first[body])
    moment = rotate(second[body], angular) + cross(first[body], at_body) + cross(position, momentum)
    carries = topology.path[:-1][np.ix_(body, body)].T > 0.0
    across, down = np.meshgrid(np.arange(len(body)), np.arange(len(body)))
    carrier, carried = np.where(carries, down, np.where(carries.T, across, -1)), np.where(carries, across, down)
    twist, wrench = jnp.concatenate([angular, at_anchor], axis=1), jnp.concatenate([moment, momentum], axis=1)
    return products_of_pairs(carrier, carried, twist, wrench)


def _mass_by_bodies(configuration):
    """M of speeds that move many bodies each, as those of beams do: Σ Jᵀ I J over the bodies' Jacobians."""
    system, topology = configuration.system, configuration.system.topology
    of_speed = np.asarray(topology.motion_column) == np.arange(topology.num_speeds)[:, None]
    moves = topology.path[:-1, None, topology.moved_body] * of_speed  # bodies, speeds, motions
    twist = jnp.concatenate([configuration.angular, configuration.linear], axis=1)
    twists = constant_product(moves.reshape(-1, moves.shape[-1]), twist).reshape(*moves.shape[:2], 6)
    angular, at_anchor = jnp.split(twists, 2, axis=2)
    place = configuration.position[:-1] + configuration.center_of_mass()
    linear = at_anchor + cross(angular, place[:, None, :])
    momentum, moment = system.mass[:, None, None] * linear, rotate(world_inertia(configuration)[:, None], angular)
    jacobian, carried = jnp.concatenate([linear, angular], axis=2), jnp.concatenate([momentum, moment], axis=2)
    return sums_of_pairs(np.any(moves, axis=2), jacobian, carried)


def _onto_carrier(carrier, carried):
    """Sum values (n_b, …) over the bodies that each body carries directly."""
    return constant_product(carrier[None, :] == np.arange(len(carrier))[:, None], carried)


def applied_load(motion: Motion) -> Load:
    """Sum the loads of all force elements."""
    loads = [force.applied(motion.configuration.t, motion) for force in motion.system.forces]
    return reduce(Load.plus, loads, Load.none(motion.system))


def inertial_wrench(
    motion: Motion, angular_acceleration: Float[Array, "n_b 3"], acceleration: Float[Array, "n_b 3"]
) -> tuple[Float[Array, "n_b 3"], Float[Array, "n_b 3"]]:
    """Force m a [N] and moment I α + ω × I ω about the centre of mass [N m] of each body, (n_b, 3) each.

    **Arguments:** accelerations of the bodies [rad/s²] and of their reference points [m/s²].
    """
    system, arm = motion.system, motion.configuration.center_of_mass()
    omega = motion.angular_velocity[:-1]
    at_mass = acceleration + cross(angular_acceleration, arm) + cross(omega, cross(omega, arm))
    inertia = world_inertia(motion.configuration)
    moment = rotate(inertia, angular_acceleration) + cross(omega, rotate(inertia, omega))
    return system.mass[:, None] * at_mass, moment


def generalised_force(motion: Motion) -> Float[Array, " n_v"]:
    """f of M v̇ = f + Jᵀλ: applied forces less velocity-product forces [N m, N]."""
    return _unbalanced(motion, motion.angular_bias[:-1], motion.bias[:-1])


def unbalanced_force(motion: Motion, acceleration: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
    """f − M v̇ by recursive Newton-Euler, without forming M [N m, N]."""
    of_bodies = _unbalanced(motion, *body_accelerations(motion, acceleration))
    return less_joint_inertia(motion.system, of_bodies, acceleration)


def less_joint_inertia(
    system: System, along: Float[jax.Array, " n_v"], acceleration: Float[Array, " n_v"]
) -> Float[jax.Array, " n_v"]:
    """Take from forces along the speeds what the inertia along them needs [N m, N], see `linkax.JointInertia`."""
    return along if system.joint_inertia is None else along - system.joint_inertia * acceleration


def _unbalanced(motion, angular_acceleration, acceleration):
    """Applied forces less what given accelerations of bodies and reference points need."""
    load = applied_load(motion)
    force, moment = inertial_wrench(motion, angular_acceleration, acceleration)
    return load.joint_force + along_speeds(motion.configuration, load.force - force, load.moment - moment)


def kinetic_energy(motion: Motion) -> Float[Array, ""]:
    """Kinetic energy [J]."""
    omega, arm = motion.angular_velocity[:-1], motion.configuration.center_of_mass()
    velocity = motion.velocity[:-1] + cross(omega, arm)
    spin = rotate(world_inertia(motion.configuration), omega)
    found = jnp.sum(motion.system.mass * dot(velocity, velocity) + dot(omega, spin)) / 2.0
    added = motion.system.joint_inertia
    return found if added is None else found + added @ motion.v**2 / 2.0


def potential_energy(configuration: Configuration) -> Scalar:
    """Potential energy of all force elements that have one [J]."""
    energies = [force.potential_energy(configuration) for force in configuration.system.forces]
    return sum(energies, jnp.zeros((), configuration.system.dtype))


def body_accelerations(
    motion: Motion, acceleration: Float[Array, " n_v"]
) -> tuple[Float[Array, "n_b 3"], Float[Array, "n_b 3"]]:
    """Accelerations of bodies [rad/s²] and of their reference points [m/s²] at v̇, (n_b, 3) each."""
    configuration, system = motion.configuration, motion.system
    acceleration = expand_to_motions(system.topology, acceleration)[:, None]
    angular = along_path(system, sum_by_body(system, configuration.angular * acceleration))[:-1]
    at_anchor = along_path(system, sum_by_body(system, configuration.linear * acceleration))[:-1]
    linear = at_anchor + cross(angular, configuration.position[:-1])
    return motion.angular_bias[:-1] + angular, motion.bias[:-1] + linear
