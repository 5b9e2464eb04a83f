"""Motions of joints in the tree: rotation, translation and motion subspace of each, in joint axes."""

from collections.abc import Callable, Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.coordinates import coordinates_by_speed, joint_rates
from linkax.equations.system import System
from linkax.equations.tree_sums import expand_to_motions, sum_by_body
from linkax.model.joints.joint import RelativeMotion
from linkax.model.topology import JointGroup
from linkax.spatial.screws import turn_rate
from linkax.xla.arrays import Array
from linkax.xla.static_scatter import scatter_static
from linkax.xla.whole_jacobian import whole_jacobian


def joint_motions(
    system: System, q: Float[Array, " n_q"]
) -> tuple[Float[Array, "n_b 3 3"], Float[Array, "n_b 3"], Float[Array, "n_m 3"], Float[Array, "n_m 3"]]:
    """Evaluate all joints of the tree at coordinates q.

    **Returns:** rotations, (n_b, 3, 3), and translations, (n_b, 3), of the child's frame in that of the parent; motion
    subspace of each motion, angular and linear, (n_m, 3) each.
    """
    topology, order, turns = system.topology, [], []
    angular = jnp.asarray(_constant_subspace(topology, "angular_subspace"), q.dtype)
    linear = _linear_subspace(system)
    shift = sum_by_body(system, linear * expand_to_motions(topology, coordinates_by_speed(topology, q))[:, None])
    for kind in topology.joint_groups:
        if isinstance(kind.motion, RelativeMotion):
            continue
        turn = jax.vmap(kind.motion.rotation)(q[kind.coordinates])
        if kind.motion.angular_subspace_at is not None:
            turned = jax.vmap(kind.motion.angular_subspace_at)(q[kind.coordinates])
            angular = scatter_static(angular, _motions_of(topology, kind), turned)
        turns.append(turn)
        order += kind.bodies
    for kind, (turn, away, *subspace) in over_bending(_bent, system, lambda kind: (q[kind.coordinates],)):
        motions = _motions_of(topology, kind)
        count = len(motions) // len(kind.bodies)
        angular, linear = (
            scatter_static(whole, motions, part[:, :count])
            for whole, part in zip((angular, linear), subspace, strict=True)
        )
        shift = scatter_static(shift, kind.bodies, away)
        turns.append(turn)
        order += kind.bodies
    turn = turns[0] if len(turns) == 1 else jnp.concatenate(turns)[np.argsort(order)]
    return turn, shift, angular, linear


def over_bending(
    function: Callable[..., tuple[Array, ...]], system: System, read: Callable[[JointGroup], tuple[Array, ...]]
) -> Iterator[tuple[JointGroup, tuple[Array, ...]]]:
    """Map a function of (`RelativeMotion`, arrays (k,), parameters) over all joints that have such a motion.

    Joints with equal motions are one batch, so that the function is traced once for each motion.

    **Arguments:** `read`: the arrays of a joint group, (n, k) each.

    **Yields:** each joint group and what the function gives for its joints.
    """
    alike = {}
    for kind, numbers in zip(system.topology.joint_groups, system.group_parameters, strict=True):
        if numbers is not None:
            alike.setdefault(kind.motion, []).append((kind, numbers))
    for motion, members in alike.items():
        most = max(kind.coordinates.shape[1] for kind, _ in members)
        arrays = [
            (*(jnp.pad(array, ((0, 0), (0, most - kind.coordinates.shape[1]))) for array in read(kind)), numbers)
            for kind, numbers in members
        ]
        together = (array[0] if len(members) == 1 else jnp.concatenate(array) for array in zip(*arrays, strict=True))
        found = jax.vmap(partial(function, motion))(*together)
        first = 0
        for kind, _ in members:
            own = slice(first, first + len(kind.bodies))
            yield kind, tuple(part[own] for part in found)
            first = own.stop


def _motions_of(topology, kind):
    """Indices of the motions of a joint group among the topology's."""
    return np.flatnonzero(np.isin(topology.moved_body, kind.bodies))


@whole_jacobian
def _bent(motion, coordinates, numbers):
    """Rotation and translation of a `RelativeMotion`, and its motion subspace, angular and linear, (n, 3) each."""
    change = lambda v: joint_rates(motion.has_quaternion, coordinates, v)
    follow = lambda v: jax.jvp(lambda q: motion(q, numbers), (coordinates,), (change(v),))
    speeds = jnp.eye(len(coordinates) - motion.has_quaternion, dtype=coordinates.dtype)
    at, changes = jax.vmap(follow, out_axes=(None, 0))(speeds)
    return at[:3, :3], at[:3, 3], turn_rate(changes[:, :3, :3], at[:3, :3]), changes[:, :3, 3]


def _constant_subspace(topology, part):
    """Columns of the motion subspace that are constants of the joint types, (n_m, 3); zero for the others."""
    columns = []
    for body, kind in enumerate(topology.joint_types[: topology.num_bodies]):
        bends = kind.motion is not None
        columns += len(topology.columns(body)) * [(0.0, 0.0, 0.0)] if bends else getattr(kind, part)
    return np.array(columns).reshape(-1, 3)


def _linear_subspace(system):
    """Linear motion subspace of each motion, (n_m, 3): constants, times the pitch for screws; zero on beams."""
    topology = system.topology
    subspace = jnp.asarray(_constant_subspace(topology, "linear_subspace"), system.dtype)
    screws = np.array([kind.is_screw for kind in topology.joint_types[: topology.num_bodies]])[topology.moved_body]
    if not np.any(screws):
        return subspace
    return jnp.where(screws[:, None], system.joint_parameter[topology.moved_body][:, None], 1.0) * subspace
