"""What of a function is computed, and how it is cut into pieces, which are functions of LLVM: long code, heavy loops.

At level 0, LLVM gives each value a place of its own on the stack: the largest function of a bicycle's derivative, for
eight members, took 6 MB of the 8 that a thread of XLA has. Pieces take the same places, one after another. What one
computes and others need lies in memory.
"""

from dataclasses import dataclass, field
from typing import Any

from scalarjit.function import Function
from scalarjit.graph import For, If, Region, Store, While

# Members times operations in the text of a region, from which it is cut into pieces of so many: 0.1 MB of a stack. With
# a quarter of that, the derivative of a bicycle takes 5 s more to compile, of 49; with four times as much, 4 s less.
LONG = 16_000
HEAVY = 512  # times of its text that a loop does, from which it is compiled with more care at once


@dataclass
class Pieces:
    """How a function is cut.

    - `groups`: by regions that are cut, numbers of their pieces and items of each.
    - `heavy`: by loops that are pieces, their numbers.
    - `home`: by scalar, the number of the piece that computes it; 0 is the function itself.
    - `crossing`: scalars that other pieces need, too.
    """

    groups: dict[Region, list[tuple[int, list[Any]]]] = field(default_factory=dict)
    heavy: dict[For, int] = field(default_factory=dict)
    home: dict[int, int] = field(default_factory=dict)
    crossing: set[int] = field(default_factory=set)


def used_scalars(function: Function) -> set[int]:
    """The scalars that results, memory, loops and branches need."""
    graph = function.graph
    used: set[int] = set()
    loops: dict[int, tuple[int, int]] = {}
    waiting: list[int] = []

    def roots(region: Region) -> None:
        for item in region.items:
            if isinstance(item, Store):
                waiting.extend((item.offset, item.value))
            elif isinstance(item, For):
                waiting.append(item.index)
                for scalar, first, then in item.carried:
                    loops[scalar] = first, then
                roots(item.region)
            elif isinstance(item, While):
                waiting.append(item.goes_on)
                roots(item.test)
                roots(item.region)
            elif isinstance(item, If):
                waiting.append(item.condition)
                roots(item.region)

    roots(graph.root)
    while waiting:
        scalar = waiting.pop()
        if scalar < 0 or scalar in used:
            continue
        used.add(scalar)
        waiting.extend(graph.operands[scalar])
        waiting.extend(loops.get(scalar, ()))
    return used


def pieces(function: Function, used: set[int], lanes: int) -> Pieces:
    """Cut a function, of whose scalars some are used."""
    cut = _Cut(function, used, LONG // lanes)
    cut.region(function.graph.root, 0)
    return cut.found


class _Cut:
    def __init__(self, function: Function, used: set[int], most: int) -> None:
        self.graph = function.graph
        self.used = used
        self.most = most
        self.found = Pieces()
        self.count = 0
        self.weights: dict[Region, tuple[int, int]] = {}

    def new_piece(self) -> int:
        self.count += 1
        return self.count

    def weight(self, region: Region) -> tuple[int, int]:
        """Operations in the text of a region, and those that it does, where each condition holds once."""
        found = self.weights.get(region)
        if found is None:
            parts = [self.weight_of(item) for item in region.items]
            found = self.weights[region] = sum(length for length, _ in parts), sum(work for _, work in parts)
        return found

    def weight_of(self, item: Any) -> tuple[int, int]:
        if isinstance(item, int):
            return (1, 1) if item in self.used else (0, 0)
        if isinstance(item, For):
            length, work = self.weight(item.region)
            return length, item.count * work
        if isinstance(item, While):
            length, work = self.weight(item.test)
            more_length, more_work = self.weight(item.region)
            return length + more_length, work + more_work
        return self.weight(item.region) if isinstance(item, If) else (1, 1)

    def region(self, region: Region, piece: int, *, is_whole: bool = False) -> None:
        """Tell what a region that stands in a piece computes. `is_whole`: it is not cut."""
        if is_whole or self.weight(region)[0] <= self.most:
            for item in region.items:
                self.item(item, piece, is_whole)
            return
        groups: list[list[Any]] = [[]]
        length = 0
        for item in region.items:
            own = self.weight_of(item)[0]
            if length + own > self.most and groups[-1]:
                groups.append([])
                length = 0
            groups[-1].append(item)
            length += own
        numbered = self.found.groups[region] = [(self.new_piece(), group) for group in groups]
        for number, group in numbered:
            for item in group:
                self.item(item, number, False)

    def item(self, item: Any, piece: int, is_whole: bool) -> None:
        home = self.found.home
        if isinstance(item, int):
            if item in self.used and self.graph.names[item] not in ("index", "carried"):
                home[item] = piece
                self.needs(piece, *self.graph.operands[item])
        elif isinstance(item, Store):
            self.needs(piece, item.offset, item.value)
        elif isinstance(item, For):
            length, work = self.weight_of(item)
            if not is_whole and work >= HEAVY * length:
                piece = self.found.heavy[item] = self.new_piece()
                is_whole = True
            home[item.index] = piece
            carried = [each for each in item.carried if each[0] in self.used]
            for scalar, first, _ in carried:
                home[scalar] = piece
                self.needs(piece, first)
            self.region(item.region, piece, is_whole=is_whole)
            self.needs(piece, *(then for _, _, then in carried))
        elif isinstance(item, While):
            self.region(item.test, piece, is_whole=is_whole)
            self.needs(piece, item.goes_on)
            self.region(item.region, piece, is_whole=is_whole)
        elif isinstance(item, If):
            self.needs(piece, item.condition)
            self.region(item.region, piece, is_whole=is_whole)

    def needs(self, piece: int, *scalars: int) -> None:
        home = self.found.home
        self.found.crossing.update(scalar for scalar in scalars if scalar >= 0 and home.get(scalar) != piece)
