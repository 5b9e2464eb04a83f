"""Scalar operations in the order in which they are computed.

What is known when a program is compiled folds, and what is computed already is not computed again. Folding keeps
rounding: it leaves out 0 + x, 1·x and the like, and moves signs. 0·x and 0/x are 0, also where x is not finite.
"""

from collections.abc import Callable, Container
from typing import Any, NamedTuple

import numpy as np

INPUT, KNOWN = "input", "known"


class Operation(NamedTuple):
    """What computes a scalar: the name of a primitive of JAX and its parameters, and the scalars it computes with."""

    name: str
    operands: tuple[int, ...]
    params: tuple[tuple[str, Any], ...] = ()


class TooLong(Exception):
    """A straight line has more operations than it may."""


class Graph:
    """Scalars by their indices: known ones, inputs, and results of operations on earlier ones.

    **Arguments:** `most`: how many operations there may be; more raise `TooLong`.
    """

    def __init__(self, most: int | None = None) -> None:
        self.most = most
        self.operations: list[Operation] = []
        self.values: list[Any] = []  # NumPy's scalar where it is known, else None
        self.dtypes: list[np.dtype] = []
        self.count = 0  # of operations that compute
        self._indices: dict[Any, int] = {}

    def _append(self, key, operation, value, dtype) -> int:
        index = self._indices[key] = len(self.operations)
        self.operations.append(operation)
        self.values.append(value)
        self.dtypes.append(dtype)
        return index

    def input(self, dtype: np.dtype) -> int:
        """A new scalar that is not known."""
        return self._append((INPUT, len(self.operations)), Operation(INPUT, ()), None, np.dtype(dtype))

    def known(self, value: Any, dtype: np.dtype) -> int:
        """A scalar that is known."""
        dtype = np.dtype(dtype)
        value = dtype.type(value)
        key = KNOWN, dtype, value.tobytes()
        found = self._indices.get(key)
        return self._append(key, Operation(KNOWN, ()), value, dtype) if found is None else found

    def is_zero(self, index: int) -> bool:
        """Whether a scalar is known to be zero."""
        value = self.values[index]
        # The tangents of whole numbers have no value to compare.
        return value is not None and self.dtypes[index].kind != "V" and bool(value == 0)

    def compute(self, name: str, operands: tuple[int, ...], dtype: np.dtype, params: tuple = ()) -> int:
        """The result of an operation, without folding."""
        key = name, operands, params, dtype
        found = self._indices.get(key)
        if found is not None:
            return found
        self.count += 1
        if self.most is not None and self.count > self.most:
            raise TooLong
        return self._append(key, Operation(name, operands, params), None, dtype)

    def _sorted(self, name, a, b) -> int:
        return self.compute(name, (a, b) if a <= b else (b, a), self.dtypes[a])

    def _negated(self, a) -> int | None:
        """x where a scalar is −x."""
        operation = self.operations[a]
        return operation.operands[0] if operation.name == "neg" else None

    def add(self, a: int, b: int) -> int:
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(x + y, self.dtypes[a])
        if self.is_zero(a):
            return b
        if self.is_zero(b):
            return a
        if (minus := self._negated(b)) is not None:
            return self.sub(a, minus)
        if (minus := self._negated(a)) is not None:
            return self.sub(b, minus)
        return self._sorted("add", a, b)

    def sub(self, a: int, b: int) -> int:
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(x - y, self.dtypes[a])
        if self.is_zero(b):
            return a
        if self.is_zero(a):
            return self.neg(b)
        if (minus := self._negated(b)) is not None:
            return self.add(a, minus)
        return self.compute("sub", (a, b), self.dtypes[a])

    def neg(self, a: int) -> int:
        if (x := self.values[a]) is not None:
            return self.known(-x, self.dtypes[a])
        if (minus := self._negated(a)) is not None:
            return minus
        return self.compute("neg", (a,), self.dtypes[a])

    def mul(self, a: int, b: int) -> int:
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(x * y, self.dtypes[a])
        if y is not None:
            a, b, x = b, a, y
        if x is not None:
            if x == 0:
                return a
            if x == 1:
                return b
            if x == -1 and self.dtypes[a].kind == "f":
                return self.neg(b)
        if (minus := self._negated(a)) is not None:
            return self.neg(self.mul(minus, b))
        if (minus := self._negated(b)) is not None:
            return self.neg(self.mul(a, minus))
        return self._sorted("mul", a, b)

    def div(self, a: int, b: int) -> int:
        x, y = self.values[a], self.values[b]
        real = self.dtypes[a].kind == "f"
        if real:
            if x is not None and y is not None:
                with np.errstate(all="ignore"):
                    return self.known(x / y, self.dtypes[a])
            if x is not None and x == 0:
                return a
            if (minus := self._negated(a)) is not None:
                return self.neg(self.div(minus, b))
            if (minus := self._negated(b)) is not None:
                return self.neg(self.div(a, minus))
        if y is not None and y == 1:
            return a
        return self.compute("div", (a, b), self.dtypes[a])

    def _extreme(self, name, choose, a, b) -> int:
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(choose(x, y), self.dtypes[a])
        return a if a == b else self._sorted(name, a, b)

    def max(self, a: int, b: int) -> int:
        return self._extreme("max", np.maximum, a, b)

    def min(self, a: int, b: int) -> int:
        return self._extreme("min", np.minimum, a, b)

    def _bits(self, name, function, neutral, a, b) -> int:
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(function(x, y), self.dtypes[a])
        if self.dtypes[a].kind == "b":
            for value, own, other in ((x, a, b), (y, b, a)):
                if value is not None:
                    return other if value == neutral else own
        return a if a == b else self._sorted(name, a, b)

    def logical_and(self, a: int, b: int) -> int:
        return self._bits("and", np.bitwise_and, True, a, b)

    def logical_or(self, a: int, b: int) -> int:
        return self._bits("or", np.bitwise_or, False, a, b)

    def logical_not(self, a: int) -> int:
        if (x := self.values[a]) is not None:
            return self.known(~x, self.dtypes[a])
        operation = self.operations[a]
        return operation.operands[0] if operation.name == "not" else self.compute("not", (a,), self.dtypes[a])

    def compare(self, name: str, a: int, b: int) -> int:
        """lt, le, gt, ge, eq or ne."""
        x, y = self.values[a], self.values[b]
        if x is not None and y is not None:
            return self.known(_COMPARED[name](x, y), np.dtype(bool))
        return self.compute(name, (a, b), np.dtype(bool))

    def select(self, which: int, false: int, true: int) -> int:
        if (x := self.values[which]) is not None:
            return true if x else false
        if false == true:
            return true
        operation = self.operations[which]
        if operation.name == "not":
            return self.select(operation.operands[0], true, false)
        if self.dtypes[true].kind == "b":
            known = self.values[false], self.values[true]
            if known == (False, True):
                return which
            if known == (True, False):
                return self.logical_not(which)
        return self.compute("select_n", (which, false, true), self.dtypes[true])

    def convert(self, a: int, dtype: np.dtype) -> int:
        dtype = np.dtype(dtype)
        if self.dtypes[a] == dtype:
            return a
        if (x := self.values[a]) is not None:
            return self.known(x.astype(dtype), dtype)
        params = (("new_dtype", dtype), ("weak_type", False), ("sharding", None))
        return self.compute("convert_element_type", (a,), dtype, params)

    def power(self, a: int, exponent: int) -> int:
        """An integer power, by squaring."""
        if exponent == 0:
            return self.known(1, self.dtypes[a])
        if exponent < 0:
            return self.div(self.known(1, self.dtypes[a]), self.power(a, -exponent))
        square, found = a, None
        while exponent:
            if exponent & 1:
                found = square if found is None else self.mul(found, square)
            exponent >>= 1
            if exponent:
                square = self.mul(square, square)
        assert found is not None
        return found

    def of_known(self, name: str, operands: tuple[int, ...], dtype: np.dtype, params: tuple = ()) -> int:
        """Another operation on real numbers, folded where NumPy has it and all is known."""
        function = _FUNCTIONS.get(name)
        values = [self.values[operand] for operand in operands]
        if function is None or params or any(value is None for value in values):
            return self.compute(name, operands, dtype, params)
        with np.errstate(all="ignore"):
            return self.known(function(*values), dtype)

    def reduce(self, function: Callable[[int, int], int], terms: list[int]) -> int | None:
        """Combine scalars pair by pair, which a processor does side by side; None for none."""
        while len(terms) > 1:
            pairs = [function(terms[k], terms[k + 1]) for k in range(0, len(terms) - 1, 2)]
            terms = pairs + ([terms[-1]] if len(terms) % 2 else [])
        return terms[0] if terms else None

    def needed(self, results: list[int], given: Container[int]) -> list[int]:
        """All scalars that results are computed from, in order, down to those that are given."""
        marked, stack = set(), list(results)
        while stack:
            index = stack.pop()
            if index in marked:
                continue
            marked.add(index)
            if index not in given:
                stack.extend(self.operations[index].operands)
        return sorted(marked)


_COMPARED = {
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
}
_FUNCTIONS: dict[str, Callable] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "exp": np.exp,
    "log": np.log,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "is_finite": np.isfinite,
    "atan2": np.arctan2,
    "pow": np.power,
    "rem": np.fmod,
}
