"""How far loops are open, and from where to close them."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import Configuration
from linkax.equations.loop_rows import chosen_rows, row_jacobian, row_residual
from linkax.equations.loops import residual
from linkax.equations.system import System
from linkax.spatial.rotations import rotate, transpose
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array

FLIP_WEIGHT = 2.0  # more than one: axes that point apart are farther from being in line than those at a right angle


def locked_separation(configuration: Configuration) -> Float[Array, "n_cut 3"]:
    """The part of the separations along locked directions, in joint axes of the parent [m]."""
    topology = configuration.system.topology
    kinds = topology.cut_types
    locked = np.array([[i in kind.locked_translations for i in range(3)] for kind in kinds]).reshape(-1, 3)
    return jnp.where(locked, rotate(transpose(configuration.parent_axes), configuration.separation), 0.0)


def as_if_closed(configuration: Configuration) -> Configuration:
    """The same configuration without the separations that should not be there.

    The Jacobian of it is the better direction to close a loop in from far away: rows along
    axes that turn with the parent would otherwise trade turning against closing.
    """
    apart = rotate(configuration.parent_axes, locked_separation(configuration))
    return eqx.tree_at(lambda c: c.separation, configuration, configuration.separation - apart)


def flips(configuration: Configuration) -> tuple[Float[Array, " k"], Float[Array, "k n_v"]]:
    """Rows that are nonzero only where an aligned pair of axes is flipped by 180°, and their Jacobian.

    Locked rotations alone would also be satisfied by axes that point opposite ways.
    """
    topology = configuration.system.topology
    kinds = topology.cut_types
    rows = chosen_rows(configuration, [(cut, i, i) for cut, kind in enumerate(kinds) for i in kind.aligned_axes], [])
    cosine, slopes = row_residual(configuration, rows), row_jacobian(configuration, rows).dense()
    apart = cosine < 0.0
    return jnp.where(apart, FLIP_WEIGHT * cosine, 0.0), jnp.where(apart[:, None], FLIP_WEIGHT * slopes, 0.0)


class Gap(NamedTuple):
    """How far constraints are open.

    - `distance`: of each cut joint along its locked directions [m], its combined row included;
      `angle`: between axes that it holds in line [rad], (n_cut,) each.
    - `constraints`: of each constraint on coordinates, in the units of its sum, (k,).
    """

    distance: Float[Array, " n_cut"]
    angle: Float[Array, " n_cut"]
    constraints: Float[Array, " k"]

    def in_scales(self, system: System) -> "Gap":
        """The same in radians and lengths of the mechanism."""
        return Gap(self.distance / system.length, self.angle, self.constraints / system.constraint_scales)

    def widest(self) -> Float[Array, ""]:
        """The largest of all; not a number where one is none."""
        return jnp.max(jnp.concatenate(self), initial=0.0)


def gaps(configuration: Configuration) -> Gap:
    """How far constraints are open, rows that no motion changes included."""
    system, topology = configuration.system, configuration.system.topology
    kinds = topology.cut_types
    held = np.array([[i in kind.aligned_axes for i in range(3)] for kind in kinds]).reshape(-1, 3)
    parent_axes, child_axes = configuration.parent_axes, configuration.child_axes
    across = jnp.linalg.norm(cross(transpose(parent_axes), transpose(child_axes)), axis=-1)
    angle = jnp.arctan2(across, jnp.sum(parent_axes * child_axes, axis=-2))
    rows = residual(configuration)
    last = topology.num_constraint_rows
    first = topology.num_rows - len(topology.combining) - last
    combined = jnp.zeros(topology.num_cuts, system.dtype)
    if topology.combining:
        cuts = np.array(topology.combining)
        combined = combined.at[cuts].set(rows[first : topology.num_rows - last] * system.loop_length[cuts])
    distance = jnp.concatenate([locked_separation(configuration), combined[:, None]], axis=1)
    return Gap(
        distance=jnp.linalg.norm(distance, axis=-1),
        angle=jnp.max(jnp.where(held, angle, 0.0), axis=-1, initial=0.0),
        constraints=jnp.abs(rows[topology.num_rows - last :] * system.constraint_scales),
    )
