"""Poses and twists of all bodies by recursion along the tree, all bodies at once.

Vectors are in ground axes. A sum along the way from ground to each body is a product with the
topology's `path`; only orientations need products along the way (by pointer doubling).
Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4, gives the recursions.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.equations.system import System
from linkax.model.topology import GROUND_INDEX
from linkax.spatial.rotations import compose, cross, rotate, transpose


class Configuration(eqx.Module):
    """Where all bodies are at coordinates q. Last row of body arrays with n_b + 1 rows: ground.

    - `rotation`: orientation of each body, axes as columns, (n_b + 1, 3, 3).
    - `link`: from the predecessor's reference point to the body's, without anchors [m], (n_b, 3).
    - `position`: reference point of each body from the anchor of its tree [m], (n_b + 1, 3).
    - `joint_axes`: h¹, h², h³ of each joint on its parent, as columns, (n_j, 3, 3).
    - `parent_arm`, `child_arm`: from the reference point of each joint's parent to the origin
      of the child's frame (tree joints) or of the parent's frame (cut joints), and from the
      child's to that of the child's frame [m], (n_j, 3).
    - `angular`, `sliding`: motion subspace of each speed: angular velocity, and velocity at the
      origin of the child's frame, of the moved body per unit speed, (n_v, 3).
    - `linear`: the same velocity at the anchor of the tree, (n_v, 3).
    """

    system: System
    rotation: Float[Array, "n_b+1 3 3"]
    link: Float[Array, "n_b 3"]
    position: Float[Array, "n_b+1 3"]
    joint_axes: Float[Array, "n_j 3 3"]
    parent_arm: Float[Array, "n_j 3"]
    child_arm: Float[Array, "n_j 3"]
    angular: Float[Array, "n_v 3"]
    sliding: Float[Array, "n_v 3"]
    linear: Float[Array, "n_v 3"]

    def center_of_mass(self) -> Float[Array, "n_b 3"]:
        """Centre of mass of each body from its reference point, in ground axes [m]."""
        return rotate(self.rotation[:-1], self.system.center_of_mass)

    def world_position(self) -> Float[Array, "n_b 3"]:
        """Reference point of each body in the world [m]."""
        topology, root = self.system.topology, self.system.topology.root[:-1]
        return self.position[: topology.num_bodies] + self.system.anchor[root]

    def world_center_of_mass(self) -> Float[Array, "n_b 3"]:
        """Centre of mass of each body in the world [m]."""
        return self.world_position() + self.center_of_mass()


class Motion(eqx.Module):
    """How all bodies move at (q, v).

    - `angular_velocity` [rad/s], (n_b + 1, 3); `velocity` of reference points [m/s], (n_b + 1, 3).
    - `angular_bias` [rad/s²], `bias` [m/s²]: accelerations that velocities alone cause (the
      part without v̇), (n_b + 1, 3).
    - `edge_rate`, `edge_turn`, `edge_bias`, `edge_angular_bias`: contributions of each tree
      joint to the four, (n_b, 3), for sums around a loop.
    """

    configuration: Configuration
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


def along_path(system: System, edges):
    """Sum over the tree joints from ground to each body: (n_b, …) to (n_b + 1, …)."""
    flat = edges.reshape(edges.shape[0], -1)
    total = jnp.asarray(system.topology.path, system.dtype) @ flat
    return total.reshape(-1, *edges.shape[1:])


def over_subtree(system: System, bodies):
    """Sum over each body and all that it carries: (n_b, …) to (n_b, …)."""
    flat = bodies.reshape(bodies.shape[0], -1)
    total = jnp.asarray(system.topology.path[:-1].T, system.dtype) @ flat
    return total.reshape(bodies.shape)


def by_body(system: System, columns):
    """Sum the contributions (n_v, 3) of speeds for the body that each moves: (n_b, 3)."""
    topology = system.topology
    if np.array_equal(topology.column_body, np.arange(topology.num_bodies)):
        return columns
    return jnp.zeros((topology.num_bodies, 3), columns.dtype).at[topology.column_body].add(columns)


def configure(system: System, q: Float[Array, " n_q"]) -> Configuration:
    """Poses of all bodies and the motion subspaces of all joints at coordinates q."""
    topology, count = system.topology, system.topology.num_bodies
    parent, child = np.array(topology.parent), np.array(topology.child)
    reversed_ = topology.reversed[:, None]
    turn, shift = _joint_motion(topology, q)
    relative = compose(compose(system.parent_axes[:count], turn), transpose(system.child_axes[:count]))
    if np.any(reversed_):
        relative = jnp.where(reversed_[:, :, None], transpose(relative), relative)
    rotation = _along_path_product(topology, relative)
    joint_axes = compose(rotation[parent], system.parent_axes)
    parent_arm = rotate(rotation[parent], system.parent_offset)
    child_arm = rotate(rotation[child], system.child_offset)
    parent_arm = parent_arm.at[:count].add(rotate(joint_axes[:count], shift))
    sign = jnp.where(reversed_, -1.0, 1.0).astype(q.dtype)
    link = sign * (parent_arm - child_arm)[:count]
    position = along_path(system, link)
    subspace_axes = (sign[:, :, None] * joint_axes[:count])[topology.column_body]
    angular = rotate(subspace_axes, jnp.asarray(_subspace(topology, "angular_subspace"), q.dtype))
    sliding = rotate(subspace_axes, jnp.asarray(_subspace(topology, "linear_subspace"), q.dtype))
    joint_point = (position[child[:count]] + child_arm[:count])[topology.column_body]
    return Configuration(
        system=system,
        rotation=rotation,
        link=link,
        position=position,
        joint_axes=joint_axes,
        parent_arm=parent_arm,
        child_arm=child_arm,
        angular=angular,
        sliding=sliding,
        linear=sliding + cross(joint_point, angular),
    )


def _joint_motion(topology, q):
    """Rotation (n_b, 3, 3) and displacement (n_b, 3) of each tree joint, in its own axes."""
    kinds = topology.joint_types[: topology.num_bodies]
    starts = [topology.coordinates[name].start for name in topology.joints[: topology.num_bodies]]
    order, turns, shifts = [], [], []
    for kind in dict.fromkeys(kinds):
        members = [body for body, other in enumerate(kinds) if other is kind]
        taken = np.array(starts)[members][:, None] + np.arange(len(kind.coordinate_units))
        coordinates = q[taken.astype(int)]
        turns.append(jax.vmap(kind.rotation)(coordinates))
        shifts.append(jax.vmap(kind.displacement)(coordinates))
        order += members
    if len(turns) == 1:
        return turns[0], shifts[0]
    place = np.argsort(order)
    return jnp.concatenate(turns)[place], jnp.concatenate(shifts)[place]


def _subspace(topology, part):
    columns = [column for kind in topology.joint_types[: topology.num_bodies] for column in getattr(kind, part)]
    return np.array(columns).reshape(-1, 3)


def _along_path_product(topology, relative):
    """Products of relative rotations from ground to each body, in log2(depth) rounds."""
    rotation = jnp.concatenate([relative, jnp.eye(3, dtype=relative.dtype)[None]])
    carrier = np.array([*topology.predecessor, GROUND_INDEX])
    while np.any(carrier != GROUND_INDEX):
        rotation = compose(rotation[carrier], rotation)
        carrier = carrier[carrier]
    return rotation


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
    alpha = along_path(system, edge_angular_bias)

    parent_rate, child_rate = cross(omega[parent], parent_arm), cross(omega[child], child_arm)
    edge_rate = sign * (parent_rate - child_rate) + edge_slide
    parent_bias = cross(alpha[parent], parent_arm) + cross(omega[parent], parent_rate)
    child_bias = cross(alpha[child], child_arm) + cross(omega[child], child_rate)
    edge_bias = sign * (parent_bias - child_bias) + 2.0 * cross(omega[parent], edge_slide)
    return Motion(
        configuration=configuration,
        angular_velocity=omega,
        velocity=along_path(system, edge_rate),
        angular_bias=alpha,
        bias=along_path(system, edge_bias),
        edge_turn=edge_turn,
        edge_rate=edge_rate,
        edge_angular_bias=edge_angular_bias,
        edge_bias=edge_bias,
    )
