"""The order of elimination for loops that follow each other: fronts, as in multifrontal methods.

Speeds that one loop row reads, or that one inertia couples, belong together. Where such sets overlap only with their
neighbours, they make a row of fronts. Each adds interior speeds and rows to what went before, and keeps of that the
separator, the speeds that later fronts still read. Names and indices only.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Int

PER_FRONT = 100.0  # products that take as long as what a front costs however small it is


@dataclasses.dataclass(frozen=True)
class EliminationPlan:
    """Fronts in the order of elimination.

    - `interior`: speeds that each front adds. `separator`: speeds of earlier fronts that it, or a later one, reads.
    - `rows`: of the Jacobian, each in the first front that has all speeds it reads.
    """

    interior: tuple[tuple[int, ...], ...]
    separator: tuple[tuple[int, ...], ...]
    rows: tuple[tuple[int, ...], ...]

    @property
    def work(self) -> float:
        """Multiplications of a factorisation, all fronts as large as the largest."""
        kept, added, rows = (len(table[0]) for table in (self.separator_table, self.interior_table, self.row_table))
        width = kept + added
        return len(self.interior) * (PER_FRONT + width**2 * (3 * width + 2 * rows) + 2 * width * (2 * width + rows))

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
    def passed_on(self) -> np.ndarray:
        """1 where a speed of the next front's separator is one of this front's speeds, (k, s, s + p)."""
        here = self.table
        following = np.concatenate([self.separator_table[1:], np.full_like(self.separator_table[:1], -1)])
        return ((following[:, :, None] == here[:, None, :]) & (here >= 0)[:, None, :]).astype(float)


def _filled(sets):
    width = max(1, *map(len, sets))
    return np.array([[*members, *(width - len(members)) * [-1]] for members in sets], dtype=int)


def plan_elimination(
    of_rows: Sequence[Int[np.ndarray, " _"]], coupled: Sequence[Int[np.ndarray, " _"]], size: int
) -> EliminationPlan:
    """Find the fronts of loop rows and inertias.

    **Arguments:** `of_rows`: the speeds that each row reads; `coupled`: sets of speeds that inertia couples; `size`: of
    v.
    """
    sets = _largest([frozenset(map(int, members)) for members in [*of_rows, *coupled]], size)
    levels = _levels(sets, size)
    sets.sort(key=lambda members: sorted(levels[list(members)]))
    last = {speed: index for index, members in enumerate(sets) for speed in members}
    fronts, seen, open_ = [], set(), set()
    for index, members in enumerate(sets):
        new = sorted(members - seen)
        if new or not fronts:
            fronts.append((new, sorted(open_), open_ | members))
        seen.update(new)
        open_ = {speed for speed in open_ | members if last[speed] > index}
    fronts = _evened(fronts)
    rows = [[] for _ in fronts]
    for row, members in enumerate(of_rows):
        rows[next(i for i, (*_, within) in enumerate(fronts) if within.issuperset(members))].append(row)
    return EliminationPlan(*(tuple(map(tuple, parts)) for parts in (*list(zip(*fronts, strict=True))[:2], rows)))


def _evened(fronts):
    """Split fronts that add more speeds than usual in two, where the separator does not grow for that.

    All fronts take as long as the largest.
    """
    usual = int(np.median([len(new) for new, *_ in fronts]))
    most = max(len(kept) for _, kept, _ in fronts)
    found = []
    for new, kept, within in fronts:
        early = new[: max(len(new) - usual, 0)]
        if early and len(kept) + len(early) <= most:
            before = sorted({*kept, *early})
            found += [(early, kept, set(before)), (new[len(early) :], before, within)]
        else:
            found.append((new, kept, within))
    return found


def _largest(sets, size):
    """The sets that are subsets of no other."""
    containing, found = [set() for _ in range(size)], []
    for members in sorted(set(sets), key=len, reverse=True):
        if not members or not set.intersection(*(containing[speed] for speed in members)):
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
