"""Where a mechanism can go: all positions of a grid that a branch leads to."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from linkax.analysis.continuation import Asked, Piece, Rates, Way
from linkax.analysis.course import followed_drives, own_values, values_along
from linkax.analysis.trace import TraceError
from linkax.equations.configuration import configure
from linkax.equations.system import system_of
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, real, require_type
from linkax.simulation.integrate.accuracy import BALANCED
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, Run
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time
from linkax.straight_line.known import flat_with_known
from linkax.tables import Rows, Table, numbers, printed_as
from linkax.xla.arrays import Array
from linkax.xla.program import Program
from linkax.xla.tracing import all_concrete, is_first
from linkax.xla.waiting import Progress, compiling

TOGETHER = 256  # positions that are computed at once
Grid = Mapping[Any, ArrayLike | tuple[ArrayLike, ArrayLike, ArrayLike]]


def _table(found: "Workspace") -> Table:
    title = f"Workspace of {int(np.sum(found.reached))} of {found.reached.size} positions"
    rows = [(str(name), numbers(values), str(len(values))) for name, values in found.axes]
    return Table(title, [Rows(("axis", "range", "values"), rows), Rows((), [("distance", numbers(found.distance))])])


@printed_as(_table)
class Workspace(Kinematics):
    """Positions of a mechanism on a grid of N.

    - `axes`: name and values of each axis of the grid, in its order. `reached`: which positions are, as the grid.
    - `ts`: numbers of the positions, (N,); those that are not reached hold infinity. `q`: coordinates of the tree's
      joints, (N, n_q). `v`: not a number: nothing moves.
    - `distance`: |R_rr| / |R₁₁| of the loops' rows and of what is held, (N,): small near the edge, and where branches
      cross.

    Readings have positions as the first axis; `grid(space.position("tool", "tip"))` has the axes of the grid.
    """

    by_time = ("ts", "q", "v", "distance")

    run: Run
    ts: Float[Array, " n_t"]
    q: Float[Array, "n_t n_q"]
    v: Float[Array, "n_t n_v"]
    distance: Float[Array, " n_t"]
    axes: tuple[tuple[str, Float[np.ndarray, " _"]], ...]
    reached: Bool[np.ndarray, "..."]
    rank_nearby: Int[Array, "*batch k"] | None = None

    def grid(self, reading: ArrayLike) -> np.ndarray:
        """What was read for all positions, (N, ...), with the axes of the grid in place of the first."""
        array = np.asarray(reading)
        return array.reshape(*self.reached.shape, *array.shape[1:])


def workspace(
    mechanism: Mechanism, start: State, along: Grid, *, t: Number = 0.0, progress: bool | None = None
) -> Workspace:
    """Find the positions of a grid that a mechanism can reach from a start without leaving its branch.

    ```python
    x, y = np.linspace(-0.5, 0.5, 51), np.linspace(0.1, 1.0, 46)
    reach = lx.workspace(five_bar, start, {"tool.tip": (x, y, [0.0])})  # inverse kinematics of each point
    reach = lx.workspace(five_bar, start, {"left": angles, "right": angles})  # of each pair of motor angles
    ```

    Each position is reached from a neighbour by continuation, see `linkax.trace`, and so on until no more are. A
    position that can be reached on several ways, on branches that a singular configuration parts, is that of the
    shortest one.

    **Arguments:**

    - `start`: a state on the closed loops; the search begins at the position of the grid that is nearest to it.
    - `along`: axes of the grid: {joint: values}, or for one of several coordinates {(joint, index): values}; and
      {"body.frame": (x, y, z)} or {body: (x, y, z)} for values of each coordinate of a point [m].
    - `t`: time [s], for drives of other joints.
    - `progress`: whether to show a progress bar; by default where the output is a terminal.

    **Returns:** a `Workspace`.

    **Raises:** `TraceError` where the branch does not lead from the start to the nearest position; `ValueError` for bad
    arguments, and where numbers are traced.
    """
    start, t = checked_state(mechanism, start), jnp.asarray(checked_time(t, "t"))
    axes, rows = _axes(mechanism, along)
    measured, held, values = values_along(mechanism, rows)
    given = flat_with_known(measured), start, held, values, t
    if not all_concrete(given):
        raise ValueError("workspace of numbers that JAX traces; which positions are reached must be known: leave jit")
    shape, values = tuple(len(entries) for _, entries in axes), np.asarray(values)
    q, found, spacing = np.zeros((len(values), len(start.q))), np.zeros(len(values), bool), _spacing(values)
    with Progress(len(values), "position", progress) as line:
        with compiling(is_first(workspace, jax.tree.structure(given))):
            own = np.asarray(_own(given[0], start, held.filled(jnp.asarray(values[0])), t))
            nearest = int(np.argmin(np.sum(((values - own) / spacing) ** 2, axis=1)))
            step = lambda q, begin, end: _step(given[0], held, t, q, begin, end)
            (q[nearest],), (reached,) = _together(step, np.asarray(start.q)[None], own[None], values[nearest][None])
        if not reached:
            raise TraceError(
                f"the branch does not lead from the start to the nearest position of the grid, "
                f"{numbers(values[nearest], axes=1)}; give a grid around the start, or a start on its branch"
            )
        found[nearest], frontier = True, [(nearest, beside) for beside in _beside(nearest, shape)]
        while frontier:
            begin, end = (np.array(part) for part in zip(*frontier, strict=True))
            there, reached = _together(step, q[begin], values[begin], values[end])
            new = []
            for to, place, is_there in zip(end.tolist(), there, reached, strict=True):
                if is_there and not found[to]:
                    q[to], found[to] = place, True
                    new.append(to)
            frontier = [(place, beside) for place in new for beside in _beside(place, shape) if not found[beside]]
            line.tell("searching", int(np.sum(found)))
    distance = np.concatenate([*_in_parts(lambda *at: _distance(given[0], held, t, *at), q, values)])
    mark = lambda array: np.where(found.reshape(-1, *(1,) * (array.ndim - 1)), array, np.inf)
    run = Run.of_state(mechanism, start, t, DEFAULT_FORMULATION, BALANCED)
    return Workspace(
        run=run,
        ts=mark(np.arange(float(len(q)))),
        q=mark(q),
        v=np.full((len(q), len(start.v)), np.nan),
        distance=mark(distance),
        axes=axes,
        reached=found.reshape(shape),
    )


def _axes(mechanism, along):
    """Names and values of the axes, and values of all positions for `values_along`.

    **Raises:** `ValueError` for values that are no rows of numbers.
    """
    require_type(along, Mapping, "along", "give {joint: values} or {'body.frame': (x, y, z)}")
    axes, whose = [], []
    for key, entry in along.items():
        is_place = isinstance(key, str) and key not in mechanism.topology.joints
        if is_place and not (isinstance(entry, tuple | list) and len(entry) == 3):
            raise ValueError(f"along: values of {key!r} are {entry!r}; give those of each axis, (x, y, [0.0])")
        names = [f"{key} {name}" for name in "xyz"] if is_place else [str(key)]
        for name, values in zip(names, entry if is_place else [entry], strict=True):
            row = np.atleast_1d(np.asarray(real(values, f"along: values of {name}")))
            if row.ndim != 1 or not len(row):
                raise ValueError(f"along: values of {name} have shape {row.shape}; give a row of numbers")
            axes.append((name, row))
            whose.append(key)
    columns = [array.ravel() for array in np.meshgrid(*(values for _, values in axes), indexing="ij")]
    rows = {key: [column for column, owner in zip(columns, whose, strict=True) if owner == key] for key in along}
    return tuple(axes), {key: parts[0] if len(parts) == 1 else np.stack(parts, axis=1) for key, parts in rows.items()}


def _spacing(values):
    """The range of each value, or one where it has none."""
    width = np.ptp(values, axis=0)
    return np.where(width > 0.0, width, 1.0)


def _beside(place: int, shape: tuple[int, ...]) -> Iterator[int]:
    """Numbers of the positions next to one."""
    index = np.unravel_index(place, shape)
    for axis, aside in itertools.product(range(len(shape)), (-1, 1)):
        other = [*map(int, index)]
        other[axis] += aside
        if 0 <= other[axis] < shape[axis]:
            yield int(np.ravel_multi_index(other, shape))


def _together(step, *rows):
    """Take many steps at once, always as many."""
    parts = [*_in_parts(step, *rows)]
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))


def _in_parts(function, *rows):
    """Yield a function of rows, of a number that compiles once."""
    for start in range(0, len(rows[0]), TOGETHER):
        parts = [row[start : start + TOGETHER] for row in rows]
        count = len(parts[0])
        filled = (np.concatenate([part, np.repeat(part[:1], TOGETHER - count, axis=0)]) for part in parts)
        yield jax.tree.map(lambda array, count=count: np.asarray(array)[:count], function(*filled))


@Program
def _own(flat, start, near, t):
    return own_values(near, configure(system_of(flat, start.q.dtype), t, start.q))


@Program
def _step(flat, held, t, q, begin, end):
    """Coordinates at values `end` from those at `begin`, and whether these are reached, of many pairs."""
    system = system_of(flat, q.dtype)
    way = Way(system, t, held, followed_drives(held, system.constraints))

    def step(q, begin, end):
        rest = jnp.zeros(system.topology.num_speeds, q.dtype)
        there, _, reached = way.through(q, Rates(rest, rest), Piece.straight(begin, end), jnp.ones((), bool))
        return there, reached

    return jax.vmap(step)(q, begin, end)


@Program
def _distance(flat, held, t, q, values):
    system = system_of(flat, q.dtype)
    way = Way(system, t, held, followed_drives(held, system.constraints))

    def of(q, values):
        rest = jnp.zeros(system.topology.num_speeds, q.dtype)
        still = jnp.zeros_like(values)
        return way.place(q, Asked(values, still, still), Rates(rest, rest)).distance

    return jax.vmap(of)(q, values)
