"""What JAX calls: functions by XLA's interface for foreign functions, for one member or for a batch."""

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax

from scalarjit import packing
from scalarjit.compiler import AT_ONCE, digest, kept_or_compiled, loaded
from scalarjit.function import Function
from scalarjit.machine import compiled
from scalarjit.memory import ALIGNMENT
from scalarjit.units import Unit, unit

HANDLER = """
@cell = global ptr null
@packing = global ptr null
declare ptr @malloc(i64)
declare void @free(ptr)
define ptr @handler(ptr %frame) {{
entry:
%extensions = getelementptr i8, ptr %frame, i64 8
%extension = load ptr, ptr %extensions
%asks = icmp ne ptr %extension, null
br i1 %asks, label %metadata, label %execute
metadata:
%tells = getelementptr i8, ptr %extension, i64 24
%told = load ptr, ptr %tells
%major = getelementptr i8, ptr %told, i64 24
store i32 0, ptr %major
%minor = getelementptr i8, ptr %told, i64 28
store i32 {minor}, ptr %minor
ret ptr null
execute:
%given = getelementptr i8, ptr %frame, i64 72
%arguments = load ptr, ptr %given
%wanted = getelementptr i8, ptr %frame, i64 112
%results = load ptr, ptr %wanted
%raw = call ptr @malloc(i64 {bytes})
%number = ptrtoint ptr %raw to i64
%up = add i64 %number, {above}
%aligned = and i64 %up, -{alignment}
%memory = inttoptr i64 %aligned to ptr
{columns}
%cell = load ptr, ptr @cell
%code = load ptr, ptr %cell
{body}
call void @free(ptr %raw)
ret ptr null
}}
"""
NAMES = r"scalarjit_[0-9a-f]{40}"  # by which JAX calls
MINOR = 3  # of the version 0 of XLA's interface for foreign functions that handlers are written for


def _column(table: str, number: int, name: str) -> str:
    return (
        f"%{name}s = getelementptr ptr, ptr %{table}, i64 {number}\n%{name}d = load ptr, ptr %{name}s\n"
        f"%{name}p = getelementptr i8, ptr %{name}d, i64 24\n%{name} = load ptr, ptr %{name}p"
    )


@dataclass(frozen=True, eq=False)
class Handler:
    """A function as JAX calls it, under a name that is the same in all processes; can be pickled."""

    text: str
    unit: Unit
    lanes: int
    sizes: frozenset[int]  # of entries that are packed

    @cached_property
    def name(self) -> str:
        return f"scalarjit_{digest(self.text, self.unit.key)}"

    def register(self) -> None:
        """Tell JAX, which may call it as long as the process lives."""
        known = self.name in registered
        registered[self.name] = self
        if known:
            return
        made = compiled(self.unit)
        engine = loaded(kept_or_compiled(self.text, AT_ONCE))
        for name, address in ("cell", made.cell.ctypes.data), ("packing", packing.table(self.lanes, self.sizes)):
            ctypes.c_int64.from_address(engine.get_global_value_address(name)).value = address
        called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(engine.get_function_address("handler"))
        jax.ffi.register_ffi_target(self.name, jax.ffi.pycapsule(called), platform="cpu", api_version=1)
        _in_use.append((made, engine, called))


registered: dict[str, Handler | None] = {}  # None for those whose text has been let go of
_in_use: list[Any] = []


def clear() -> None:
    """Let go of texts."""
    for name in registered:
        registered[name] = None


def handler_of(function: Function, lanes: int, members: int | None = None, batched: tuple[bool, ...] = ()) -> Handler:
    """A function as JAX calls it.

    **Arguments:** `members`: how many there are, None for one alone; `batched`: which arguments have one row for each.
    """
    code = unit(function, lanes)
    passed = [number for number, buffer in enumerate(function.arguments) if buffer is not None]
    columns = [_column("arguments", number, f"a{number}") for number in passed]
    columns += [_column("results", number, f"r{number}") for number in range(len(function.buffers))]
    given = [f"ptr %a{number}" for number in passed]
    wanted = [f"ptr %r{number}" for number in range(len(function.buffers))]
    if members is None:
        body = f"call void %code({', '.join([*given, *wanted, 'ptr %memory', 'ptr %cell'])})"
        sizes = frozenset()
        more = 0
    else:
        body, sizes, more = _over_groups(function, lanes, members, batched, passed, code.memory)
    text = HANDLER.format(
        minor=MINOR,
        bytes=code.memory + more + ALIGNMENT,
        above=ALIGNMENT - 1,
        alignment=ALIGNMENT,
        columns="\n".join(columns),
        body=body,
    )
    return Handler(text, code, lanes, sizes)


def _over_groups(function, lanes, members, batched, passed, memory):
    """A loop over groups of members, whose arrays become vectors, and back."""
    lines: list[str] = []
    offset = memory
    given = []
    after = []
    sizes = set()

    def room(buffer, name):
        nonlocal offset
        size = 1 if buffer.dtype == bool else buffer.dtype.itemsize
        sizes.add(size)
        lines.append(f"%{name}v = getelementptr i8, ptr %memory, i64 {offset}")
        offset += -(-max(buffer.size, 1) * size * lanes // ALIGNMENT) * ALIGNMENT
        return size

    for number in passed:
        buffer = function.arguments[number]
        size = room(buffer, f"a{number}")
        stride = buffer.size if batched[number] else 0
        lines.append(
            f"call void %pack{size}(ptr %a{number}v, ptr %a{number}, i64 {buffer.size}, i64 %g, i64 {members - 1}, "
            f"i64 {stride})"
        )
        given.append(f"ptr %a{number}v")
    for number, buffer in enumerate(function.buffers):
        size = room(buffer, f"r{number}")
        given.append(f"ptr %r{number}v")
        after.append(
            f"call void %unpack{size}(ptr %r{number}, ptr %r{number}v, i64 {buffer.size}, i64 %g, i64 {members - 1})"
        )
    lines.append(f"call void %code({', '.join([*given, 'ptr %memory', 'ptr %cell'])})")
    lines += [*after, f"%g1 = add i64 %g, {lanes}", "br label %groups", "end:"]
    begin = ["%table = load ptr, ptr @packing"]
    for size in sorted(sizes):
        for name in packing.FUNCTIONS:
            place = packing.place(name, size)
            begin += [
                f"%{name}{size}s = getelementptr ptr, ptr %table, i64 {place}",
                f"%{name}{size} = load ptr, ptr %{name}{size}s",
            ]
    begin += [
        "br label %groups",
        "groups:",
        "%g = phi i64 [0, %execute], [%g1, %group]",
        f"%any = icmp slt i64 %g, {members}",
        "br i1 %any, label %group, label %end",
        "group:",
    ]
    return "\n".join([*begin, *lines]), frozenset(sizes), offset - memory
