"""What of a function is computed at all, and how heavy its loops are."""

from scalarjit.function import Function
from scalarjit.graph import For, If, Region, Store, While

HEAVY = 512  # times of its text that a loop does, from which it is compiled with more care at once


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


def is_heavy(loop: For, used: set[int]) -> bool:
    """Whether a loop does many times what its text says."""
    length, work = _weight(loop.region, used)
    return loop.count * work >= HEAVY * length


def _weight(region, used):
    """Operations in the text of a region, and those that it does: each branch is taken, each condition holds once."""
    length = 0
    work = 0
    for item in region.items:
        if isinstance(item, int):
            parts = [(1, 1)] if item in used else []
        elif isinstance(item, For):
            inner_length, inner_work = _weight(item.region, used)
            parts = [(inner_length, item.count * inner_work)]
        elif isinstance(item, While):
            parts = [_weight(item.test, used), _weight(item.region, used)]
        elif isinstance(item, If):
            parts = [_weight(item.region, used)]
        else:
            parts = [(1, 1)]
        for part_length, part_work in parts:
            length += part_length
            work += part_work
    return length, work
