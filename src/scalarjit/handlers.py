"""What JAX calls: functions by XLA's interface for foreign functions, for one member or for a batch."""

import ctypes
import pickle
import threading
import zlib
from dataclasses import dataclass
from functools import cached_property

import jax

from scalarjit import packing
from scalarjit.compiler import AT_ONCE, digest, kept_or_compiled, loaded
from scalarjit.function import Function
from scalarjit.machine import compiled
from scalarjit.memory import ALIGNMENT
from scalarjit.units import Unit, unit

# Code is counted while it runs, and `cell` is null where it has been let go of; then `again` compiles it.
HANDLER = """
@cell = global ptr null
@running = global i64 0
@again = global ptr null
@packing = global ptr null
@no_code = constant [{no_code_length} x i8] c"{no_code}\\00"
@no_memory = constant [{no_memory_length} x i8] c"{no_memory}\\00"
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
%others = atomicrmw add ptr @running, i64 1 seq_cst
%kept = load atomic ptr, ptr @cell seq_cst, align 8
%is_kept = icmp ne ptr %kept, null
br i1 %is_kept, label %call, label %compile
compile:
%again = load ptr, ptr @again
call void %again()
%new = load atomic ptr, ptr @cell seq_cst, align 8
%is_new = icmp ne ptr %new, null
br i1 %is_new, label %call, label %fail
call:
%cell = phi ptr [%kept, %execute], [%new, %compile]
%given = getelementptr i8, ptr %frame, i64 72
%arguments = load ptr, ptr %given
%wanted = getelementptr i8, ptr %frame, i64 112
%results = load ptr, ptr %wanted
%raw = call ptr @malloc(i64 {bytes})
%is_room = icmp ne ptr %raw, null
br i1 %is_room, label %begin, label %fail
begin:
%number = ptrtoint ptr %raw to i64
%up = add i64 %number, {above}
%aligned = and i64 %up, -{alignment}
%memory = inttoptr i64 %aligned to ptr
{columns}
%code = load ptr, ptr %cell
{body}
call void @free(ptr %raw)
%other = atomicrmw sub ptr @running, i64 1 seq_cst
ret ptr null
fail:
%message = phi ptr [@no_code, %compile], [@no_memory, %call]
%less = atomicrmw sub ptr @running, i64 1 seq_cst
%error = alloca [4 x i64], align 8
store i64 28, ptr %error
%error1 = getelementptr i8, ptr %error, i64 8
store ptr null, ptr %error1
%error2 = getelementptr i8, ptr %error, i64 16
store ptr %message, ptr %error2
%error3 = getelementptr i8, ptr %error, i64 24
store i32 {exhausted}, ptr %error3
%apis = getelementptr i8, ptr %frame, i64 16
%api = load ptr, ptr %apis
%creates = getelementptr i8, ptr %api, i64 48
%create = load ptr, ptr %creates
%told_error = call ptr %create(ptr %error)
ret ptr %told_error
}}
"""
NO_CODE = "scalarjit: code that had been let go of does not compile again"
NO_MEMORY = "scalarjit: no memory is left for {bytes} bytes"
EXHAUSTED = 8  # XLA's number for resources that are used up
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
        with _lock:
            if self.name not in registered:
                registered[self.name] = Registered(self)
            registered[self.name].load(self)


class Registered:
    """What JAX calls by one name as long as the process lives.

    Its code is let go of by `clear`, and is compiled again where JAX calls it after that.
    """

    def __init__(self, handler: Handler) -> None:
        self._handler: Handler | bytes = handler
        self._engine = loaded(kept_or_compiled(handler.text, AT_ONCE))
        self._again = ctypes.CFUNCTYPE(None)(self.load)
        self._cell, self._running = map(self._number, ("cell", "running"))
        self._number("again").value = ctypes.cast(self._again, ctypes.c_void_p).value or 0
        self._number("packing").value = packing.table(handler.lanes, handler.sizes)
        self._called = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)(self._engine.get_function_address("handler"))
        jax.ffi.register_ffi_target(handler.name, jax.ffi.pycapsule(self._called), platform="cpu", api_version=1)

    def _number(self, name):
        return ctypes.c_int64.from_address(self._engine.get_global_value_address(name))

    @property
    def handler(self) -> Handler:
        if isinstance(self._handler, bytes):
            return pickle.loads(zlib.decompress(self._handler))
        return self._handler

    @property
    def has_code(self) -> bool:
        return bool(self._cell.value)

    def load(self, handler: Handler | None = None) -> None:
        """Have its code compiled, unless it is."""
        with _lock:
            if not self.has_code:
                self._handler = handler or self.handler
                self._code = compiled(self._handler.unit)
                self._cell.value = self._code.cell.ctypes.data

    def let_go(self) -> None:
        """Let go of its code, unless it runs; of its text, a sixth stays."""
        with _lock:
            if not isinstance(self._handler, bytes):
                self._handler = zlib.compress(pickle.dumps(self._handler), 1)
            cell = self._cell.value
            self._cell.value = 0
            with threading.Lock():  # a processor writes before it reads on
                if self._running.value:
                    self._cell.value = cell
                else:
                    self._code = None


registered: dict[str, Registered] = {}
_lock = threading.RLock()


def clear() -> None:
    """Let go of code that does not run."""
    for each in list(registered.values()):
        each.let_go()


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
    bytes = code.memory + more + ALIGNMENT
    no_memory = NO_MEMORY.format(bytes=bytes)
    text = HANDLER.format(
        no_code=NO_CODE,
        no_code_length=len(NO_CODE) + 1,
        no_memory=no_memory,
        no_memory_length=len(no_memory) + 1,
        exhausted=EXHAUSTED,
        minor=MINOR,
        bytes=bytes,
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
        "%g = phi i64 [0, %begin], [%g1, %group]",
        f"%any = icmp slt i64 %g, {members}",
        "br i1 %any, label %group, label %end",
        "group:",
    ]
    return "\n".join([*begin, *lines]), frozenset(sizes), offset - memory
