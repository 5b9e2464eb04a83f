"""Arrays that passes of a loop change."""

from collections.abc import Callable

import numpy as np

from scalarjit.arrays import NONE, Array, Entries, Stored, Updated, constants_of, known_of
from scalarjit.graph import Buffer, Graph, Region, Store, constant
from scalarjit.rules.rule import has_entries


class Carried:
    """Arrays that passes of a loop change, in memory; entries that no pass changes are known."""

    def __init__(self, graph: Graph, init: list[Array], stays: list[bool]) -> None:
        self.graph = graph
        self.init = init
        self.buffers = [
            None if stay else Buffer(array.dtype, array.size) for array, stay in zip(init, stays, strict=True)
        ]
        # Of numbers by themselves, such as counters, none stays that the equations do not return as it is.
        self.known = [None if array.size == 1 else constants_of(array) for array in init]

    def arrays(self) -> list[Array]:
        """The carried arrays, as they are where this is called."""
        return [
            array if buffer is None else Stored(self.graph, array.shape, buffer, known)
            for array, buffer, known in zip(self.init, self.buffers, self.known, strict=True)
        ]

    def settle(self, body: Callable[[list[Array]], list[Array]]) -> Region:
        """Walk through the body until what is known before a pass is so after it; begin the loop."""
        graph = self.graph
        while True:
            with graph.inside() as region:
                carry = self.arrays()
                found = body(carry)
                if self._is_settled(found):
                    self._write(carry, found)
                    break
        for array, buffer in zip(self.init, self.buffers, strict=True):
            if buffer is not None:
                array.write(buffer)
        return region

    def _is_settled(self, found):
        settled = True
        for number, (known, array) in enumerate(zip(self.known, found, strict=True)):
            if known is None or self.buffers[number] is None:
                continue
            after = known_of(array)
            same = np.full(known.shape, NONE) if after is None else np.where(after == known, known, NONE)
            if not np.array_equal(same, known):
                settled = False
                self.known[number] = same if np.any(same != NONE) else None
        return settled

    def _write(self, carry, found):
        """Write what a pass leaves, all of it computed before."""
        ready: list[tuple[Buffer, Array]] = []
        own = {id(buffer) for buffer in self.buffers if buffer is not None}
        for before, buffer, after in zip(carry, self.buffers, found, strict=True):
            if buffer is None or after is before:
                continue
            if isinstance(after, Stored) and after.buffer is buffer:
                continue
            if isinstance(after, Updated) and isinstance(after.base, Stored) and after.base.buffer is buffer:
                window = after.window
                window = window if isinstance(window, Entries) else window.stored()
                ready.append((buffer, Updated(after.base, after.start, window)))
                continue
            if isinstance(after, Stored) and id(after.buffer) in own:
                copied = Buffer(after.dtype, after.size)
                after.write(copied)
                after = Stored(self.graph, after.shape, copied)
            elif isinstance(after, Entries) and has_entries(after):
                after = _Changed(self.graph, after.ids, after.dtype, before)
            else:
                after = after.stored()
            ready.append((buffer, after))
        for buffer, array in ready:
            array.write(buffer, blended=True)


class _Changed(Entries):
    """Entries of which those are written that are not what is there."""

    def __init__(self, graph, ids, dtype, before) -> None:
        super().__init__(graph, ids, dtype)
        self.before = before

    def write(self, buffer: Buffer, *, blended: bool = False) -> None:
        graph = self.graph
        name = ("load", buffer)
        for place, scalar in enumerate(self.ids.ravel().tolist()):
            if scalar >= 0 and graph.names[scalar] == name and graph.operands[scalar] == (constant(place),):
                continue
            known = self.before.known
            if known is not None and known.reshape(-1)[place] == scalar:
                continue
            graph.do(Store(buffer, constant(place), scalar, blended))
