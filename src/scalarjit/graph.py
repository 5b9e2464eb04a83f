"""Scalars of a function: numbers that follow from others, each computed once, in regions that loops repeat.

A scalar is an integer. Constants are negative, and the same in all functions of a process; others count the operations
of their graph. So arrays of scalars are arrays of integers, which NumPy reshapes, slices and compares.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import numpy as np

from scalarjit.operations import BOOL, OPERATIONS

INDEX = np.dtype(np.int64)
FEW = 16  # constants that are looked for one by one faster than sorted

# Constants, of which number −1 − k is the k-th.
_values: list[np.generic] = []
_numbers: dict[tuple, int] = {}
_is_zero: list[bool] = []
_is_one: list[bool] = []


def constant(value: Any, dtype: np.dtype = INDEX) -> int:
    """Give the scalar of a constant."""
    value = dtype.type(value)
    key = (dtype.char, value.tobytes())
    number = _numbers.get(key)
    if number is None:
        _values.append(value)
        _is_zero.append(bool(value == 0))
        _is_one.append(bool(value == 1))
        number = _numbers[key] = -len(_values)
    return number


def constants(array: np.ndarray) -> np.ndarray:
    """Give the scalars of an array of constants."""
    array = np.asarray(array)
    if array.size <= FEW:
        scalars = [constant(value, array.dtype) for value in array.ravel()]
        return np.array(scalars, np.int64).reshape(array.shape)
    different, places = np.unique(
        array.view(f"u{array.itemsize}") if array.dtype.kind == "f" else array, return_inverse=True
    )
    scalars = [constant(value, array.dtype) for value in different.view(array.dtype)]
    return np.array(scalars, np.int64)[places].reshape(array.shape)


def value_of(scalar: int) -> np.generic:
    """Give the value of a constant."""
    return _values[-1 - scalar]


def is_zero(scalar: int) -> bool:
    return scalar < 0 and _is_zero[-1 - scalar]


def is_one(scalar: int) -> bool:
    return scalar < 0 and _is_one[-1 - scalar]


@dataclass(eq=False)
class Buffer:
    """An array in memory: an argument, a result, a constant, or one of the function's own."""

    dtype: np.dtype
    size: int
    kind: str = "own"  # "argument", "result", "constant"
    number: int = 0  # of arguments and results
    data: np.ndarray | None = None  # of constants
    offset: int = 0  # in the memory of the function, in bytes of one lane


@dataclass(eq=False)
class Region:
    """Operations and statements in their order; those of regions around it are at hand in it.

    `arrays`: what is in memory, by its entries.
    """

    parent: "Region | None" = None
    memo: dict[tuple, int] = field(default_factory=dict)
    items: list[Any] = field(default_factory=list)
    arrays: "dict[tuple, Buffer]" = field(default_factory=dict)

    def and_around(self) -> "Iterator[Region]":
        """This one, and those around it, from within."""
        region = self
        while region is not None:
            yield region
            region = region.parent


@dataclass(eq=False)
class Store:
    """`blended`: in lanes where the branch or pass that it ends is not taken, memory stays as it is."""

    buffer: Buffer
    offset: int
    value: int
    blended: bool = False


@dataclass(eq=False)
class Copy:
    """Of whole arrays."""

    target: Buffer
    source: Buffer
    blended: bool = False


@dataclass(eq=False)
class For:
    """A loop of known length. `carried`: (scalar in the loop and after it, at its begin, after a pass)."""

    count: int
    index: int
    region: Region
    carried: list[tuple[int, int, int]] = field(default_factory=list)


@dataclass(eq=False)
class While:
    test: Region
    goes_on: int
    region: Region


@dataclass(eq=False)
class If:
    condition: int
    region: Region


@dataclass(eq=False)
class Call:
    function: Any
    arguments: list[Buffer]
    results: list[Buffer]


