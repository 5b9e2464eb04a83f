"""A state of motion."""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from linkax.equations.coordinates import neutral
from linkax.model.mechanism import Mechanism
from linkax.model.topology import Topology
from linkax.tables import Rows, Table, batch, count, known, numbers, printed_as
from linkax.xla.arrays import Array


def _table(state: "State") -> Table:
    shape = state.q.shape[:-1]
    internal = [] if state.internal is None else [Rows((), [("internal states", numbers(state.internal, axes=1))])]
    if state.topology is None or known(state.q) is None or known(state.v) is None:
        joints = () if state.topology is None else tuple(state.topology.coordinates)
        rows = [("q", numbers(state.q, axes=1)), ("v", numbers(state.v, axes=1)), ("joints", ", ".join(joints))]
        return Table("State" + batch(shape), [Rows((), [row for row in rows if row[1]]), *internal])
    rows = joint_rows(state.topology, (state.q, False), (state.v, True))
    return Table(
        f"State of {count(len(rows), 'joint')} in the tree{batch(shape)}",
        [Rows(("joint", "coordinate", "speed"), rows, "joints"), *internal],
    )


@printed_as(_table)
class State(eqx.Module):
    """Coordinates and speeds of the joints in the spanning tree, in the tree's order.

    - `q`: coordinates [rad or m], unit quaternions among them, (n_q,). `v`: speeds [rad/s or m/s], (n_v,).
    - `topology`: the plan of the mechanism, whose joints these are of; where it is None, printing tells no names.
    - `internal`: internal states of force elements, see `linkax.AbstractForce.states`, in the order of the elements,
      (n_s,); None where there are none, or where they have their initial values.

    `linkax.assemble` makes one on the closed loops from the joints' names.
    """

    q: Float[Array, "*batch n_q"]
    v: Float[Array, "*batch n_v"]
    topology: Topology | None = eqx.field(static=True, default=None, repr=False)
    internal: Float[Array, "*batch n_s"] | None = None

    @staticmethod
    def as_drawn(mechanism: Mechanism) -> "State":
        """All joints in the tree at zero, and at rest: the state in which a mechanism of `placed` bodies is drawn.

        Nothing is solved for, so it is on the closed loops only where these are drawn closed.
        """
        topology = mechanism.topology
        return State(jnp.asarray(neutral(topology, float)), jnp.zeros(topology.num_speeds), topology)


def joint_rows(topology: Topology, *columns: tuple[Any, bool]) -> list[list[str]]:
    """Rows of the joints that have coordinates, from arrays of known numbers, and whether these are speeds."""
    rows = []
    for name, kind in zip(topology.coordinates, topology.joint_types, strict=False):
        if not kind.speed_units:
            continue
        cells = [name]
        for array, is_speed in columns:
            taken = (topology.speeds if is_speed else topology.coordinates)[name]
            units = [f"{unit}/s" if is_speed else unit for unit in kind.speed_units]
            if kind.has_quaternion and not is_speed:
                units = ["(quaternion)"] * 4 + units[3:]
            cells.append(_with_units(known(array)[..., taken], units))
        rows.append(cells)
    return rows


def _with_units(values: Any, units: Sequence[str]) -> str:
    parts, start = [], 0
    for unit, alike in groupby(units):
        stop = start + len(list(alike))
        parts.append(numbers(values[..., start:stop], unit, axes=1))
        start = stop
    return "; ".join(parts)
