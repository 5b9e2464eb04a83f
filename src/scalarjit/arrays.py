"""Arrays of scalars: entry by entry, in memory, or told by what their entries are."""

import math
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from scalarjit.graph import INDEX, Buffer, Copy, Graph, Index, Region, Store, as_scalar, constant, number_of, value_of

Number = int | np.ndarray | Index  # a place along an axis, or those of many entries
LINE = 9  # entries of the innermost axes, such as those of a rotation, up to which loops over memory are unrolled
# Entries of an array up to which it is looked at which of them are constants, and how many differ. First results of a
# row of 40 four-bars take 19 s with these, 28 s with 8192, and runs as long.
MANY = 2000
# Entries up to which an array that repeats itself is written one by one: a row of 20 four-bars runs in 8.7 ms, and in
# 10.1 with 64 of them.
REPEATED = 400
FEW = 8  # constants among the entries of an array that are written one by one

NONE = np.int64(2**62)  # in place of a scalar that is not known

_places = np.zeros(0, np.int64)


def _places_up_to(count):
    """Scalars of 0, ..., count − 1."""
    global _places
    if len(_places) < count:
        _places = np.array([constant(place) for place in range(2 * count)], np.int64)
    return _places


def are_known(index: tuple[Number, ...]) -> bool:
    """Whether places are known before the program runs."""
    return not any(isinstance(number, Index) for number in index)


def ravelled(index: tuple[Number, ...], shape: tuple[int, ...]) -> Number:
    """The place of an entry in memory, row by row."""
    place: Number = 0
    for number, size in zip(index, shape, strict=True):
        place = place * size + number
    return place


def unravelled(place: Number, shape: tuple[int, ...]) -> tuple[Number, ...]:
    """The index of an entry by its place in memory; what is left is that of the first axis, as division takes long."""
    index: list[Number] = []
    for axis, size in reversed(list(enumerate(shape))):
        if size == 1:
            index.append(place * 0)
        elif math.prod(shape[:axis]) == 1:
            index.append(place)
        else:
            rest = place // size
            index.append(place - rest * size)
            place = rest
    return tuple(reversed(index))


def nested(
    graph: Graph, shape: tuple[int, ...], carried: Sequence[int], body: Callable[..., Sequence[int]]
) -> Sequence[int]:
    """Loops over the indices of all entries, row by row: body(index, *carried) -> what is carried on."""
    if not shape:
        return body((), *carried)

    def one(scalar, *carried):
        number = number_of(graph, scalar)
        return nested(graph, shape[1:], carried, lambda index, *carried: body((number, *index), *carried))

    return graph.loop(shape[0], carried, one)


def by_entry(element: Callable[[tuple[Number, ...]], int]) -> Callable[[tuple[Number, ...]], Any]:
    """Ask for entries one by one, of a function that takes no arrays of indices."""

    def at(index):
        if not any(isinstance(number, np.ndarray) for number in index):
            return element(index)
        parts = np.broadcast_arrays(*index)
        found = [element(each) for each in zip(*(part.ravel().tolist() for part in parts), strict=True)]
        return np.array(found, np.int64).reshape(parts[0].shape)

    return at


def numbers_of(graph: Graph, scalars: Any) -> Any:
    """The places that scalars are: integers where all are constants, an index of one that is not, else None."""
    if isinstance(scalars, np.ndarray) and scalars.shape:
        if np.any(scalars >= 0):
            return None
        different, places = np.unique(scalars, return_inverse=True)
        return np.array([int(value_of(scalar)) for scalar in different.tolist()], int)[places].reshape(scalars.shape)
    return number_of(graph, graph.op(("convert", INDEX), int(scalars)))


def every(shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """The indices of all entries."""
    return tuple(np.indices(shape)) if shape else ()


def chosen(graph: Graph, condition: Any, yes: Any, no: Any) -> Any:
    """One of two places, or arrays of them."""
    if isinstance(condition, Index):
        return number_of(graph, graph.op("select", condition.scalar, as_scalar(yes), as_scalar(no)))
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes, no)
    return yes if condition else no


def chosen_scalars(graph: Graph, condition: Any, yes: Any, no: Any) -> Any:
    """One of two scalars, or arrays of them. What is not chosen is not computed, where that is known."""
    if isinstance(condition, Index):
        return graph.map("select", condition.scalar, yes(), no())
    if isinstance(condition, np.ndarray):
        return np.where(condition, yes(), no())
    return yes() if condition else no()


