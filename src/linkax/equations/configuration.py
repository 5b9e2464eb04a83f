"""Poses of all bodies by recursion along the tree, all bodies at once.

Vectors are in ground axes. Sums from ground to each body are products with the topology's `path`; only orientations
need products along the way. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4, gives the recursions.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Real

from linkax.equations.coordinates import coordinates_by_speed
from linkax.equations.joint_motions import joint_motions
from linkax.equations.system import System
from linkax.equations.tree_sums import along_path, over_subtree, product_along_path, sum_by_speed
from linkax.linalg.static_sparse import constant_product
from linkax.model.attached import AbstractPoses, BodyPose
from linkax.model.beams import Beam
from linkax.model.bodies import Frame
from linkax.model.forces.force import Load
from linkax.model.joints.bending import section_at
from linkax.model.numbers import Number
from linkax.model.terms import Term
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.spatial.rotations import compose, rotate, transpose
from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array, Scalar, ScalarLike
from linkax.xla.tracing import jit_inline


class Configuration(AbstractPoses):
    """Poses of all bodies at time t and coordinates q. Last row of body arrays with n_b + 1 rows: ground.

    - `rotation`: orientation of each body, axes as columns, (n_b + 1, 3, 3).
    - `link`: from the predecessor's reference point to the body's, without anchors [m], (n_b, 3).
    - `position`: reference point of each body from the anchor of its tree [m], (n_b + 1, 3).
    - `joint_axes`: h¹, h², h³ of each joint on its parent, as columns, (n_j, 3, 3).
    - `parent_arm`, `child_arm`: from the reference point of each joint's parent to the origin of the child's frame
      (tree joints) or of the parent's frame (cut joints), and from the child's to that of the child's frame [m], (n_j,
      3).
    - `angular`, `sliding`: motion subspace of each of the topology's `motions`: angular velocity, and velocity at the
      origin of the child's frame, of the moved body per unit speed, (n_m, 3).
    - `linear`: the same velocity at the anchor of the tree, (n_m, 3).
    - `child_axes`: h¹, h², h³ of each cut joint on its child, as columns, (n_cut, 3, 3).
    - `separation`: s of each cut joint, from the origin on the parent to that on the child [m], (n_cut, 3), summed
      around the loop from the common ancestor, not from the world's origin.
    """

    system: System
    t: ScalarLike
    q: Float[Array, " n_q"]
    rotation: Float[Array, "n_frames 3 3"]
    link: Float[Array, "n_b 3"]
    position: Float[Array, "n_frames 3"]
    joint_axes: Float[Array, "n_j 3 3"]
    parent_arm: Float[Array, "n_j 3"]
    child_arm: Float[Array, "n_j 3"]
    angular: Float[Array, "n_m 3"]
    sliding: Float[Array, "n_m 3"]
    linear: Float[Array, "n_m 3"]
    child_axes: Float[Array, "n_cut 3 3"]
    separation: Float[Array, "n_cut 3"]

    @property
    def parent_axes(self) -> Float[Array, "n_cut 3 3"]:
        """h¹, h², h³ of each cut joint on its parent, as columns."""
        return self.joint_axes[self.system.topology.num_bodies :]

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

    def body(self, name: str) -> int:
        """Index of a body, or of ground."""
        return self.system.topology.body_index(name)

    def arm(self, frame: Frame) -> Float[Array, "3"]:
        """Vector from the reference point of a frame's body to the frame's origin, in ground axes [m]."""
        return self.rotation[self.body(frame.body)] @ jnp.asarray(frame.offset, self.system.dtype)

    def pose(self, body: str) -> BodyPose:
        index, nothing = self.body(body), jnp.zeros(3, self.system.dtype)
        if index == GROUND_INDEX:
            return BodyPose(self.rotation[index], nothing, nothing)
        return BodyPose(
            self.rotation[index], self.position[index], self.system.anchor[self.system.topology.root[index]]
        )

    def point_load(self, frame: Frame, force: Real[Array, "3"], moment: Real[Array, "3"] | float = 0.0) -> Load:
        """Make the load of a force at a frame's origin, and a moment, in ground axes [N, N m]; none on the ground."""
        return self.wrench(self.body(frame.body), self.arm(frame), force, moment)

    def wrench(
        self, body: int, arm: Float[Array, "3"], force: Real[Array, "3"], moment: Real[Array, "3"] | float
    ) -> Load:
        """Make the load of a force at a point of a body, and a moment [N, N m]."""
        none = Load.none(self.system)
        if body == GROUND_INDEX:
            return none
        # A user's own function may have computed in double precision.
        force, moment = (jnp.asarray(part, self.system.dtype) for part in (force, moment))
        about_mass = moment + cross(arm - self.center_of_mass()[body], force)
        return none._replace(force=none.force.at[body].set(force), moment=none.moment.at[body].set(about_mass))

    def joint_coordinates(self, name: str) -> Float[Array, " n"]:
        """Coordinates of a joint, in the tree or cut [rad or m]."""
        topology = self.system.topology
        if name in topology.coordinates:
            return self.q[topology.coordinates[name]]
        return self.cut_coordinates([name])[0]

    def cut_coordinates(self, names: Sequence[str]) -> Float[Array, "k n"]:
        """Coordinates of cut joints of one type [rad or m]."""
        kind, axes, cut = self._cut(names)
        to_parent = transpose(axes)
        return jax.vmap(kind.measure)(compose(to_parent, self.child_axes[cut]), rotate(to_parent, self.separation[cut]))

    def joint_displacement(self, term: Term, origin: Number) -> Float[Array, ""]:
        """A joint's coordinate less an origin [rad or m]."""
        index, topology = term.index or 0, self.system.topology
        if term.joint in topology.speeds:
            return coordinates_by_speed(topology, self.q)[topology.column(term)] - origin
        kind = topology.joint_types[topology.joints.index(term.joint)]
        return self.joint_coordinates(term.joint)[index + kind.has_quaternion] - origin

    def _cut(self, names):
        """Type, axes on the parents, and indices of cut joints of one type."""
        topology = self.system.topology
        joints = np.array([topology.joint_index(name) for name in names])
        cut = joints - topology.num_bodies
        return topology.cut_types[cut[0]], self.joint_axes[joints], cut

    def cut_subspace(self, names: Sequence[str]) -> tuple[Float[Array, "k n 3"], Float[Array, "k n 3"]]:
        """Motion subspaces of cut joints of one type in ground axes, angular and linear part, (k, n, 3) each.

        Their columns dotted with the relative twist are a joint's speeds; as wrenches they are forces along the joint.
        """
        kind, axes, _ = self._cut(names)
        angular = jnp.asarray(np.array(kind.angular_subspace).reshape(-1, 3), axes.dtype)
        linear = jnp.asarray((not kind.is_screw) * np.array(kind.linear_subspace).reshape(-1, 3), axes.dtype)
        if kind.angular_subspace_at is not None:
            angular = jax.vmap(kind.angular_subspace_at)(self.cut_coordinates(names))
        return compose(angular, transpose(axes)), compose(linear, transpose(axes))


