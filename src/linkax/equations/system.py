"""The numbers of a mechanism, stacked in the order of its bodies and joints."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Float

from linkax.equations.structure import Structure, structure_of
from linkax.linalg.static_sparse import constant_product
from linkax.model.constraints.constraint import AbstractConstraint
from linkax.model.forces.joint_forces import JointInertia
from linkax.model.joints.joint import RelativeMotion
from linkax.model.joints.table_joint import TableJoint
from linkax.model.mechanism import Mechanism, require_unchanged
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.spatial.vectors import largest
from linkax.spatial.vectors import length as length_of
from linkax.xla.arrays import Array
from linkax.xla.derivatives import positive_or_one
from scalarjit import Flat
from scalarjit.code import OwnClasses


class System(eqx.Module):
    """A mechanism as arrays: bodies in tree order (n_b), joints tree first, then cut (n_j).

    - `mass` [kg] (n_b,), `center_of_mass` [m] (n_b, 3), `inertia` about it [kg m²] (n_b, 3, 3),
      in body axes.
    - `parent_offset`, `child_offset` [m] (n_j, 3): origins of the joint's frames in body axes;
      zero on ground, whose part is kept apart in `anchor` [m] (n_j, 3), world axes, so that
      a mechanism far from the origin loses no digits.
    - `parent_axes`, `child_axes` (n_j, 3, 3): the joint's axes as columns, in body axes.
    - `joint_inertia` [kg m², kg] (n_v,): what `JointInertia` adds along each speed; None where there is none.
    - `joint_parameter` [m] (n_j,): the parameter of a joint whose type has one.
    - `group_parameters`: for each of the topology's `joint_groups` with a `RelativeMotion` the parameters of its
      joints, (n, k); None for the others.
    - `loop_length` [m] (n_cut,): half the way around each loop, the unit of its translation rows.
    - `length` [m]: the mechanism's length, the unit of sliding coordinates.
    - `forces`: force elements, or such held on one side of their switch.
    - `own_classes`: what a user's classes among forces, constraints and joints read, see `Mechanism`.
    - `constraint_scales` (k,): one unit of each row of the constraints, in radians and lengths of the mechanism.
    """

    topology: Topology = eqx.field(static=True)
    own_classes: OwnClasses = eqx.field(static=True)
    mass: Float[Array, " n_b"]
    center_of_mass: Float[Array, "n_b 3"]
    inertia: Float[Array, "n_b 3 3"]
    joint_inertia: Float[Array, " n_v"] | None
    parent_offset: Float[Array, "n_j 3"]
    child_offset: Float[Array, "n_j 3"]
    anchor: Float[Array, "n_j 3"]
    parent_axes: Float[Array, "n_j 3 3"]
    child_axes: Float[Array, "n_j 3 3"]
    joint_parameter: Float[Array, " n_j"]
    group_parameters: tuple[Float[Array, "_ _"] | None, ...]
    loop_length: Float[Array, " n_cut"]
    length: Float[Array, ""]
    constraint_scales: Float[Array, " k"]
    constraints: tuple[AbstractConstraint, ...]
    forces: tuple[Any, ...]

    @property
    def dtype(self) -> np.dtype:
        return self.mass.dtype

    @property
    def structure(self) -> Structure:
        """Islands and elimination plan of the equations."""
        return structure_of(self.topology)

    @property
    def scales(self) -> Float[Array, " n_v"]:
        """One unit of each speed, or small change: 1 rad, or the mechanism's length [m]."""
        return jnp.where(self.topology.slides, self.length, jnp.ones((), self.dtype))

    def fastest(self, v: Float[Array, " n_v"]) -> Float[Array, ""]:
        """The largest speed of v, (n_v,), or change, in radians and lengths of the mechanism: max |v / scales|."""
        return largest(v / self.scales)