class Graph:
    """Scalars of one function."""

    def __init__(self) -> None:
        self.names: list[Any] = []
        self.operands: list[tuple[int, ...]] = []
        self.dtypes: list[np.dtype] = []
        self.region = self.root = Region()

    def dtype(self, scalar: int) -> np.dtype:
        return _values[-1 - scalar].dtype if scalar < 0 else self.dtypes[scalar]

    def new(self, name: Any, operands: tuple[int, ...], dtype: np.dtype) -> int:
        """Add an operation to the region."""
        scalar = len(self.names)
        self.names.append(name)
        self.operands.append(operands)
        self.dtypes.append(dtype)
        self.region.items.append(scalar)
        return scalar

    def do(self, statement: Any) -> None:
        self.region.items.append(statement)

    @contextmanager
    def inside(self, region: Region | None = None) -> Iterator[Region]:
        """Add what follows to a region in this one."""
        outer = self.region
        self.region = region or Region(outer)
        try:
            yield self.region
        finally:
            self.region = outer

    def op(self, name: Any, *operands: int) -> int:
        """Give the scalar of an operation: computed of constants, simplified, known, or new.

        **Arguments:** `name`: of `OPERATIONS`, `("convert", dtype)`, or `("load", buffer)` of an offset.
        """
        key = (name, *operands)
        region = self.region
        while region is not None:
            found = region.memo.get(key)
            if found is not None:
                return found
            region = region.parent
        scalar = self._computed(name, operands)
        self.region.memo[key] = scalar
        return scalar

    def _computed(self, name, operands):
        if isinstance(name, tuple):
            kind, what = name
            if kind == "load":
                return self.new(name, operands, what.dtype)
            return self._converted(what, operands[0])
        if max(operands) < 0:
            with np.errstate(all="ignore"):
                value = OPERATIONS[name].compute(*map(value_of, operands))
            return constant(value, BOOL if OPERATIONS[name].is_test else self.dtype(operands[-1]))
        simplify = SIMPLER.get(name)
        simple = simplify(self, *operands) if simplify else None
        if simple is not None:
            return simple
        return self.new(name, operands, BOOL if OPERATIONS[name].is_test else self.dtype(operands[-1]))

    def _converted(self, dtype, operand):
        own = self.dtype(operand)
        if own == dtype:
            return operand
        if operand < 0:
            with np.errstate(all="ignore"):
                return constant(value_of(operand).astype(dtype), dtype)
        if dtype == BOOL:
            return self.op("ne", operand, constant(0, own))
        return self.new(("convert", dtype), (operand,), dtype)

    def map(self, name: Any, *arrays: Any) -> Any:
        """Give the scalars of an operation on each entry of arrays of scalars, which are broadcast."""
        op = self.op
        shapes = {array.shape for array in arrays if not isinstance(array, int)}
        if not shapes:
            return op(name, *arrays)
        if len(shapes) > 1:  # which takes NumPy longer than all else here
            arrays = np.broadcast_arrays(*arrays)
            shapes = {arrays[0].shape}
        (shape,) = shapes
        lists = [repeat(array) if isinstance(array, int) else array.ravel().tolist() for array in arrays]
        return np.array([op(name, *each) for each in zip(*lists, strict=False)], np.int64).reshape(shape)

    def loop(self, count: int, initial: Iterable[int], body: Callable[..., Iterable[int]]) -> tuple[int, ...]:
        """Add a loop of known length. `body`: (index, *carried) -> what is carried to the next pass."""
        initial = tuple(initial)
        with self.inside() as region:
            index = self.new("index", (), INDEX)
            carried = [self.new("carried", (), self.dtype(scalar)) for scalar in initial]
            following = tuple(body(index, *carried))
        self.do(For(count, index, region, list(zip(carried, initial, following, strict=True))))
        return tuple(carried)


def _add(graph, one, other):
    if is_zero(one):
        return other
    return one if is_zero(other) else None


