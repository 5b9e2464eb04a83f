"""The functions of a process: one for each that JAX has traced, and for the constants that its arguments hold."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from scalarjit.arrays import NONE, Array, Delayed, Entries, Stored, constants_of
from scalarjit.function import Function, Result
from scalarjit.graph import Buffer, Graph
from scalarjit.traced import check
from scalarjit.walk import Walk

MOST_VERSIONS = 8  # of a function, for constants that its arguments hold
ALIKE = 0.9  # share of these constants that another version may know


class Functions:
    """Functions by what JAX has traced and the constants that arguments hold."""

    def __init__(self) -> None:
        self._versions: dict[int, tuple[Any, list[Function]]] = {}

    def clear(self) -> None:
        self._versions.clear()

    def of(self, closed: ClosedJaxpr, arrays: list[Array]) -> Function:
        """Give the function for arguments: one that knows the same constants or most of them, or a new one."""
        _, versions = self._versions.setdefault(id(closed.jaxpr), (closed, []))
        known = [constants_of(array) for array in arrays]
        count = sum(_count(each) for each in known)
        best = max(versions, key=lambda version: _common(version.known, known), default=None)
        if best is not None:
            common = _common(best.known, known)
            if common == count or (common >= 0 and (common >= ALIKE * count or len(versions) >= MOST_VERSIONS)):
                return best
        if len(versions) >= MOST_VERSIONS:
            known = [None] * len(known)
        made = function_of(closed, known)
        versions.append(made)
        return made


FUNCTIONS = Functions()


def _count(known):
    return 0 if known is None else int(np.count_nonzero(known != NONE))


def _common(own, given):
    """How many constants a version knows; −1 where some of them are not those of the arguments."""
    total = 0
    for one, other in zip(own, given, strict=True):
        if one is None:
            continue
        at = one != NONE
        if other is None or not np.array_equal(one[at], other[at]):
            return -1
        total += int(np.count_nonzero(at))
    return total


def function_of(closed: ClosedJaxpr, known: Iterable[np.ndarray | None]) -> Function:
    """Walk through a traced function into a graph of its own."""
    graph = Graph()
    constants = list(known)
    function = Function(graph, constants, lambda: function_of(closed, constants))
    inputs: list[Array] = []
    for number, (var, constants_) in enumerate(zip(closed.jaxpr.invars, function.known, strict=True)):
        check(var.aval)
        dtype = np.dtype(var.aval.dtype)
        if constants_ is not None and np.all(constants_ < 0):
            function.arguments.append(None)
            inputs.append(Entries(graph, constants_, dtype))
            continue
        buffer = Buffer(dtype, math.prod(var.aval.shape), "argument", number)
        function.arguments.append(buffer)
        inputs.append(Stored(graph, var.aval.shape, buffer, constants_))
    outputs = Walk(graph, FUNCTIONS.of).closed(closed, inputs)
    number = 0
    written: set[int] = set()
    for array in outputs:
        if isinstance(array, Delayed):
            array = array.stored()  # which tells constants
        known_ = constants_of(array)
        of_argument = next((k for k, given in enumerate(inputs) if given is array), None)
        result = Result(array.shape, array.dtype, known_, of_argument)
        function.results.append(result)
        if result.is_written:
            if isinstance(array, Stored) and array.buffer.kind == "own" and id(array.buffer) not in written:
                buffer = array.buffer
                buffer.kind = "result"
                buffer.number = number
                written.add(id(buffer))
            else:
                buffer = Buffer(array.dtype, array.size, "result", number)
                array.write(buffer)
            function.buffers.append(buffer)
            number += 1
    return function
