"""How a mechanism can move at a state, and which of its constraints are redundant."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from linkax.equations.system import system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import singularity_distance
from linkax.linalg.least_multipliers import least_multipliers
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import require_type
from linkax.model.topology import Topology
from linkax.simulation.integrate.accuracy import BALANCED, Accuracy
from linkax.simulation.integrate.options import check_accuracy
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, checked_formulation
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.xla.tracing import quick_compile

INVOLVED = 1e-6  # least part of a row in a self-stress of magnitude one
# Table 1 of the paper: which axes of parent and child each rotation row keeps orthogonal.
ROTATIONS = {(1, 2): "α₁", (2, 1): "α₁", (0, 2): "α₂", (0, 1): "α₃"}
TRANSLATIONS = ("s₁", "s₂", "s₃")


class Mobility(eqx.Module):
    """How a mechanism can move at a state.

    - `rank`: number of independent constraints. `degrees_of_freedom`: of the speeds there; one more
      for each constraint that is lost in a singular configuration.
    - `num_redundant`: constraints that depend on others, those that no motion changes included.
    - `distance`: from the nearest singular configuration, see `linkax.Accuracy`. Exactly in one the
      smaller `rank` tells, and not this. NaN where a number that JAX traces is outside of what it can be.
    - `dispensable`: of each constraint row, in the order of `rows`, whether it could be left out
      without freeing anything.
    """

    rank: Int[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    num_redundant: Int[Array, ""]
    distance: Float[Array, ""]
    dispensable: Bool[Array, " m"]
    topology: Topology = eqx.field(static=True)

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """(joint or constraint, row of Table 1 of the paper) of every row."""
        return row_names(self.topology)

    @property
    def redundant(self) -> dict[str, tuple[str, ...]]:
        """Rows of each cut joint and constraint that could be left out, one at a time."""
        found = {}
        for (name, row), dispensable in zip(self.rows, np.asarray(self.dispensable), strict=True):
            if dispensable:
                found[name] = (*found.get(name, ()), row)
        return found


def row_names(topology: Topology) -> tuple[tuple[str, str], ...]:
    """(joint or constraint, row of Table 1 of the paper) of every row, those that no motion changes last."""
    cuts = topology.joints[topology.num_bodies :]
    rotation = lambda rows: [(cuts[cut], ROTATIONS[i, j]) for cut, i, j in rows]
    translation = lambda rows: [(cuts[cut], TRANSLATIONS[i]) for cut, i in rows]
    return (
        *rotation(topology.rotation_rows),
        *translation(topology.translation_rows),
        *((cuts[cut], "combined") for cut in topology.combining),
        *((name, "coordinates") for name in topology.constraints),
        *rotation(topology.immobile_rotation_rows),
        *translation(topology.immobile_translation_rows),
    )


def mobility(
    mechanism: Mechanism,
    state: State,
    *,
    t=0.0,
    formulation: TangentSpace = DEFAULT_FORMULATION,
    accuracy: Accuracy = BALANCED,
) -> Mobility:
    """Rank, degrees of freedom and redundant constraints of a mechanism at a state on its closed loops.

    **Arguments:** `t`: time [s]; `formulation`: whose rank tolerance decides; `accuracy`: deprecated.
    """
    check_accuracy(accuracy)
    formulation = checked_formulation(formulation, accuracy)
    require_type(formulation, TangentSpace, "formulation", "give linkax.TangentSpace(...)")
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    return marked(mechanism, _mobility(mechanism, state, t, formulation))


@quick_compile
def _mobility(mechanism, state, t, tangent_space):
    system, topology = system_of(mechanism, state.q.dtype, fixed_scales=False), mechanism.topology
    tolerance = tangent_space.prepared(system.dtype).rank_tolerance
    crossing = ConstraintSplit.at(system, t, state.q, tolerance)
    rank, rows = jnp.sum(crossing.inverse.rank), crossing.jacobian
    dispensable = jnp.zeros(0, bool)
    if topology.num_rows:
        free = least_multipliers(rows, rows[:, 0], system.scales, tolerance, rank).free
        dispensable = jnp.max(jnp.abs(free), axis=1, initial=0.0) > INVOLVED
    return Mobility(
        rank=rank,
        degrees_of_freedom=topology.num_speeds - rank,
        num_redundant=topology.num_rows + topology.num_immobile_rows - rank,
        distance=singularity_distance(None, rows, system.scales, tolerance, system.structure.islands),
        dispensable=jnp.concatenate([dispensable, jnp.ones(topology.num_immobile_rows, bool)]),
        topology=topology,
    )