class Array:
    """An array of scalars of a graph.

    - `home`: the region that it was made in. What is written to memory of it is written there, once, however deep in
      loops it is asked for.
    """

    is_steady = True  # whether to ask for an entry often costs no more than to ask for it once

    def __init__(self, graph: Graph, shape: tuple[int, ...], dtype: np.dtype) -> None:
        self.graph = graph
        self.shape = tuple(shape)
        self.dtype = np.dtype(dtype)
        self.size = math.prod(self.shape)
        self.home: Region = graph.region
        self._stored: Stored | None = None

    def at(self, index: tuple[Number, ...]) -> Any:
        """Give the scalar at an index, or those at many that are known."""
        raise NotImplementedError

    def scalars(self) -> np.ndarray:
        """Give all scalars."""
        return np.asarray(self.at(every(self.shape)))

    def steady(self) -> "Array":
        """The same array, such that to ask for an entry often costs no more than once."""
        return self if self.is_steady else self.stored()

    def stored(self) -> "Stored":
        """The same array in memory."""
        if self._stored is None:
            with self.graph.inside(self.home):
                buffer = Buffer(self.dtype, self.size)
                known = self.write(buffer)
                self._stored = Stored(self.graph, self.shape, buffer, known)
        return self._stored

    def write(self, buffer: Buffer, *, blended: bool = False) -> np.ndarray | None:
        """Write all entries to memory, here. Give those that have turned out to be constants, and `NONE` for others."""
        raise NotImplementedError

    def _write_by_loops(self, buffer, blended):
        graph = self.graph
        outer = len(self.shape)
        while outer and math.prod(self.shape[outer - 1 :]) <= LINE:
            outer -= 1
        inner = self.shape[outer:]
        found = np.full(inner, NONE)

        def along(index, place):
            if len(index) == outer:
                for number, along_inner in enumerate(np.ndindex(inner)):
                    scalar = self.at((*index, *along_inner))
                    found[along_inner] = scalar if scalar < 0 else NONE
                    graph.do(Store(buffer, as_scalar(place * found.size + number), scalar, blended))
                return
            size = self.shape[len(index)]

            def one(scalar):
                number = number_of(graph, scalar)
                along((*index, number), place * size + number)
                return ()

            graph.loop(size, (), one)

        along((), 0)
        return np.broadcast_to(found, self.shape) if self.size <= MANY else None


class Entries(Array):
    """Each entry is a scalar of its own."""

    def __init__(self, graph: Graph, scalars: Any, dtype: np.dtype) -> None:
        self.ids = np.asarray(scalars, np.int64)
        super().__init__(graph, self.ids.shape, dtype)

    def at(self, index: tuple[Number, ...]) -> Any:
        if are_known(index):
            found = self.ids[cast(Any, index)]
            return found if isinstance(found, np.ndarray) and found.shape else int(found)
        if self.size == 1:
            return int(self.ids.reshape(-1)[0])
        return self.stored().at(index)

    def scalars(self) -> np.ndarray:
        return self.ids

    def stored(self) -> "Stored":
        if self._stored is None:
            key = self.ids.tobytes(), self.dtype
            buffer = next((region.arrays[key] for region in self.home.and_around() if key in region.arrays), None)
            if buffer is None:
                is_constant = np.all(self.ids < 0)
                buffer = constant_buffer(self.ids, self.dtype) if is_constant else super().stored().buffer
                self.home.arrays[key] = buffer
            self._stored = Stored(self.graph, self.shape, buffer, self.ids)
        return self._stored

    def write(self, buffer: Buffer, *, blended: bool = False) -> None:
        repeated = [axis for axis, size in enumerate(self.shape) if size > 1 and self._is_same_along(axis)]
        if repeated and self.size > REPEATED:
            self._repeat(repeated).write(buffer, blended=blended)
            return
        flat = self.ids.ravel()
        others = np.arange(self.size)
        if np.count_nonzero(flat < 0) > FEW:
            constants = constant_buffer(np.where(flat < 0, flat, constant(0, self.dtype)), self.dtype)
            self.graph.do(Copy(buffer, constants, blended))
            others = np.flatnonzero(flat >= 0)
        places = _places_up_to(self.size)
        for place, scalar in zip(others.tolist(), flat[others].tolist(), strict=True):
            self.graph.do(Store(buffer, int(places[place]), scalar, blended))

    def _is_same_along(self, axis):
        return bool(np.all(self.ids == self.ids.take([0], axis)))

    def _repeat(self, axes):
        """The same array, from memory that holds it once for all places along some axes."""
        once = self.ids[tuple(slice(1) if axis in axes else slice(None) for axis in range(len(self.shape)))]
        whole = Entries(self.graph, once, self.dtype).stored()

        def element(index):
            return whole.at(tuple(0 if axis in axes else number for axis, number in enumerate(index)))

        return Delayed(self.graph, self.shape, self.dtype, element)


