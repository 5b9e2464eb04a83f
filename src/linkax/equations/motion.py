"""Twists of all bodies and their velocity-product accelerations, by recursion along the tree."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.equations.configuration import Configuration, along_path, by_body, by_kind
from linkax.equations.system import System
from linkax.model.bodies import Frame
from linkax.model.forces import Load
from linkax.model.terms import Term
from linkax.model.topology import GROUND_INDEX
from linkax.spatial.rotations import rotate
from linkax.spatial.vectors import cross
from linkax.tracing import traced_once


class Motion(eqx.Module):
    """How all bodies move at (t, q, v): what a force element reads, and how it makes its load.

    - `angular_velocity` [rad/s], (n_b + 1, 3); `velocity` of reference points [m/s], (n_b + 1, 3).
    - `angular_bias` [rad/s²], `bias` [m/s²]: accelerations that velocities alone cause (the
      part without v̇), (n_b + 1, 3).
    - `edge_rate`, `edge_turn`, `edge_bias`, `edge_angular_bias`: contributions of each tree
      joint to the four, (n_b, 3), for sums around a loop.
    """

    configuration: Configuration
    v: Float[Array, " n_v"]
    angular_velocity: Float[Array, "n_b+1 3"]
    velocity: Float[Array, "n_b+1 3"]
    angular_bias: Float[Array, "n_b+1 3"]
    bias: Float[Array, "n_b+1 3"]
    edge_turn: Float[Array, "n_b 3"]
    edge_rate: Float[Array, "n_b 3"]
    edge_angular_bias: Float[Array, "n_b 3"]
    edge_bias: Float[Array, "n_b 3"]

    @property
    def system(self) -> System:
        return self.configuration.system

    def joint(self, name: str):
        """Coordinate of a joint, in the tree or cut [rad or m]; (n,) where it has several."""
        return _alone(self.configuration.joint_coordinates(name))

    def joint_speed(self, name: str):
        """Speed of a joint, in the tree or cut [rad/s or m/s]; (n,) where it has several."""
        return _alone(self.joint_speeds(name))

    def joint_speeds(self, name: str) -> Float[Array, " n"]:
        """Speeds of a joint, in the tree or cut [rad/s or m/s]."""
        topology, configuration = self.system.topology, self.configuration
        if name in topology.speeds:
            return self.v[topology.speeds[name]]
        joint = topology.joints.index(name)
        parent, child, cut = topology.parent[joint], topology.child[joint], joint - topology.num_bodies
        omega = self.angular_velocity
        on_child = self.velocity[child] + cross(omega[child], configuration.child_arm[joint])
        arm = configuration.parent_arm[joint] + configuration.separation[cut]
        seen = on_child - self.velocity[parent] - cross(omega[parent], arm)
        angular, linear = configuration.cut_subspace(name)
        return angular @ (omega[child] - omega[parent]) + linear @ seen

    def joint_rate(self, term: Term) -> Float[Array, ""]:
        """One speed of a joint [rad/s or m/s]."""
        return self.joint_speeds(term.joint)[term.index or 0]

    def joint_load(self, term: Term, force) -> Load:
        """A torque [N m], or force [N] on a slide, along one speed of a joint, on the child."""
        topology, configuration, none = self.system.topology, self.configuration, Load.none(self.system)
        if term.joint in topology.speeds:
            return none._replace(joint_force=none.joint_force.at[topology.column(term)].set(force))
        joint = topology.joints.index(term.joint)
        parent, child, cut = topology.parent[joint], topology.child[joint], joint - topology.num_bodies
        angular, linear = (columns[term.index or 0] * force for columns in configuration.cut_subspace(term.joint))
        on_parent = configuration.parent_arm[joint] + configuration.separation[cut]
        load = self._wrench(child, configuration.child_arm[joint], linear, angular)
        return load.plus(self._wrench(parent, on_parent, -linear, -angular))

    def point_velocity(self, frame: Frame) -> Float[Array, "3"]:
        """Velocity of the origin of a frame [m/s]."""
        body = self.configuration.body(frame.body)
        return self.velocity[body] + cross(self.angular_velocity[body], self.configuration.arm(frame))

    def point_load(self, frame: Frame, force) -> Load:
        """A force at the origin of a frame, in ground axes [N]; one on the ground does nothing."""
        nothing = jnp.zeros(3, self.system.dtype)
        return self._wrench(self.configuration.body(frame.body), self.configuration.arm(frame), force, nothing)

    def _wrench(self, body, arm, force, moment) -> Load:
        """A force at a point of a body, and a moment."""
        none = Load.none(self.system)
        if body == GROUND_INDEX:
            return none
        about_mass = moment + cross(arm - self.configuration.center_of_mass()[body], force)
        return none._replace(force=none.force.at[body].set(force), moment=none.moment.at[body].set(about_mass))


def _alone(values):
    return values[0] if len(values) == 1 else values


@traced_once
def move(configuration: Configuration, v: Float[Array, " n_v"]) -> Motion:
    """Twists and velocity-product accelerations of all bodies at speeds v."""
    system = configuration.system
    topology, count = system.topology, system.topology.num_bodies
    parent, child = np.array(topology.parent)[:count], np.array(topology.child)[:count]
    sign = jnp.where(topology.reversed[:, None], -1.0, 1.0).astype(v.dtype)
    parent_arm, child_arm = configuration.parent_arm[:count], configuration.child_arm[:count]

    edge_turn = by_body(system, configuration.angular * v[:, None])
    edge_slide = by_body(system, configuration.sliding * v[:, None])
    omega = along_path(system, edge_turn)
    edge_angular_bias = cross(omega[parent], edge_turn)
    if any(kind.angular_subspace_at is not None for kind in topology.joint_types[:count]):
        edge_angular_bias = edge_angular_bias + _subspace_bias(configuration, v)
    alpha = along_path(system, edge_angular_bias)

    parent_rate, child_rate = cross(omega[parent], parent_arm), cross(omega[child], child_arm)
    edge_rate = sign * (parent_rate - child_rate) + edge_slide
    parent_bias = cross(alpha[parent], parent_arm) + cross(omega[parent], parent_rate)
    child_bias = cross(alpha[child], child_arm) + cross(omega[child], child_rate)
    edge_bias = sign * (parent_bias - child_bias) + 2.0 * cross(omega[parent], edge_slide)
    return Motion(
        configuration=configuration,
        v=v,
        angular_velocity=omega,
        velocity=along_path(system, edge_rate),
        angular_bias=alpha,
        bias=along_path(system, edge_bias),
        edge_turn=edge_turn,
        edge_rate=edge_rate,
        edge_angular_bias=edge_angular_bias,
        edge_bias=edge_bias,
    )


def _subspace_bias(configuration, v):
    """Angular accelerations by motion subspaces that turn with their own coordinates, (n_b, 3)."""
    topology = configuration.system.topology
    sign = jnp.where(topology.reversed, -1.0, 1.0).astype(v.dtype)
    total = jnp.zeros((topology.num_bodies, 3), v.dtype)
    for kind, members, places in by_kind(topology):
        if kind.angular_subspace_at is None:
            continue
        speeds = v[np.array([np.flatnonzero(topology.column_body == body) for body in members])]

        def bias(q, rates, kind=kind):
            turning = jax.jvp(kind.angular_subspace_at, (q,), (rates,))[1]
            return rates @ turning

        turned = jax.vmap(bias)(configuration.q[places], speeds)
        axes = configuration.joint_axes[np.array(members)]
        total = total.at[np.array(members)].set(sign[np.array(members)][:, None] * rotate(axes, turned))
    return total
