"""Count the degrees of freedom of a mechanism at a state, and name its redundant constraints."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from linkax.equations.system import system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.least_multipliers import least_multipliers
from linkax.linalg.saddle_inverse import singularity_distance
from linkax.model.immobile_rows import is_planar
from linkax.model.mechanism import Mechanism
from linkax.model.names import ByName
from linkax.model.numbers import require_type
from linkax.model.topology import Topology
from linkax.simulation.integrate.accuracy import BALANCED, Accuracy
from linkax.simulation.integrate.options import check_accuracy
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, checked_formulation
from linkax.simulation.start.initial_state import ON_BRANCH
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.tables import Rows, Table, batch, count, known, numbers, printed_as
from linkax.xla.arrays import Array
from scalarjit import scalarised

INVOLVED = 1e-6  # entry of a self-stress of magnitude one up to which its row counts as not part of it
# Table 1 of the paper: which axes of parent and child each rotation row keeps orthogonal.
ROTATIONS = {(1, 2): "α₁", (2, 1): "α₁", (0, 2): "α₂", (0, 1): "α₃"}
TRANSLATIONS = ("s₁", "s₂", "s₃")


def _table(found: "Mobility") -> Table:
    topology, equations = found.topology, found.joint_equations
    known_ones = known(found.dispensable) is not None
    redundant = {name: ", ".join(rows) for name, rows in found.redundant.items()} if known_ones else {}
    total = topology.num_rows + topology.num_immobile_rows
    freedoms = numbers(found.degrees_of_freedom)
    title = f"Mobility: {freedoms} degree{'' if freedoms == '1' else 's'} of freedom"
    counts = [f"{found.spatial_count} in space"]
    counts += [] if found.planar_count is None else [f"{found.planar_count} in the plane"]
    crossing = known(found.distance) is not None and np.all(np.asarray(found.distance) == 0.0)
    far = "branches cross in it; fewer freedoms go on along each" if crossing else "1 is far"
    facts = [
        ("Grübler–Kutzbach", ", ".join(counts)),
        ("joint equations", f"{sum(equations.values())} on {count(topology.num_bodies, 'body')}"),
        ("loop equations", f"{total}, of rank {numbers(found.rank)}"),
        ("redundant", numbers(found.num_redundant)),
        ("distance", f"{numbers(found.distance)} from a singular configuration ({far})"),
    ]
    names = [*redundant, *(name for name in equations if name not in redundant)]
    rows = [(name, str(equations[name]), redundant.get(name, "")) for name in names]
    head = ("joint", "equations", "of which one may be left out")
    return Table(title + batch(found.rank.shape), [Rows((), facts), Rows(head, rows, "joints")])


@printed_as(_table)
class Mobility(eqx.Module):
    """How a mechanism can move at a state.

    - `rank`: number of independent constraint rows.
    - `degrees_of_freedom`: n_v − rank; each row that a singular configuration makes dependent adds one.
    - `num_redundant`: number of rows that depend on others, including rows that no motion changes.
    - `distance`: from the nearest singular configuration, see `linkax.Accuracy`; zero in one, where branches cross, and
      motions can take only some of the degrees of freedom. NaN where a number that JAX traces is not one that it can
      be.
    - `is_planar`: whether all joints turn about one direction, and slide across it.
    - `dispensable`: whether each constraint row, in the order of `rows`, could be left out without freeing a motion,
      (m,).
    """

    rank: Int[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    num_redundant: Int[Array, ""]
    distance: Float[Array, ""]
    dispensable: Bool[Array, " m"]
    topology: Topology = eqx.field(static=True, repr=False)
    is_planar: bool = eqx.field(static=True, default=False)

    @property
    def joint_equations(self) -> dict[str, int]:
        """{joint or constraint: how many of the six freedoms between two bodies it takes}; of beams none."""
        return joint_equations(self.topology)

    @property
    def spatial_count(self) -> int:
        """Degrees of freedom by the Grübler–Kutzbach criterion in space: 6 for each body, less all joint equations.

        It is `degrees_of_freedom` − `num_redundant`; of beams it counts the strains in place of bodies.
        """
        topology = self.topology
        return topology.num_speeds - topology.num_rows - topology.num_immobile_rows

    @property
    def planar_count(self) -> int | None:
        """The same in the plane, 3 for each body, less joint equations in it; None for a mechanism that is not planar.

        Planar is one whose joints all turn about one direction, and slide across it.
        """
        if not self.is_planar:
            return None
        planar = [name for name in self.joint_equations if name in _locking(self.topology)]
        return self.spatial_count - 3 * self.topology.num_bodies + 3 * len(planar)

    @property
    def rows(self) -> tuple[tuple[str, str], ...]:
        """(joint or constraint, name in Table 1 of the paper) of each row."""
        return row_names(self.topology)

    @property
    def redundant(self) -> dict[str, tuple[str, ...]]:
        """{cut joint or constraint: its rows that could be left out, one at a time}; of a batch, in any member."""
        redundant = {}
        of_members = np.atleast_2d(np.asarray(self.dispensable))
        of_any = np.any(of_members, axis=tuple(range(of_members.ndim - 1))).tolist()
        for (name, row), dispensable in zip(self.rows, of_any, strict=True):
            if dispensable:
                redundant[name] = (*redundant.get(name, ()), row)
        return redundant


def joint_equations(topology: Topology) -> dict[str, int]:
    """How many equations each joint and constraint has; of joints that are parts of beams none."""
    found = {}
    for name, kind in zip(topology.joints, topology.joint_types, strict=True):
        if isinstance(kind, type):
            plain = len(kind.locked_rotations) + len(kind.locked_translations)
            found[name] = plain + bool(kind.combined_rotations or kind.combined_translations)
    return ByName(found | dict(zip(topology.constraints, topology.constraint_rows, strict=True)), "joint or constraint")


def _locking(topology: Topology) -> list[str]:
    """Joints of a planar mechanism that keep a body in the plane: all but rods between points."""
    kinds = zip(topology.joints, topology.joint_types, strict=True)
    return [name for name, kind in kinds if isinstance(kind, type) and kind.locked_rotations]


def row_names(topology: Topology) -> tuple[tuple[str, str], ...]:
    """(joint or constraint, name in Table 1 of the paper) of each row; rows that no motion changes come last."""
    cuts = topology.joints[topology.num_bodies :]
    rotation = lambda rows: [(cuts[cut], ROTATIONS[i, j]) for cut, i, j in rows]
    translation = lambda rows: [(cuts[cut], TRANSLATIONS[i]) for cut, i in rows]
    slips = topology.slips[topology.num_rows - topology.num_constraint_rows :]
    holds = lambda row: (topology.constraints[topology.constraint_of_row[row]], "slip" if slips[row] else "coordinates")
    return (
        *rotation(topology.rotation_rows),
        *translation(topology.translation_rows),
        *((cuts[cut], "combined") for cut in topology.combining),
        *map(holds, range(topology.num_constraint_rows)),
        *rotation(topology.immobile_rotation_rows),
        *translation(topology.immobile_translation_rows),
    )


def mobility(
    mechanism: Mechanism,
    state: State,
    *,
    t: ArrayLike = 0.0,
    formulation: TangentSpace = DEFAULT_FORMULATION,
    accuracy: Accuracy = BALANCED,
) -> Mobility:
    """Find the rank, the degrees of freedom and the redundant constraints at a state on the closed loops.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`. `t`: time [s].
    - `formulation`: a `linkax.TangentSpace`, whose rank tolerance decides which rows are independent.
    - `accuracy`: deprecated.

    **Returns:** a `Mobility`.

    **Raises:** `ValueError` for a state that does not fit the mechanism, and for another formulation.
    """
    check_accuracy(accuracy)
    chosen = checked_formulation(formulation, accuracy)
    tangent_space = require_type(chosen, TangentSpace, "formulation", "give linkax.TangentSpace(...)")
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    return marked(mechanism, _mobility(mechanism, state, t, tangent_space))


@scalarised
def _mobility(mechanism, state, t, tangent_space):
    system, topology = system_of(mechanism, state.q.dtype, fixed_scales=False), mechanism.topology
    tolerance = tangent_space.prepared(system.dtype).tolerance
    split = ConstraintSplit.at(system, t, state.q, tolerance)
    rank, rows = jnp.sum(split.inverse.rank), split.jacobian
    distance = singularity_distance(None, rows, system.scales, tolerance, system.structure.islands)
    if topology.num_rows:
        distance = jnp.where(split.is_crossing(ON_BRANCH * tolerance), 0.0, distance)
    dispensable = jnp.zeros(0, bool)
    if topology.num_rows:
        free = least_multipliers(rows, rows[:, 0], system.scales, tolerance, rank).free
        dispensable = jnp.max(jnp.abs(free), axis=1, initial=0.0) > INVOLVED
    return Mobility(
        rank=rank,
        degrees_of_freedom=topology.num_speeds - rank,
        num_redundant=topology.num_rows + topology.num_immobile_rows - rank,
        distance=distance,
        dispensable=jnp.concatenate([dispensable, jnp.ones(topology.num_immobile_rows, bool)]),
        topology=topology,
        is_planar=is_planar(mechanism),
    )
