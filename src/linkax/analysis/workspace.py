"""Where a mechanism can go: all positions of a grid that a branch leads to."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from linkax.analysis.continuation import Asked, Before, Piece, Way
from linkax.analysis.course import followed_drives, own_values, values_along, wraps
from linkax.analysis.trace import TraceError, start_of
from linkax.equations.configuration import configure
from linkax.equations.system import system_of
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, real, require_type
from linkax.simulation.integrate.accuracy import BALANCED
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, Run
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.start.places import Places
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_time
from linkax.tables import Rows, Table, numbers, printed_as
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, is_first
from linkax.xla.waiting import Progress, compiling
from scalarjit import scalarised, with_known_entries

TOGETHER = 256  # positions that are computed at once
Grid = Mapping[Any, ArrayLike | Sequence[ArrayLike | Sequence[float]]]


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
    internal: None = None  # of which positions say nothing

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
    if not all_concrete((mechanism, start, along, t)):
        raise ValueError("workspace of numbers that JAX traces; which positions are reached must be known: leave jit")
    start, t = start_of(mechanism, start), jnp.asarray(checked_time(t, "t"))
    axes, rows = _axes(mechanism, along)
    measured, held, values = values_along(mechanism, rows)
    given = with_known_entries(measured), start, held, values, t
    shape, values = tuple(len(entries) for _, entries in axes), np.asarray(values)
    way = given[0], held, t
    with Progress(len(values), "position", progress) as line:
        with compiling(is_first(workspace, jax.tree.structure(given))):
            own, came = _begin(*way, start, values[0])
            apart = values - own
            apart = np.where(wraps(held), np.remainder(apart + np.pi, 2.0 * np.pi) - np.pi, apart)
            first = int(np.argmin(np.sum((apart / _spacing(values)) ** 2, axis=1)))
            search = _Search(way, np.concatenate([values, (values - apart)[first, None]]), start.q, came)
            search.step([(len(values), first)])
        if not search.found[first]:
            raise TraceError(
                "the branch does not lead from the start to the nearest position of the grid, "
                f"{numbers(values[first], axes=1)}; give a grid around the start, or a start on its branch"
            )
        waiting = [(first, beside) for beside in _beside(first, shape)]
        while waiting:
            chosen = {end: begin for begin, end in reversed(waiting) if not search.found[end]}
            new = search.step([(begin, end) for end, begin in chosen.items()])
            tried = {(begin, end) for end, begin in chosen.items()}
            waiting = [pair for pair in waiting if pair not in tried and not search.found[pair[1]]]
            waiting += [(place, beside) for place in new for beside in _beside(place, shape)]
            line.tell("searching", int(np.sum(search.found)))
    found = search.found[:-1]
    mark = lambda array: np.where(found.reshape(-1, *(1,) * (array.ndim - 1)), array, np.inf)
    return Workspace(
        run=Run.of_state(mechanism, start, t, DEFAULT_FORMULATION, BALANCED),
        ts=mark(np.arange(float(len(values)))),
        q=mark(search.q[:-1]),
        v=np.full((len(values), len(start.v)), np.nan),
        distance=mark(search.distances()[:-1]),
        axes=axes,
        reached=found.reshape(shape),
    )


class _Search:
    """Which positions are found, where the joints are there, and how the ways came there.

    `way`: the mechanism, what is held, and time; `values`: of all positions, (N + 1, k). The last one is the start.
    """

    def __init__(self, way: tuple[Any, ...], values: Float[np.ndarray, "n k"], q: Any, came: Before) -> None:
        self.way, self.values = way, values
        self.found = np.arange(len(values)) == len(values) - 1
        self.q, *self.came = (np.repeat(np.asarray(array)[None], len(values), axis=0) for array in (q, *came))

    def step(self, pairs: list[tuple[int, int]]) -> list[int]:
        """Go from positions to those beside them, and return those found."""
        if not pairs:
            return []
        begins, ends = np.array(pairs).T
        given = self.q[begins], self.values[begins], self.values[ends], *(array[begins] for array in self.came)
        q, *came, reached = _together(lambda *rows: _step(*self.way, *rows), *given)
        new = ends[reached]
        self.found[new] = True
        for array, rows in zip((self.q, *self.came), (q, *came), strict=True):
            array[new] = rows[reached]
        return new.tolist()

    def distances(self) -> Float[np.ndarray, " n"]:
        """Of the positions found from singular configurations; zero for others."""
        rows = self.q[self.found], self.values[self.found], *(array[self.found] for array in self.came)
        distance = np.zeros(len(self.found))
        distance[self.found] = np.concatenate([*_in_parts(lambda *rows: _distance(*self.way, *rows), *rows)])
        return distance


def _axes(mechanism, along):
    """Names and values of the axes, and values of all positions for `values_along`.

    **Raises:** `ValueError` for values that are no rows of numbers.
    """
    require_type(along, Mapping, "along", "give {joint: values} or {'body.frame': (x, y, z)}")
    axes, whose = [], []
    for key, entry in along.items():
        is_place = isinstance(key, str) and key not in mechanism.topology.joints
        if is_place:
            Places(mechanism).positions({key: np.zeros(3)}, "along")  # which tells of an unknown name
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


def _way(flat, held, t):
    system = system_of(flat, np.float64)
    return Way(system, t, held, followed_drives(held, system.constraints))


@scalarised
def _begin(flat, held, t, start, near):
    """Values of what is held at the start, near to others, and how the ways begin there."""
    way = _way(flat, held, t)
    own = own_values(held.filled(near), configure(way.system, t, start.q))
    return own, way.start(start, own)


@scalarised
def _step(flat, held, t, q, begin, end, *came):
    """Coordinates at values `end` from those at `begin`, how the way came there, and whether it did, of many pairs."""
    way = _way(flat, held, t)

    def step(q, begin, end, *came):
        there, came, reached = way.through(q, Before(*came), Piece.straight(begin, end), jnp.ones((), bool))
        return there, *came, reached

    return jax.vmap(scalarised(step))(q, begin, end, *came)


@scalarised
def _distance(flat, held, t, q, values, *came):
    way = _way(flat, held, t)

    def of(q, values, *came):
        still = jnp.zeros_like(values)
        return way.place(q, Asked(values, still, still), Before(*came)).distance

    return jax.vmap(scalarised(of))(q, values, *came)