def _sub(graph, one, other):
    if is_zero(other):
        return one
    if is_zero(one):
        return graph.op("neg", other)
    if other >= 0 and graph.names[other] == "neg":
        return graph.op("add", one, graph.operands[other][0])
    return None


def _mul(graph, one, other):
    for this, that in ((one, other), (other, one)):
        if is_zero(this) or is_one(that):
            return this
        if that < 0 and value_of(that) == -1 and graph.dtype(that).kind == "f":
            return graph.op("neg", this)
    return None


def _div(graph, one, other):
    return one if is_one(other) or (is_zero(one) and graph.dtype(one).kind == "f") else None


def _rem(graph, one, other):
    return constant(0, graph.dtype(one)) if is_one(other) and graph.dtype(one).kind != "f" else None


def _neg(graph, one):
    return graph.operands[one][0] if graph.names[one] == "neg" else None


def _not(graph, one):
    return graph.operands[one][0] if graph.names[one] == "not" and graph.dtype(one) == BOOL else None


def _and(graph, one, other):
    if one == other:
        return one
    if graph.dtype(one) == BOOL:
        for this, that in ((one, other), (other, one)):
            if this < 0:
                return that if value_of(this) else this
    return None


def _or(graph, one, other):
    if one == other:
        return one
    if graph.dtype(one) == BOOL:
        for this, that in ((one, other), (other, one)):
            if this < 0:
                return this if value_of(this) else that
    return None


def _select(graph, condition, yes, no):
    if condition < 0:
        return yes if value_of(condition) else no
    if yes == no:
        return yes
    if graph.dtype(yes) == BOOL and yes < 0 and no < 0:
        return condition if value_of(yes) else graph.op("not", condition)
    return None


def _extreme(graph, one, other):
    return one if one == other else None


SIMPLER = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "rem": _rem,
    "neg": _neg,
    "not": _not,
    "and": _and,
    "or": _or,
    "select": _select,
    "max": _extreme,
    "min": _extreme,
}


class Index:
    """A whole number that a program finds as it runs, in the arithmetic of places: with integers, in Python's signs."""

    __array_ufunc__ = None  # with arrays of places NumPy would make arrays of objects

    def __init__(self, graph: Graph, scalar: int) -> None:
        self.graph = graph
        self.scalar = scalar

    def _with(self, name, other, swapped=False):
        operands = self.scalar, as_scalar(other)
        found = self.graph.op(name, *(operands[::-1] if swapped else operands))
        return number_of(self.graph, found)

    def __add__(self, other):
        return self._with("add", other)

    def __radd__(self, other):
        return self._with("add", other)

    def __sub__(self, other):
        return self._with("sub", other)

    def __rsub__(self, other):
        return self._with("sub", other, swapped=True)

    def __mul__(self, other):
        return self._with("mul", other)

    def __rmul__(self, other):
        return self._with("mul", other)

    def __floordiv__(self, other):  # of places, which are not negative
        return self._with("div", other)

    def __mod__(self, other):
        return self._with("rem", other)

    def __lt__(self, other):
        return self._with("lt", other)

    def __ge__(self, other):
        return self._with("ge", other)

    def __le__(self, other):
        return self._with("le", other)

    def __gt__(self, other):
        return self._with("gt", other)

    def __and__(self, other):
        return self._with("and", other)

    __rand__ = __and__

    def __bool__(self):
        raise TypeError("an index that is found as a program runs is neither true nor false")


def as_scalar(number: Any) -> int:
    """Give the scalar of an index, or of an integer or bool."""
    if isinstance(number, Index):
        return number.scalar
    return constant(number, BOOL if isinstance(number, bool | np.bool_) else INDEX)


def number_of(graph: Graph, scalar: int) -> Any:
    """Give the index of a scalar, as an integer or bool where it is a constant."""
    if scalar < 0:
        return value_of(scalar).item()
    return Index(graph, scalar)