def wrapped(angles: Scalar | Float[Array, "..."], is_angle: bool | Bool[Array, "..."]) -> Float[Array, "..."]:
    """Bring differences of angles into [−π, π); leave lengths as they are."""
    return jnp.where(is_angle, jnp.mod(angles + jnp.pi, 2.0 * jnp.pi) - jnp.pi, angles)


def along_speeds(
    configuration: Configuration, force: Float[Array, "n_b 3"], moment: Float[Array, "n_b 3"]
) -> Float[Array, " n_v"]:
    """Project wrenches on bodies, (n_b, 3) each, moments about the centre of mass, on the speeds: Σ Sᵀ w."""
    system, topology = configuration.system, configuration.system.topology
    body = topology.moved_body
    arm = configuration.position[:-1] + configuration.center_of_mass()
    force, moment = over_subtree(system, force), over_subtree(system, moment + cross(arm, force))
    return sum_by_speed(topology, dot(configuration.linear, force[body]) + dot(configuration.angular, moment[body]))


def beam_point(configuration: Configuration, beam: Beam, point: Float[Array, "3"]) -> Float[Array, "3"]:
    """Position of a point (3,) fixed to the section of a beam at point[0], in the world [m]."""
    nodes = jnp.array([configuration.body(name) for name in beam.nodes])
    coordinates = configuration.joint_coordinates(beam.name)
    section, element = section_at(coordinates, beam.strains, beam.element_length, point[0])
    seen = section[:3, 3] + section[:3, 1:3] @ point[1:]
    node = nodes[element]
    return configuration.world_position()[node] + configuration.rotation[node] @ seen


def bodies_of_cuts(
    topology: Topology,
) -> tuple[Int[np.ndarray, " n_cut"], Int[np.ndarray, " n_cut"], Int[np.ndarray, " n_cut"]]:
    """Parent and child body of each cut joint, and the joints' indices."""
    cuts = np.arange(topology.num_bodies, len(topology.joints))
    return np.array(topology.parent, dtype=int)[cuts], np.array(topology.child, dtype=int)[cuts], cuts


@jit_inline
def configure(system: System, t: ScalarLike, q: Float[Array, " n_q"]) -> Configuration:
    """Compute the poses of all bodies and the motion subspaces of all joints at coordinates q."""
    topology, count = system.topology, system.topology.num_bodies
    parent, child = np.array(topology.parent), np.array(topology.child)
    reversed_ = topology.reversed[:, None]
    turn, shift, angular_subspace, linear_subspace = joint_motions(system, q)
    relative = compose(compose(system.parent_axes[:count], turn), transpose(system.child_axes[:count]))
    if np.any(reversed_):
        relative = jnp.where(reversed_[:, :, None], transpose(relative), relative)
    rotation = product_along_path(topology, relative)
    joint_axes = compose(rotation[parent], system.parent_axes)
    parent_arm = rotate(rotation[parent], system.parent_offset)
    child_arm = rotate(rotation[child], system.child_offset)
    parent_arm = parent_arm.at[:count].add(rotate(joint_axes[:count], shift))
    sign = jnp.where(reversed_, -1.0, 1.0).astype(q.dtype)
    link = sign * (parent_arm - child_arm)[:count]
    position = along_path(system, link)
    subspace_axes = (sign[:, :, None] * joint_axes[:count])[topology.moved_body]
    angular, sliding = rotate(subspace_axes, angular_subspace), rotate(subspace_axes, linear_subspace)
    joint_point = (position[child[:count]] + child_arm[:count])[topology.moved_body]

    on_parent, on_child, cuts = bodies_of_cuts(topology)
    anchor = lambda body: system.anchor[np.where(topology.root[body] < 0, cuts, topology.root[body])]
    around = constant_product(topology.loop, link)
    return Configuration(
        system=system,
        t=t,
        q=q,
        rotation=rotation,
        link=link,
        position=position,
        joint_axes=joint_axes,
        parent_arm=parent_arm,
        child_arm=child_arm,
        angular=angular,
        sliding=sliding,
        linear=sliding + cross(joint_point, angular),
        child_axes=compose(rotation[on_child], system.child_axes[cuts]),
        separation=around + (child_arm[cuts] - parent_arm[cuts]) + (anchor(on_child) - anchor(on_parent)),
    )
