"""The order of elimination for loops that follow each other: fronts, as in frontal methods.

Speeds that one loop row reads, or that one inertia couples, belong together. Such sets are put in an order in which
few speeds are open at a time: seen, and in a set yet to come (a greedy order of elements, as in Sloan, Int. J. Numer.
Methods Eng. 28 (1989)). Of the speeds in this order each front adds a few, its interior, with rows, and keeps of those
before the separator, the open ones. Names and indices only.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise, product

import numpy as np
from jaxtyping import Int

PER_FRONT = 2000.0  # multiplications that take as long as what a front costs however small it is
GROWTH = 1.25  # from one size of fronts to the next that is tried
MOST_COUNTS = 64  # of open speeds that are tried


@dataclasses.dataclass(frozen=True)
class EliminationPlan:
    """Fronts in the order of elimination.

    - `interior`: speeds that each front adds. `separator`: speeds of earlier fronts that it, or a later one, reads.
    - `rows`: of the Jacobian, each in the first front that has all speeds it reads.
    - `read`: speeds that its rows and the inertias of its interior read; other speeds of the separator pass by.
    """

    interior: tuple[tuple[int, ...], ...]
    separator: tuple[tuple[int, ...], ...]
    rows: tuple[tuple[int, ...], ...]
    read: tuple[tuple[int, ...], ...]

    @property
    def work(self) -> float:
        """Multiplications of a factorisation."""
        tables = self.separator_table, self.interior_table, self.row_table
        return _work(len(self.interior), *(len(table[0]) for table in tables))

    @cached_property
    def interior_table(self) -> np.ndarray:
        """`interior`, filled up with -1."""
        return _filled(self.interior)

    @cached_property
    def separator_table(self) -> np.ndarray:
        """`separator`, filled up with -1."""
        return _filled(self.separator)

    @cached_property
    def row_table(self) -> np.ndarray:
        """`rows`, filled up with -1."""
        return _filled(self.rows)

    @property
    def most_independent(self) -> np.ndarray:
        """The largest rank of each front, (k,)."""
        return np.array([min(len(rows), len(front)) for rows, front in zip(self.rows, self.table, strict=True)])

    @cached_property
    def table(self) -> np.ndarray:
        """The speeds that each front reads: separator, then interior, (k, s + p)."""
        return np.concatenate([self.separator_table, self.interior_table], axis=1)

    @cached_property
    def read_table(self) -> np.ndarray:
        """`table`, with -1 for speeds that pass by."""
        return np.array(
            [np.where(np.isin(own, read), own, -1) for own, read in zip(self.table, self.read, strict=True)]
        )

    @cached_property
    def passed_on(self) -> np.ndarray:
        """1 where a speed of the next front's separator is one of this front's speeds, (k, s, s + p)."""
        here = self.table
        following = np.concatenate([self.separator_table[1:], np.full_like(self.separator_table[:1], -1)])
        return ((following[:, :, None] == here[:, None, :]) & (here >= 0)[:, None, :]).astype(float)


def _filled(sets):
    width = max(1, *map(len, sets))
    return np.array([[*members, *(width - len(members)) * [-1]] for members in sets], dtype=int)


def work_at_once(rows: int, speeds: int) -> int:
    """Multiplications of a factorisation without fronts."""
    return speeds * (speeds + rows) * (7 * speeds + rows)


def _work(fronts, kept, added, rows):
    """Multiplications of fronts that are all as large as the largest."""
    width = kept + added
    return fronts * (PER_FRONT + width**2 * (18 * width + 16 * rows))


def plan_elimination(
    of_rows: Sequence[Int[np.ndarray, " _"]], coupled: Sequence[Int[np.ndarray, " _"]], size: int
) -> EliminationPlan:
    """Find the fronts of loop rows and inertias that take the least work.

    **Arguments:** `of_rows`: the speeds that each row reads; `coupled`: sets of speeds that inertia couples; `size`: of
    v.
    """
    sets = _largest([frozenset(map(int, members)) for members in [*of_rows, *coupled]], size)
    order = np.array(_with_few_open(sets, size), dtype=int)
    place = np.argsort(order)
    last = place.copy()  # of the speeds that are in one set with it
    for members in map(list, sets):
        last[members] = np.maximum(last[members], place[members].max())
    open_ = np.arange(size + 1) - np.cumsum(np.bincount(last + 1, minlength=size + 1))  # before each place
    of_row = np.array([place[members].max() if len(members) else 0 for members in of_rows], dtype=int)

    def work(cuts):
        rows = np.histogram(of_row, cuts)[0] if len(cuts) > 1 else np.zeros(1)
        return _work(len(cuts) - 1, open_[cuts[:-1]].max(initial=0), np.diff(cuts).max(initial=0), rows.max(initial=0))

    sizes = {int(GROWTH**power) for power in range(1 + int(np.log(max(size, 1)) / np.log(GROWTH)))} | {size}
    counts = np.unique(open_)
    counts = counts[np.linspace(0, len(counts) - 1, min(len(counts), MOST_COUNTS), dtype=int)]
    found = [_cuts(open_, added, kept) for added, kept in product(sorted(sizes), counts)]
    cuts = min((each for each in found if each), key=work)
    fronts = list(pairwise(cuts))
    front_of = np.searchsorted(cuts, place, side="right") - 1
    read = [set[int]() for _ in fronts]
    for members in sets:
        for front in front_of[list(members)]:
            read[front] |= members
    return EliminationPlan(
        interior=tuple(tuple(sorted(order[start:end].tolist())) for start, end in fronts),
        separator=tuple(tuple(np.flatnonzero((place < start) & (last >= start)).tolist()) for start, _ in fronts),
        rows=tuple(tuple(np.flatnonzero((of_row >= start) & (of_row < end)).tolist()) for start, end in fronts),
        read=tuple(tuple(sorted(members)) for members in read),
    )


def _cuts(open_, added, kept):
    """Places between fronts of at most `added` speeds, each the last where at most `kept` are open; None without."""
    ends = np.flatnonzero(open_ == 0)  # of parts that nothing connects
    cuts = [0]
    while cuts[-1] < len(open_) - 1:
        last = min(cuts[-1] + added, ends[np.searchsorted(ends, cuts[-1], side="right")])
        able = np.flatnonzero(open_[cuts[-1] + 1 : last + 1] <= kept)
        if len(able) == 0:
            return None
        cuts.append(cuts[-1] + 1 + able[-1])
    return cuts


def _with_few_open(sets, size):
    """The speeds in the order of their sets, of which the next is always one that leaves the fewest open."""
    levels = _levels(sets, size)
    sets = sorted(sets, key=lambda members: sorted(levels[list(members)]))
    containing, waiting = [set() for _ in range(size)], dict.fromkeys(range(len(sets)))
    for index, members in enumerate(sets):
        for speed in members:
            containing[speed].add(index)
    order = {}

    def growth(index):
        new = sum(speed not in order for speed in sets[index])
        return new - sum(len(containing[speed]) == 1 for speed in sets[index]), new, index

    near = set()
    while waiting:
        index = min(near, key=growth) if near else next(iter(waiting))
        del waiting[index]
        for speed in sets[index]:
            containing[speed].discard(index)
        order |= dict.fromkeys(sorted(sets[index]))
        near = set().union(near, *(containing[speed] for speed in sets[index])) - {index}
    return list(order)


def _largest(sets, size):
    """The sets that are subsets of no other; a row that reads no speed has none."""
    containing, found = [set() for _ in range(size)], []
    for members in sorted({*sets} - {frozenset()}, key=len, reverse=True):
        if not set.intersection(*(containing[speed] for speed in members)):
            for speed in members:
                containing[speed].add(len(found))
            found.append(members)
    return found


def _levels(sets, size):
    """The number of sets between each speed and an end of its part, (n,); parts one after the other."""
    neighbours, levels, first = [set() for _ in range(size)], {}, 0
    for members in sets:
        for speed in members:
            neighbours[speed] |= members
    for start in range(size):
        if start in levels:
            continue
        # What is farthest from what is farthest lies at an end.
        end, distances = start, {}
        for _ in range(3):
            distances = _distances(neighbours, end)
            end = min(distances, key=lambda speed: (-distances[speed], speed))
        levels |= {speed: first + distance for speed, distance in distances.items()}
        first += 1 + distances[end]
    return np.array([levels[speed] for speed in range(size)], dtype=int)


def _distances(neighbours, start):
    """{speed: steps to it} of all speeds that a start leads to."""
    distances, front, distance = {}, {start}, 0
    while front:
        distances |= dict.fromkeys(front, distance)
        front = set().union(*(neighbours[speed] for speed in front)) - distances.keys()
        distance += 1
    return distances
