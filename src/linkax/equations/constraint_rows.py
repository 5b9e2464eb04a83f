"""Rows of constraints by their residuals g: J, γ and loads, derived by JAX.

A residual reads poses of bodies, which move by Ṙ = ω × R and ṗ = v, and coordinates of joints. Its cotangents are the
wrenches of its multipliers, by virtual power; those of a slip are cotangents of twists. Rows are in the scales of their
constraints, first the residuals of each, then its slips.
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
from linkax.model.attached import Attached, BodyPose, Twist
from linkax.model.constraints.constraint import AbstractConstraint
from linkax.model.forces.force import Load
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array, ScalarLike


def is_driven(system: System) -> bool:
    """Whether a constraint moves the mechanism with time."""
    return any(constraint.is_driven for constraint in system.constraints)


def constraint_residual(configuration: Configuration) -> Float[Array, " k"]:
    """g of all constraints, (k,); zero for slips, which have none."""
    system, t = configuration.system, configuration.t

    def of(constraint):
        found = constraint.checked_residual(t, _attached(configuration, constraint))
        return jnp.concatenate([found, jnp.zeros(len(constraint.slip_units), system.dtype)])

    return jnp.concatenate([*map(of, system.constraints)]) / system.constraint_scales


def constraint_jacobian(configuration: Configuration) -> Float[Array, "k n_v"]:
    """J of these rows."""
    system = configuration.system
    rows = lambda each: jax.vmap(_along_speeds(configuration, each))(np.eye(each.num_rows, dtype=system.dtype))
    found = [*map(rows, system.constraints)]
    return jnp.concatenate(found) / system.constraint_scales[:, None]


def constraint_load(configuration: Configuration, multipliers: Float[Array, " k"]) -> Load:
    """The load of all constraints at multipliers of g itself, not in scales, (k,)."""
    system = configuration.system
    total, first = Load.none(system), 0
    for constraint in system.constraints:
        own = slice(first, first + constraint.num_rows)
        total, first = total.plus(_load(configuration, constraint)(multipliers[own])), own.stop
    return total


def constraint_rate(configuration: Configuration) -> Float[Array, " k"]:
    """b of J v = b for these rows: −∂g/∂t, and minus the slip where nothing moves."""
    system = configuration.system
    t = jnp.asarray(configuration.t, system.dtype)

    def of(constraint):
        attached = _attached(configuration, constraint)
        found = jax.jvp(lambda t: -constraint.checked_residual(t, attached), (t,), (jnp.ones_like(t),))[1]
        return jnp.concatenate([found, -constraint.checked_slip(t, attached.still())])

    return _of_driven(system, of)


def constraint_gamma(motion: Motion, pace: ScalarLike) -> Float[Array, " k"]:
    """γ of these rows: −g̈, and minus the rate of slip, at v̇ = 0.

    **Arguments:** `pace`: of time relative to motion, 1, or 0 where it stands still.
    """
    found = [-_acceleration(motion, constraint, pace) for constraint in motion.system.constraints]
    return jnp.concatenate(found) / motion.system.constraint_scales


def drive_gamma(motion: Motion) -> Float[Array, " k"]:
    """The part of it that passing time causes."""
    of = lambda constraint: _acceleration(motion, constraint, 0.0) - _acceleration(motion, constraint, 1.0)
    return _of_driven(motion.system, of)


def _of_driven(system: System, of: Callable[[AbstractConstraint], Array]) -> Float[Array, " k"]:
    """Rows of the constraints that time moves, zero for others."""
    rows = lambda each: of(each) if each.is_driven else jnp.zeros(each.num_rows, system.dtype)
    return jnp.concatenate([*map(rows, system.constraints)]) / system.constraint_scales


def _attached(configuration: Configuration, constraint: AbstractConstraint) -> Attached:
    """What the residual of a constraint reads of a configuration."""
    poses = {frame.body: configuration.pose(frame.body) for frame in constraint.frames}
    return _reads(configuration, constraint, poses, configuration.q)


def _reads(configuration, constraint, poses, q) -> Attached:
    topology = configuration.system.topology
    joints = {name: q[topology.coordinates[name]] for name in constraint.joints}
    turning = tuple(name for name in joints if topology.joint_types[topology.joints.index(name)].has_quaternion)
    return constraint.attached(poses, joints, turning)


def _load(configuration: Configuration, constraint: AbstractConstraint) -> Callable[[Array], Load]:
    """Multipliers of its rows ↦ the load of a constraint on bodies and along joints."""
    system = configuration.system
    topology = system.topology
    attached = _attached(configuration, constraint)
    _, of_residual = jax.vjp(lambda attached: constraint.checked_residual(configuration.t, attached), attached)
    still = attached.still()
    moved = lambda twists, speeds: constraint.checked_slip(configuration.t, attached.moving(twists, speeds))
    _, of_slip = jax.vjp(moved, still.twists, still.speeds)

    def load(multipliers):
        on_places, on_speeds = jnp.split(multipliers, [len(constraint.units)])
        (back,), (twists, speeds) = of_residual(on_places), of_slip(on_speeds)
        total = Load.none(system)
        for name, along in back.poses.items():
            moment = jnp.sum(cross(attached.poses[name].rotation.T, along.rotation.T), axis=0) + twists[name].angular
            force = along.position + twists[name].linear
            total = total.plus(configuration.wrench(configuration.body(name), jnp.zeros_like(force), force, moment))
        in_q, in_v = jnp.zeros_like(configuration.q), total.joint_force
        for name in back.coordinates:
            in_q = in_q.at[topology.coordinates[name]].set(back.coordinates[name])
            in_v = in_v.at[topology.speeds[name]].set(speeds[name])
        _, of_speeds = jax.vjp(lambda v: rates(topology, configuration.q, v), in_v)
        return total._replace(joint_force=in_v + of_speeds(in_q)[0])

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
    """g̈ of a constraint, and the rate of its slip, at v̇ = 0."""
    configuration = motion.configuration
    topology, t = motion.system.topology, jnp.asarray(configuration.t, motion.system.dtype)
    at, first, second, twists, changes = _attached(configuration, constraint), {}, {}, {}, {}
    for name in at.poses:
        body = configuration.body(name)
        omega, axes = motion.angular_velocity[body], at.poses[name].rotation.T
        turn = cross(omega, axes)
        bend = cross(motion.angular_bias[body], axes) + cross(omega, turn)
        still = jnp.zeros_like(omega)
        first[name] = BodyPose(turn.T, motion.velocity[body], still)
        second[name] = BodyPose(bend.T, motion.bias[body], still)
        twists[name] = Twist(omega, motion.velocity[body])
        changes[name] = Twist(motion.angular_bias[body], motion.bias[body])
    change = lambda q: rates(topology, q, motion.v)
    to_q, to_rates = jax.jvp(change, (configuration.q,), (change(configuration.q),))
    first = _reads(configuration, constraint, first, to_q)
    second = _reads(configuration, constraint, second, to_rates)
    speeds = {name: motion.v[topology.speeds[name]] for name in at.coordinates}
    now = lambda s: t + s * pace if constraint.is_driven else t

    def along(s):
        place = jax.tree.map(lambda at, first, second: at + s * (first + s / 2.0 * second), at, first, second)
        return constraint.checked_residual(now(s), place)

    def slips(s):
        place, moved = (
            jax.tree.map(lambda at, first: at + s * first, *pair) for pair in ((at, first), (twists, changes))
        )
        found = constraint.checked_slip(now(s), place.moving(moved, speeds))
        # What slips where nothing moves counts by the pace of time, too.
        return found - (1.0 - pace) * constraint.checked_slip(now(s), place.still()) if constraint.is_driven else found

    zero, one = jnp.zeros_like(t), jnp.ones_like(t)
    rate = lambda s: jax.jvp(along, (s,), (one,))[1]
    return jnp.concatenate([jax.jvp(rate, (zero,), (one,))[1], jax.jvp(slips, (zero,), (one,))[1]])
