"""Arrays of a batch as vectors of its members, and back: loops that all handlers of batches share.

Compiled with care, once for each size of entries: they are most of what a handler does, and in each of them they took
0.16 s to compile.
"""

from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np

from scalarjit.compiler import CARE, kept_or_compiled, loaded

SIZES = (1, 2, 4, 8)  # of entries [bytes]
FUNCTIONS = ("pack", "unpack")
TEXT = """
define void @pack(ptr %to, ptr %from, i64 %count, i64 %first, i64 %last, i64 %stride) {{
entry:
br label %entries
entries:
%e = phi i64 [0, %entry], [%e1, %next]
%has = icmp slt i64 %e, %count
br i1 %has, label %members, label %done
members:
%l = phi i64 [0, %entries], [%l1, %one]
%more = icmp slt i64 %l, {lanes}
br i1 %more, label %one, label %next
one:
%m = add i64 %first, %l
%within = icmp slt i64 %m, %last
%member = select i1 %within, i64 %m, i64 %last
%row = mul i64 %member, %stride
%place = add i64 %row, %e
%source = getelementptr i{bits}, ptr %from, i64 %place
%value = load i{bits}, ptr %source
%column = mul i64 %e, {lanes}
%at = add i64 %column, %l
%target = getelementptr i{bits}, ptr %to, i64 %at
store i{bits} %value, ptr %target
%l1 = add i64 %l, 1
br label %members
next:
%e1 = add i64 %e, 1
br label %entries
done:
ret void
}}
define void @unpack(ptr %to, ptr %from, i64 %count, i64 %first, i64 %last) {{
entry:
br label %members
members:
%l = phi i64 [0, %entry], [%l1, %next]
%m = add i64 %first, %l
%few = icmp slt i64 %l, {lanes}
%within = icmp sle i64 %m, %last
%has = and i1 %few, %within
br i1 %has, label %entries, label %done
entries:
%e = phi i64 [0, %members], [%e1, %one]
%more = icmp slt i64 %e, %count
br i1 %more, label %one, label %next
one:
%column = mul i64 %e, {lanes}
%at = add i64 %column, %l
%source = getelementptr i{bits}, ptr %from, i64 %at
%value = load i{bits}, ptr %source
%row = mul i64 %m, %count
%place = add i64 %row, %e
%target = getelementptr i{bits}, ptr %to, i64 %place
store i{bits} %value, ptr %target
%e1 = add i64 %e, 1
br label %entries
next:
%l1 = add i64 %l, 1
br label %members
done:
ret void
}}
"""


def place(name: str, size: int) -> int:
    """Where the address of a function is in the table of its number of lanes."""
    return len(SIZES) * FUNCTIONS.index(name) + SIZES.index(size)


def table(lanes: int, sizes: Iterable[int]) -> int:
    """The address of the table of a number of lanes, which has the functions for these sizes of entries."""
    addresses = _table(lanes)
    for size in sizes:
        engine = _compiled(lanes, size)
        for name in FUNCTIONS:
            addresses[place(name, size)] = engine.get_function_address(name)
    return addresses.ctypes.data


@cache
def _table(lanes: int) -> np.ndarray:
    return np.zeros(len(SIZES) * len(FUNCTIONS), np.int64)


@cache
def _compiled(lanes: int, size: int) -> Any:
    return loaded(kept_or_compiled(TEXT.format(lanes=lanes, bits=8 * size), CARE))
