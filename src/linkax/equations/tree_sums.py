"""Sums and products along the spanning tree, and between bodies, motions and speeds.

A motion is a pair (body, speed that moves it on its predecessor), see `linkax.model.topology.Topology.motions`.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.system import System
from linkax.linalg.static_sparse import constant_product
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.spatial.rotations import compose
from linkax.xla.arrays import Array


def along_path(system: System, edges: Float[Array, " n_b *rest"]) -> Float[Array, " n_b+1 *rest"]:
    """Sum over the tree joints from ground to each body: (n_b, …) to (n_b + 1, …)."""
    return constant_product(system.topology.path, edges)


def over_subtree(system: System, bodies: Float[Array, " n_b *rest"]) -> Float[Array, " n_b *rest"]:
    """Sum over each body and all that it carries: (n_b, …) to (n_b, …)."""
    return constant_product(system.topology.path[:-1].T, bodies)


def sum_by_body(system: System, motions: Float[Array, "n_m 3"]) -> Float[Array, "n_b 3"]:
    """Sum vectors per motion, (n_m, 3), for each body that is moved: (n_b, 3)."""
    topology = system.topology
    if np.array_equal(topology.moved_body, np.arange(topology.num_bodies)):
        return motions
    onto = np.arange(topology.num_bodies)[:, None] == topology.moved_body
    return constant_product(onto, motions)


def expand_to_motions(topology: Topology, speeds: Float[Array, " n_v *rest"]) -> Float[Array, " n_m *rest"]:
    """Repeat values per speed, (n_v, …), for each motion that the speed causes: (n_m, …)."""
    return speeds if topology.motion_column is None else speeds[topology.motion_column]


def sum_by_speed(topology: Topology, motions: Float[Array, "*rest n_m"]) -> Float[Array, "*rest n_v"]:
    """Sum values per motion, (…, n_m), for each speed: (…, n_v)."""
    if topology.motion_column is None:
        return motions
    onto = np.arange(topology.num_speeds)[:, None] == topology.motion_column
    return jnp.moveaxis(constant_product(onto, jnp.moveaxis(motions, -1, 0)), 0, -1)


def product_along_path(topology: Topology, relative: Float[Array, "n_b 3 3"]) -> Float[Array, "n_b+1 3 3"]:
    """Multiply relative rotations, (n_b, 3, 3), from ground to each body, in log₂(depth) rounds: (n_b + 1, 3, 3)."""
    rotation = jnp.concatenate([relative, jnp.eye(3, dtype=relative.dtype)[None]])
    carrier = np.array([*topology.predecessor, GROUND_INDEX])
    while np.any(carrier != GROUND_INDEX):
        rotation = compose(rotation[carrier], rotation)
        carrier = carrier[carrier]
    return rotation
