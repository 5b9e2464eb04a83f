"""Which loop rows and speeds of a mechanism depend on each other: islands, and the order of elimination."""

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from linkax.linalg.elimination_plan import PER_FRONT, EliminationPlan, plan_elimination, work_at_once
from linkax.model.topology import Topology
from linkax.xla.arrays import Array

# More rows than speeds are redundant. Chosen front by front, rows that are independent are so by less than those chosen
# among all: states seem closer to a singular configuration, and limits take their time. Fronts must save this much.
REDUNDANT = 4.0


class Island(NamedTuple):
    """A part of a mechanism that moves independently of the rest: its loop rows and its speeds."""

    rows: tuple[int, ...]
    columns: tuple[int, ...]


class Structure(NamedTuple):
    """How the equations of a mechanism fall apart.

    - `islands`: parts that neither a loop nor an inertia connects, in the order of their speeds.
    - `elimination`: fronts in which the loops are solved one after the other; None where all at once takes less.
    """

    islands: tuple[Island, ...]
    elimination: EliminationPlan | None

    def ranks_of_islands(self, ranks: Int[Array, " k"]) -> Int[Array, " n_islands"]:
        """Add up the ranks of fronts, (k,), for each island; without fronts they are those of islands."""
        plan = self.elimination
        if plan is None:
            return ranks
        first = [min((*added, *kept)) for added, kept in zip(plan.interior, plan.separator, strict=True)]
        is_part = np.array([np.isin(first, columns) for _, columns in self.islands])
        return jnp.asarray(is_part, int) @ ranks


@cache
def structure_of(topology: Topology) -> Structure:
    """The islands of a mechanism, and its fronts where they take less work."""
    islands = _islands(topology)
    at_once = sum(work_at_once(len(rows), len(columns)) for rows, columns in islands)
    if topology.num_rows == 0 or at_once <= PER_FRONT:
        return Structure(islands, None)
    plan = plan_elimination(topology.read_by_rows, topology.coupled_by_inertia, topology.num_speeds)
    worth = REDUNDANT if topology.num_rows > topology.num_speeds else 1.0
    return Structure(islands, plan if worth * plan.work < at_once else None)


def _islands(topology):
    label = np.arange(topology.num_speeds)
    for together in (*topology.coupled_by_inertia, *topology.read_by_rows):
        label[np.isin(label, label[together])] = np.min(label[together], initial=topology.num_speeds)
    row_label = np.array([label[columns[0]] if len(columns) else 0 for columns in topology.read_by_rows], dtype=int)
    return tuple(
        Island(*(tuple(np.flatnonzero(of == part).tolist()) for of in (row_label, label))) for part in np.unique(label)
    )