def system_of(mechanism: Mechanism | Flat[Mechanism], dtype: DTypeLike, fixed_scales: bool = True) -> System:
    """Stack the numbers of a mechanism in a floating-point type.

    **Arguments:** `fixed_scales`: lengths that serve as scales have no derivative, since no motion depends on them;
    what is told in them does, such as the distance from a singular configuration.
    """
    mechanism = mechanism.tree if isinstance(mechanism, Flat) else mechanism
    require_unchanged(mechanism)
    topology = mechanism.topology
    joints: tuple[Any, ...] = mechanism.joints

    def stack(entries, shape):
        entries = [jnp.asarray(entry, dtype) for entry in entries]
        return jnp.stack(entries) if entries else jnp.zeros((0, *shape), dtype)

    frames = [joint.frames() for joint in joints]
    parent_offset = stack([joint.parent.offset for joint in joints], (3,))
    child_offset = stack([joint.child.offset for joint in joints], (3,))
    parent_on_ground = (np.array(topology.parent) == GROUND_INDEX)[:, None]
    child_on_ground = (np.array(topology.child) == GROUND_INDEX)[:, None]
    center_of_mass = stack([body.center_of_mass for body in mechanism.bodies], (3,))
    fixed = lax.stop_gradient if fixed_scales else lambda array: array
    bends = np.array([joint.kind.motion is not None for joint in joints], dtype=bool)
    bent = stack([joint.length_estimate for joint in joints], ()) if np.any(bends) else None
    ends = fixed(parent_offset), fixed(child_offset)
    loop_length, length = _lengths(topology, *ends, fixed(center_of_mass), bent)
    slides = lambda along: bool(topology.slides[topology.column(along)])
    constraint_scales = [unit for each in mechanism.constraints for unit in each.row_scales(length, slides)]
    return System(
        own_classes=mechanism.own_classes,
        topology=topology,
        mass=stack([body.mass for body in mechanism.bodies], ()),
        center_of_mass=center_of_mass,
        inertia=stack([body.inertia for body in mechanism.bodies], (3, 3)),
        joint_inertia=_joint_inertia(mechanism, stack),
        parent_offset=jnp.where(parent_on_ground, 0.0, parent_offset),
        child_offset=jnp.where(child_on_ground, 0.0, child_offset),
        anchor=jnp.where(parent_on_ground, parent_offset, jnp.where(child_on_ground, child_offset, 0.0)),
        parent_axes=stack([parent for parent, _ in frames], (3, 3)),
        child_axes=stack([child for _, child in frames], (3, 3)),
        group_parameters=tuple(
            stack([joints[body].parameters for body in kind.bodies], ())
            if isinstance(kind.motion, RelativeMotion)
            else None
            for kind in topology.joint_groups
        ),
        joint_parameter=stack([joint.parameter if isinstance(joint, TableJoint) else 0.0 for joint in joints], ()),
        loop_length=loop_length,
        length=length,
        constraint_scales=fixed(stack(constraint_scales, ())),
        constraints=mechanism.constraints,
        forces=mechanism.forces,
    )


def _joint_inertia(mechanism, stack):
    elements = [force for force in mechanism.forces if isinstance(force, JointInertia)]
    if not elements:
        return None
    along = np.array([mechanism.topology.column(element.joint) for element in elements])
    onto = np.arange(mechanism.topology.num_speeds)[:, None] == along
    return constant_product(onto, stack([element.inertia for element in elements], ()))


def _lengths(topology, parent_offset, child_offset, center_of_mass, bent):
    """Half the way around each loop, and the larger of these and of the reach from ground [m].

    **Arguments:** `bent`: length that joints on beams add to a way, (n_j,); None where there are none.
    """
    ends = jnp.concatenate([parent_offset, child_offset])  # joint j: rows j and n_j + j
    distance = lambda pairs: length_of(ends[pairs[:, 0]] - ends[pairs[:, 1]])
    ways = [np.array(_stations(topology, cut)).reshape(-1, 2) for cut in range(topology.num_cuts)]
    around = [jnp.sum(distance(pairs)) for pairs in ways]

    count = len(topology.joints)
    moved = np.arange(topology.num_bodies)
    near = np.where(topology.reversed, moved + count, moved)  # the end on the predecessor
    far = np.where(topology.reversed, moved, moved + count)  # the end on the body itself
    carrier = np.array(topology.predecessor)
    link = jnp.where(carrier == GROUND_INDEX, 0.0, distance(np.stack([near, far[carrier]], axis=-1)))
    if bent is not None:
        link = link + bent[moved]
        around = [way + np.abs(loop) @ bent[moved] for way, loop in zip(around, topology.loop, strict=True)]
    loop_length = jnp.stack([way / 2 for way in around]) if around else jnp.zeros(0, ends.dtype)
    to_mass = length_of(center_of_mass - ends[far])
    reach = jnp.asarray(topology.path[:-1], ends.dtype) @ link + to_mass
    length = positive_or_one(jnp.max(jnp.concatenate([loop_length, reach])))
    return jnp.where(loop_length > 0.0, loop_length, length), length


def _stations(topology, cut):
    """For each body of a loop, ground included, the two joint ends it holds (rows of `ends`)."""
    count, joint = len(topology.joints), topology.num_bodies + cut
    members = [*np.flatnonzero(topology.loop[cut]), joint]
    held = {}
    for member in members:
        held.setdefault(topology.parent[member], []).append(member)
        held.setdefault(topology.child[member], []).append(member + count)
    return [pair for pair in held.values() if len(pair) == 2]
