"""Twists and velocity-product accelerations of all bodies, by recursion along the tree."""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from linkax.equations.configuration import Configuration
from linkax.equations.coordinates import joint_rates
from linkax.equations.joint_motions import over_bending
from linkax.equations.system import System
from linkax.equations.tree_sums import along_path, expand_to_motions, sum_by_body
from linkax.model.attached import alone
from linkax.model.bodies import BodyOrFrame, frame_of
from linkax.model.forces.force import Load
from linkax.model.names import find
from linkax.model.numbers import Number
from linkax.model.terms import Term
from linkax.spatial.rotations import rotate
from linkax.spatial.screws import turn_rate
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array
from linkax.xla.static_scatter import scatter_static
from linkax.xla.tracing import jit_inline
from linkax.xla.whole_jacobian import whole_jacobian


class Motion(eqx.Module):
    """The motion of all bodies at (t, q, v): what a force element reads, and how it makes its load.

    `joint` and `joint_speed` read it by a joint's name, `length` by that of a force or constraint, `point_position`,
    `point_velocity` and `orientation` at a body or `body.at(...)`, in ground axes; `point_load` and `joint_load` make
    loads. Its arrays are in the order of the bodies, ground last:

    - `angular_velocity` [rad/s], (n_b + 1, 3); `velocity` of reference points [m/s], (n_b + 1, 3).
    - `angular_bias` [rad/s²], `bias` [m/s²]: velocity-product accelerations, the part without v̇, (n_b + 1, 3).
    - `edge_rate`, `edge_turn`, `edge_bias`, `edge_angular_bias`: contributions of each tree
      joint to the four, (n_b, 3), for sums around a loop.
    """

    configuration: Configuration
    v: Float[Array, " n_v"]
    angular_velocity: Float[Array, "n_frames 3"]
    velocity: Float[Array, "n_frames 3"]
    angular_bias: Float[Array, "n_frames 3"]
    bias: Float[Array, "n_frames 3"]
    edge_turn: Float[Array, "n_b 3"]
    edge_rate: Float[Array, "n_b 3"]
    edge_angular_bias: Float[Array, "n_b 3"]
    edge_bias: Float[Array, "n_b 3"]

    @property
    def system(self) -> System:
        return self.configuration.system

    def joint(self, name: str) -> Float[Array, ""] | Float[Array, " n"]:
        """Coordinate of a joint, in the tree or cut [rad or m]; (n,) where it has several."""
        return self.configuration.joint(name)

    def joint_speed(self, name: str) -> Float[Array, ""] | Float[Array, " n"]:
        """Speed of a joint, in the tree or cut [rad/s or m/s]; (n,) where it has several."""
        return alone(self.joint_speeds(name))

    def joint_speeds(self, name: str) -> Float[Array, " n"]:
        """Speeds of a joint, in the tree or cut [rad/s or m/s]."""
        topology = self.system.topology
        return self.v[topology.speeds[name]] if name in topology.speeds else self.cut_speeds([name])[0]

    def length(self, name: str) -> Float[Array, ""]:
        """Length of a force element or constraint of this name [m], see `linkax.Solution.length`.

        **Raises:** `ValueError` for an unknown name, and for an element without length.
        """
        elements = [*(force.itself for force in self.system.forces), *self.system.constraints]
        named = {element.name: element for element in elements if getattr(element, "name", None)}
        find(name, [*named], "force or constraint")
        return named[name].extent(self.configuration)

    def cut_speeds(self, names: Sequence[str]) -> Float[Array, "k n"]:
        """Speeds of cut joints of one type [rad/s or m/s]."""
        topology, configuration, omega = self.system.topology, self.configuration, self.angular_velocity
        joints = np.array([topology.joint_index(name) for name in names])
        parent, child = np.array(topology.parent)[joints], np.array(topology.child)[joints]
        on_child = self.velocity[child] + cross(omega[child], configuration.child_arm[joints])
        arm = configuration.parent_arm[joints] + configuration.separation[joints - topology.num_bodies]
        seen = on_child - self.velocity[parent] - cross(omega[parent], arm)
        angular, linear = configuration.cut_subspace(names)
        return dot(angular, (omega[child] - omega[parent])[:, None]) + dot(linear, seen[:, None])

    def joint_rate(self, term: Term) -> Float[Array, ""]:
        """One speed of a joint [rad/s or m/s]."""
        return self.joint_speeds(term.joint)[term.index or 0]

    def joint_load(self, term: Term, force: Number) -> Load:
        """Make the load of a torque [N m], or a force [N] on a slide, on the child along one speed of a joint."""
        topology, configuration, none = self.system.topology, self.configuration, Load.none(self.system)
        force = jnp.asarray(force, self.system.dtype)
        if term.joint in topology.speeds:
            return none._replace(joint_force=none.joint_force.at[topology.column(term)].set(force))
        joint = topology.joint_index(term.joint)
        parent, child, cut = topology.parent[joint], topology.child[joint], joint - topology.num_bodies
        angular, linear = (columns[0, term.index or 0] * force for columns in configuration.cut_subspace([term.joint]))
        on_parent = configuration.parent_arm[joint] + configuration.separation[cut]
        load = configuration.wrench(child, configuration.child_arm[joint], linear, angular)
        return load.plus(configuration.wrench(parent, on_parent, -linear, -angular))

    def point_position(self, point: BodyOrFrame) -> Float[Array, "3"]:
        """Position of a point in ground axes [m]: the origin of `body.at(...)`, or of a body's reference frame."""
        return self.configuration.point_position(point)

    def orientation(self, body: BodyOrFrame | str) -> Float[Array, "3 3"]:
        """Axes of a body's reference frame, or of a frame `body.at(...)`, as columns in ground axes.

        `body`: also the name of one. R = orientation takes a vector from the body's axes to ground axes by R @ vector.
        """
        return self.configuration.orientation(body)

    def point_velocity(self, point: BodyOrFrame) -> Float[Array, "3"]:
        """Velocity of a point in ground axes [m/s]; see `point_position`."""
        frame = frame_of(point, "point")
        body = self.configuration.body(frame.body)
        return self.velocity[body] + cross(self.angular_velocity[body], self.configuration.arm(frame))

    def velocity_at(self, body: BodyOrFrame, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """Velocity of what is at a place on a body, given from the frame's origin in ground axes [m/s]."""
        frame = frame_of(body, "body")
        index = self.configuration.body(frame.body)
        return self.velocity[index] + cross(self.angular_velocity[index], self.configuration.arm(frame) + place)

    def point_load(self, point: BodyOrFrame, force: Real[Array, "3"], moment: Real[Array, "3"] | float = 0.0) -> Load:
        """Make the load of a force at a point, and a moment, in ground axes [N, N m]; none on the ground."""
        return self.configuration.point_load(frame_of(point, "point"), force, moment)


@jit_inline
def move(configuration: Configuration, v: Float[Array, " n_v"]) -> Motion:
    """Compute twists and velocity-product accelerations of all bodies at speeds v."""
    system = configuration.system
    topology, count = system.topology, system.topology.num_bodies
    parent, child = np.array(topology.parent)[:count], np.array(topology.child)[:count]
    sign = jnp.where(topology.reversed[:, None], -1.0, 1.0).astype(v.dtype)
    parent_arm, child_arm = configuration.parent_arm[:count], configuration.child_arm[:count]

    speed = expand_to_motions(topology, v)[:, None]
    edge_turn = sum_by_body(system, configuration.angular * speed)
    edge_slide = sum_by_body(system, configuration.sliding * speed)
    omega = along_path(system, edge_turn)
    edge_angular_bias = cross(omega[parent], edge_turn)
    turned, slid = _subspace_bias(configuration, v)
    edge_angular_bias = edge_angular_bias + sign * turned
    alpha = along_path(system, edge_angular_bias)

    parent_rate, child_rate = cross(omega[parent], parent_arm), cross(omega[child], child_arm)
    edge_rate = sign * (parent_rate - child_rate) + edge_slide
    parent_bias = cross(alpha[parent], parent_arm) + cross(omega[parent], parent_rate)
    child_bias = cross(alpha[child], child_arm) + cross(omega[child], child_rate)
    edge_bias = sign * (parent_bias - child_bias + slid) + 2.0 * cross(omega[parent], edge_slide)
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
    """Accelerations of the joints' children by motion subspaces that change with coordinates, Ṡ v, (n_b, 3) each.

    **Returns:** angular and linear ones, seen from the parent, in ground axes.
    """
    system, topology = configuration.system, configuration.system.topology
    turned = slid = jnp.zeros((topology.num_bodies, 3), v.dtype)
    speeds = lambda kind: v[np.stack([topology.columns(body) for body in kind.bodies])]
    read = lambda kind: (configuration.q[kind.coordinates], speeds(kind))
    turning = [kind for kind in topology.joint_groups if getattr(kind.motion, "angular_subspace_at", None) is not None]
    found = [(kind, (jax.vmap(partial(_turning, kind.motion))(*read(kind)),)) for kind in turning]
    for kind, (turn, *slides) in (*found, *over_bending(_bending, system, read)):
        axes = configuration.joint_axes[np.array(kind.bodies)]
        turned = scatter_static(turned, kind.bodies, rotate(axes, turn))
        for acceleration in slides:
            slid = scatter_static(slid, kind.bodies, rotate(axes, acceleration))
    return turned, slid


def _turning(kind, coordinates, speeds):
    """Angular acceleration by axes that turn with their own coordinates."""
    return speeds @ jax.jvp(kind.angular_subspace_at, (coordinates,), (speeds,))[1]


@whole_jacobian
def _bending(motion, coordinates, speeds, numbers):
    """Angular and linear acceleration of a `RelativeMotion` at constant speeds."""
    place = lambda coordinates: motion(coordinates, numbers)
    change = lambda coordinates: joint_rates(motion.has_quaternion, coordinates, speeds)
    rate = lambda coordinates: jax.jvp(place, (coordinates,), (change(coordinates),))[1]
    at, accelerations = place(coordinates), jax.jvp(rate, (coordinates,), (change(coordinates),))[1]
    # The symmetric part of R̈ Rᵀ is ω × (ω × …).
    return turn_rate(accelerations[:3, :3], at[:3, :3]), accelerations[:3, 3]
