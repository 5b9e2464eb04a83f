"""What JAX calls: functions by XLA's interface for foreign functions, for one member or for a batch."""

import ctypes

import jax

from scalarjit.compiler import loaded, object_code
from scalarjit.emission import ALIGNMENT
from scalarjit.function import Function
from scalarjit.machine import compiled

HANDLER = """
declare ptr @malloc(i64)
declare void @free(ptr)
{packing}
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
%cell = inttoptr i64 {cell} to ptr
%code = load ptr, ptr %cell
{body}
call void @free(ptr %raw)
ret ptr null
}}
"""
PACKING = """
define void @pack{size}(ptr %to, ptr %from, i64 %count, i64 %first, i64 %last, i64 %stride) {{
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
define void @unpack{size}(ptr %to, ptr %from, i64 %count, i64 %first, i64 %last) {{
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
MINOR = 3  # of the version 0 of XLA's interface for foreign functions that handlers are written for


def _column(table: str, number: int, name: str) -> str:
    return (
        f"%{name}s = getelementptr ptr, ptr %{table}, i64 {number}\n%{name}d = load ptr, ptr %{name}s\n"
        f"%{name}p = getelementptr i8, ptr %{name}d, i64 24\n%{name} = load ptr, ptr %{name}p"
    )


class Handler:
    """A function that JAX calls: `capsule` is what `jax.ffi.register_ffi_target` takes.

    **Arguments:** `members`: how many there are, None for one alone; `batched`: which arguments have one row for each.
    """

    def __init__(
        self, function: Function, lanes: int, members: int | None = None, batched: tuple[bool, ...] = ()
    ) -> None:
        self.compiled = made = compiled(function, lanes)
        passed = [number for number, buffer in enumerate(function.arguments) if buffer is not None]
        columns = [_column("arguments", number, f"a{number}") for number in passed]
        columns += [_column("results", number, f"r{number}") for number in range(len(function.buffers))]
        given = [f"ptr %a{number}" for number in passed]
        wanted = [f"ptr %r{number}" for number in range(len(function.buffers))]
        if members is None:
            body = f"call void %code({', '.join([*given, *wanted, 'ptr %memory', 'ptr %cell'])})"
            packing = ""
            more = 0
        else:
            body, packing, more = _over_groups(function, lanes, members, batched, passed, made.memory)
        text = HANDLER.format(
            packing=packing,
            minor=MINOR,
            bytes=made.memory + more + ALIGNMENT,
            above=ALIGNMENT - 1,
            alignment=ALIGNMENT,
            columns="\n".join(columns),
            cell=made.cell.ctypes.data,
            body=body,
        )
        self._engine = loaded(object_code(text, 1 if members else 0))
        self._called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(self._engine.get_function_address("handler"))
        self.capsule = jax.ffi.pycapsule(self._called)


def _over_groups(function, lanes, members, batched, passed, memory):
    """A loop over groups of members, whose arrays become vectors, and back."""
    lines = [
        "br label %groups",
        "groups:",
        "%g = phi i64 [0, %execute], [%g1, %group]",
        f"%any = icmp slt i64 %g, {members}",
        "br i1 %any, label %group, label %end",
        "group:",
    ]
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
            f"call void @pack{size}(ptr %a{number}v, ptr %a{number}, i64 {buffer.size}, i64 %g, i64 {members - 1}, "
            f"i64 {stride})"
        )
        given.append(f"ptr %a{number}v")
    for number, buffer in enumerate(function.buffers):
        size = room(buffer, f"r{number}")
        given.append(f"ptr %r{number}v")
        after.append(
            f"call void @unpack{size}(ptr %r{number}, ptr %r{number}v, i64 {buffer.size}, i64 %g, i64 {members - 1})"
        )
    lines.append(f"call void %code({', '.join([*given, 'ptr %memory', 'ptr %cell'])})")
    lines += [*after, f"%g1 = add i64 %g, {lanes}", "br label %groups", "end:"]
    packing = "".join(PACKING.format(size=size, bits=8 * size, lanes=lanes) for size in sorted(sizes))
    return "\n".join(lines), packing, offset - memory