class Stored(Array):
    """An array in memory, row by row. `known`: scalars of its entries, and `NONE` for those that memory alone knows."""

    def __init__(self, graph: Graph, shape: tuple[int, ...], buffer: Buffer, known: np.ndarray | None = None) -> None:
        super().__init__(graph, shape, buffer.dtype)
        self.buffer = buffer
        self.known = known if known is not None and np.any(known != NONE) else None

    def at(self, index: tuple[Number, ...]) -> Any:
        graph = self.graph
        if not are_known(index):
            scalar = self._common(index)
            return graph.op(("load", self.buffer), as_scalar(ravelled(index, self.shape))) if scalar is None else scalar
        place = np.asarray(ravelled(index, self.shape))
        name = ("load", self.buffer)
        if self.known is None:
            found = graph.map(name, _places_up_to(self.size)[place])
        else:
            found = np.array(self.known.reshape(-1)[place])
            unknown = found == NONE
            if np.any(unknown):
                found[unknown] = graph.map(name, _places_up_to(self.size)[place[unknown]])
        return found if np.shape(found) else int(found)

    def _common(self, index):
        """The scalar of all entries that an index may mean, where it is one."""
        if self.known is None or not self.size:
            return None
        part = self.known[tuple(slice(None) if isinstance(number, Index) else number for number in index)]
        first = int(part.flat[0])
        return first if first != NONE and np.all(part == first) else None

    def stored(self) -> "Stored":
        return self

    def write(self, buffer: Buffer, *, blended: bool = False) -> None:
        self.graph.do(Copy(buffer, self.buffer, blended))


class Delayed(Array):
    """Entries are computed where they are asked for. `element`: index -> scalar, or those of many known indices."""

    def __init__(
        self,
        graph: Graph,
        shape: tuple[int, ...],
        dtype: np.dtype,
        element: Callable[[tuple[Number, ...]], Any],
        *,
        is_steady: bool = False,
    ) -> None:
        super().__init__(graph, shape, dtype)
        self._element = element
        self.is_steady = is_steady

    def at(self, index: tuple[Number, ...]) -> Any:
        return self._element(index)

    def write(self, buffer: Buffer, *, blended: bool = False) -> np.ndarray | None:
        return self._write_by_loops(buffer, blended)


class Updated(Array):
    """An array in memory, of which some entries are others: those of a window that begins somewhere.

    What it is made of may become it by writing the window alone.
    """

    is_steady = False

    def __init__(self, base: Array, start: tuple[Number, ...], window: Array) -> None:
        super().__init__(base.graph, base.shape, base.dtype)
        self.base = base
        self.start = start
        self.window = window

    def at(self, index: tuple[Number, ...]) -> Any:
        return self._one(index) if are_known(self.start) else by_entry(self._one)(index)

    def _one(self, index):
        inside: Any = True
        places = []
        for number, start, size in zip(index, self.start, self.window.shape, strict=True):
            place = number - start
            within = (place >= 0) & (place < size)
            inside = within if inside is True else inside & within
            places.append((place, within))
        places = [chosen(self.graph, within, place, 0) for place, within in places]
        return chosen_scalars(self.graph, inside, lambda: self.window.at(tuple(places)), lambda: self.base.at(index))

    def write(self, buffer: Buffer, *, blended: bool = False) -> None:
        if not (isinstance(self.base, Stored) and self.base.buffer is buffer):
            self.base.write(buffer, blended=blended)
        self.write_window(buffer, blended)

    def write_window(self, buffer: Buffer, blended: bool) -> None:
        """Write what is others."""
        graph = self.graph
        window = self.window.steady()

        def one(scalar):
            inner = unravelled(number_of(graph, scalar), window.shape)
            index = tuple(start + number for start, number in zip(self.start, inner, strict=True))
            place = ravelled(index, self.shape)
            graph.do(Store(buffer, as_scalar(place), window.at(inner), blended))
            return ()

        if window.size <= LINE:
            for place in range(window.size):
                one(constant(place, INDEX))
        else:
            graph.loop(window.size, (), one)


def known_of(array: Array) -> np.ndarray | None:
    """The scalars of entries that are known without a look into memory, and `NONE` for others; None where none is."""
    if isinstance(array, Entries):
        return array.ids
    return array.known if isinstance(array, Stored) else None


def constants_of(array: Array) -> np.ndarray | None:
    """The constants among the entries of an array, and `NONE` for others; None where there are none."""
    known = known_of(array)
    if known is None:
        return None
    found = np.where(known < 0, known, NONE)
    return found if np.any(known < 0) else None


def constant_buffer(scalars: np.ndarray, dtype: np.dtype) -> Buffer:
    """Constants in memory."""
    flat = scalars.ravel()
    data = np.array([value_of(scalar) for scalar in flat.tolist()], dtype)
    return Buffer(dtype, flat.size, "constant", data=data)
