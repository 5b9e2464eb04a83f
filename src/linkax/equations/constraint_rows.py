"""Rows of constraints by their residuals g: J, γ and loads, derived by JAX.

A residual reads poses of bodies, which move by Ṙ = ω × R and ṗ = v, and coordinates of joints. Its cotangents are the
wrenches of its multipliers, by virtual power. Rows are in the scales of their constraints.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import Configuration, along_speeds
from linkax.equations.coordinates import rates
from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.model.attached import Attached, BodyPose
from linkax.model.constraints import AbstractConstraint
from linkax.model.forces import Load
from linkax.model.names import ByName
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array, ScalarLike


def is_driven(system: System) -> bool:
    """Whether a constraint moves the mechanism with time."""
    return any(constraint.is_driven for constraint in system.constraints)


def constraint_residual(configuration: Configuration) -> Float[Array, " k"]:
    """g of all constraints, (k,)."""
    system, t = configuration.system, configuration.t
    found = [constraint.checked_residual(t, _attached(configuration, constraint)) for constraint in system.constraints]
    return jnp.concatenate(found) / system.constraint_scales


def constraint_jacobian(configuration: Configuration) -> Float[Array, "k n_v"]:
    """J of these rows."""
    system = configuration.system
    rows = lambda each: jax.vmap(_along_speeds(configuration, each))(np.eye(len(each.units), dtype=system.dtype))
    found = [*map(rows, system.constraints)]
    return jnp.concatenate(found) / system.constraint_scales[:, None]


def constraint_load(configuration: Configuration, multipliers: Float[Array, " k"]) -> Load:
    """The load of all constraints at multipliers of g itself, not in scales, (k,)."""
    system = configuration.system
    total, first = Load.none(system), 0
    for constraint in system.constraints:
        own = slice(first, first + len(constraint.units))
        total, first = total.plus(_load(configuration, constraint)(multipliers[own])), own.stop
    return total


def constraint_rate(configuration: Configuration) -> Float[Array, " k"]:
    """b of J v = b for these rows: −∂g/∂t."""
    system = configuration.system
    t = jnp.asarray(configuration.t, system.dtype)

    def of(constraint):
        attached = _attached(configuration, constraint)
        return jax.jvp(lambda t: -constraint.checked_residual(t, attached), (t,), (jnp.ones_like(t),))[1]

    return _of_driven(system, of)


def constraint_gamma(motion: Motion, pace: ScalarLike) -> Float[Array, " k"]:
    """γ of these rows, −g̈ at v̇ = 0, where time passes at a `pace` relative to motion: 1, or 0 where it stands still."""
    found = [-_acceleration(motion, constraint, pace) for constraint in motion.system.constraints]
    return jnp.concatenate(found) / motion.system.constraint_scales


def drive_gamma(motion: Motion, pace: ScalarLike) -> Float[Array, " k"]:
    """The part of it that passing time causes."""
    of = lambda constraint: _acceleration(motion, constraint, 0.0) - _acceleration(motion, constraint, pace)
    return _of_driven(motion.system, of)


def _of_driven(system: System, of: Callable[[AbstractConstraint], Array]) -> Float[Array, " k"]:
    """Rows of the constraints that time moves, zero for others."""
    rows = lambda each: of(each) if each.is_driven else jnp.zeros(len(each.units), system.dtype)
    return jnp.concatenate([*map(rows, system.constraints)]) / system.constraint_scales


def _attached(configuration: Configuration, constraint: AbstractConstraint) -> Attached:
    """What a constraint reads of a configuration."""
    poses = {frame.body: configuration.pose(frame.body) for frame in constraint.frames}
    return _reads(configuration, constraint, poses, configuration.q)


def _reads(configuration, constraint, poses, q) -> Attached:
    topology = configuration.system.topology
    joints = {name: q[topology.coordinates[name]] for name in constraint.joints}
    turning = tuple(name for name in joints if topology.joint_types[topology.joints.index(name)].has_quaternion)
    of = f"of {constraint.display_name}"
    return Attached(ByName(poses, f"body {of}"), ByName(joints, f"joint {of}"), turning)


def _load(configuration: Configuration, constraint: AbstractConstraint) -> Callable[[Array], Load]:
    """Multipliers of its rows ↦ the load of a constraint on bodies and along joints."""
    system = configuration.system
    topology = system.topology
    attached = _attached(configuration, constraint)
    _, pull = jax.vjp(lambda attached: constraint.checked_residual(configuration.t, attached), attached)

    def load(multipliers):
        (back,) = pull(multipliers)
        total = Load.none(system)
        for name, along in back.poses.items():
            axes, turns = attached.poses[name].rotation.T, along.rotation.T
            moment = jnp.sum(cross(axes, turns), axis=0)
            arm = jnp.zeros_like(along.position)
            total = total.plus(configuration.wrench(configuration.body(name), arm, along.position, moment))
        in_q = jnp.zeros_like(configuration.q)
        for name, along in back.coordinates.items():
            in_q = in_q.at[topology.coordinates[name]].set(along)
        _, of_speeds = jax.vjp(lambda v: rates(topology, configuration.q, v), jnp.zeros_like(total.joint_force))
        return total._replace(joint_force=of_speeds(in_q)[0])

    return load


def _along_speeds(configuration, constraint):
    """Multipliers of its rows ↦ generalised force of a constraint, (n_v,)."""
    load = _load(configuration, constraint)

    def force(multipliers):
        found = load(multipliers)
        if not constraint.frames:
            return found.joint_force
        return found.joint_force + along_speeds(configuration, found.force, found.moment)

    return force


def _acceleration(motion: Motion, constraint: AbstractConstraint, pace: ScalarLike) -> Float[Array, " k"]:
    """g̈ of a constraint at v̇ = 0."""
    configuration = motion.configuration
    topology, t = motion.system.topology, jnp.asarray(configuration.t, motion.system.dtype)
    at, first, second = _attached(configuration, constraint), {}, {}
    for name in at.poses:
        body = configuration.body(name)
        omega, axes = motion.angular_velocity[body], at.poses[name].rotation.T
        turn = cross(omega, axes)
        bend = cross(motion.angular_bias[body], axes) + cross(omega, turn)
        still = jnp.zeros_like(omega)
        first[name] = BodyPose(turn.T, motion.velocity[body], still)
        second[name] = BodyPose(bend.T, motion.bias[body], still)
    change = lambda q: rates(topology, q, motion.v)
    to_q, to_rates = jax.jvp(change, (configuration.q,), (change(configuration.q),))
    first = _reads(configuration, constraint, first, to_q)
    second = _reads(configuration, constraint, second, to_rates)

    def along(s):
        place = jax.tree.map(lambda at, first, second: at + s * (first + s / 2.0 * second), at, first, second)
        return constraint.checked_residual(t + s * pace if constraint.is_driven else t, place)

    zero, one = jnp.zeros_like(t), jnp.ones_like(t)
    rate = lambda s: jax.jvp(along, (s,), (one,))[1]
    return jax.jvp(rate, (zero,), (one,))[1]
