"""Arrays in memory: their addresses, and instructions that load, store and copy entries."""

from collections.abc import Callable, Sequence

import numpy as np

from scalarjit.graph import BOOL, Buffer, Copy, Graph, Store, value_of
from scalarjit.instructions import Instructions
from scalarjit.operations import memory_type
from scalarjit.writer import literal, mangled

ALIGNMENT = 64  # of arrays in memory, in bytes


class Memory(Instructions):
    """Arrays of a function: arguments, results, constants, and its own, one after another from %memory on."""

    def __init__(self, graph: Graph, lanes: int) -> None:
        super().__init__(graph, lanes)
        self.mask: str | None = None  # members that take a branch, or go on
        self.places: dict[Buffer, str] = {}
        self.constants: dict[Buffer, str] = {}
        self.own_memory = 0

    def place(self, buffer: Buffer) -> str:
        """The address of an array."""
        found = self.places.get(buffer)
        if found is not None:
            return found
        if buffer.kind == "constant":
            name = f"@c{len(self.constants)}"
            self.constants[buffer] = name
            self.places[buffer] = f"{name}@"
            return f"{name}@"
        offset = self.room(max(buffer.size, 1) * np.dtype(memory_dtype(buffer)).itemsize)
        self.places[buffer] = f"getelementptr:{offset}"
        return self.places[buffer]

    def room(self, size: int) -> int:
        """Take as many bytes of own memory for each member, and give where they begin."""
        offset = self.own_memory
        self.own_memory += -(-size * self.lanes // ALIGNMENT) * ALIGNMENT
        return offset

    def address(self, buffer: Buffer) -> str:
        place = self.place(buffer)
        if place.startswith("getelementptr:"):
            return self.value(f"getelementptr i8, ptr %memory, i64 {place[14:]}")
        return place

    def scaled(self, buffer: Buffer) -> int:
        return 1 if buffer.kind == "constant" else self.lanes

    def entry(self, buffer: Buffer, offset: int) -> str:
        """The address of an entry, or of its vector."""
        scale = self.scaled(buffer)
        kind = memory_type(buffer.dtype)
        place = self.place(buffer)
        if offset < 0 and place.startswith("getelementptr:"):
            size = np.dtype(memory_dtype(buffer)).itemsize
            return self.value(
                f"getelementptr i8, ptr %memory, i64 {int(place[14:]) + int(value_of(offset)) * scale * size}"
            )
        base = self.address(buffer)
        if offset < 0:
            return self.value(f"getelementptr {kind}, ptr {base}, i64 {int(value_of(offset)) * scale}")
        if self.is_uniform(offset):
            number = self.operand(offset)
            if scale > 1:
                number = self.value(f"mul i64 {number}, {scale}")
            return self.value(f"getelementptr {kind}, ptr {base}, i64 {number}")
        places = self.operand(offset)
        if scale > 1:
            steps = ", ".join(f"i64 {lane}" for lane in range(self.lanes))
            times = self.value(f"mul {self.vector('i64')} {places}, splat (i64 {scale})")
            places = self.value(f"add {self.vector('i64')} {times}, <{steps}>")
        return self.value(f"getelementptr {kind}, ptr {base}, {self.vector('i64')} {places}")

    def loaded(self, scalar: int) -> None:
        graph = self.graph
        _, buffer = graph.names[scalar]
        (offset,) = graph.operands[scalar]
        of = memory_type(buffer.dtype)
        address = self.entry(buffer, offset)
        gathers = not self.is_uniform(offset)
        if gathers:
            self.declared.add(
                f"declare {self.vector(of)} @llvm.masked.gather.v{self.lanes}{mangled(of)}.v{self.lanes}p0"
                f"({self.vector('ptr')}, i32, {self.vector('i1')}, {self.vector(of)})"
            )
            mask = f"{self.vector('i1')} splat (i1 true)"
            text = (
                f"call {self.vector(of)} @llvm.masked.gather.v{self.lanes}{mangled(of)}.v{self.lanes}p0"
                f"({self.vector('ptr')} {address}, i32 {_alignment(buffer)}, {mask}, {self.vector(of)} poison)"
            )
            kind = self.vector(of)
        else:
            kind = self.type(scalar).replace("i1", "i8") if buffer.dtype == BOOL else self.type(scalar)
            text = f"load {kind}, ptr {address}, align {_alignment(buffer)}"
        if buffer.dtype == BOOL:
            byte = self.value(text)
            zero = "zeroinitializer" if kind.startswith("<") else "0"
            self.line(f"%v{scalar} = icmp ne {kind} {byte}, {zero}")
        else:
            self.line(f"%v{scalar} = {text}")

    def stored(self, store: Store) -> None:
        buffer = store.buffer
        of = memory_type(buffer.dtype)
        one = self.lanes == 1
        kind = of if one else self.vector(of)
        value = self.operand(store.value, uniform=one)
        if buffer.dtype == BOOL:
            if store.value < 0:
                byte = "1" if value_of(store.value) else "0"
                value = byte if one else f"splat (i8 {byte})"
            else:
                value = self.value(f"zext {self.type(store.value, uniform=one)} {value} to {kind}")
        address = self.entry(buffer, store.offset)
        align = _alignment(buffer)
        if not self.is_uniform(store.offset):
            self.declared.add(
                f"declare void @llvm.masked.scatter.v{self.lanes}{mangled(of)}.v{self.lanes}p0"
                f"({kind}, {self.vector('ptr')}, i32, {self.vector('i1')})"
            )
            mask = self.mask if store.blended and self.mask else "splat (i1 true)"
            self.line(
                f"call void @llvm.masked.scatter.v{self.lanes}{mangled(of)}.v{self.lanes}p0"
                f"({kind} {value}, {self.vector('ptr')} {address}, i32 {align}, {self.vector('i1')} {mask})"
            )
            return
        if store.blended and self.mask:
            old = self.value(f"load {kind}, ptr {address}, align {align}")
            value = self.value(f"select {self.vector('i1')} {self.mask}, {kind} {value}, {kind} {old}")
        self.line(f"store {kind} {value}, ptr {address}, align {align}")

    def copied(self, copy: Copy) -> None:
        source = copy.source
        target = copy.target
        if source is target or not source.size:
            return
        if self.lanes > 1 and (source.kind == "constant" or (copy.blended and self.mask)):
            self.copied_by_vectors(copy)
            return
        size = source.size * np.dtype(memory_dtype(source)).itemsize * self.lanes
        self.declared.add("declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        to = self.address(target)
        from_ = self.address(source)
        self.line(f"call void @llvm.memcpy.p0.p0.i64(ptr {to}, ptr {from_}, i64 {size}, i1 false)")

    def copied_by_vectors(self, copy: Copy) -> None:
        of = memory_type(copy.source.dtype)
        vector = self.vector(of)
        to = self.address(copy.target)
        from_ = self.address(copy.source)
        align = _alignment(copy.source)

        index = f"%{self.label()}"

        def one() -> None:
            if copy.source.kind == "constant":
                address = self.value(f"getelementptr {of}, ptr {from_}, i64 {index}")
                new = self.splat(self.value(f"load {of}, ptr {address}, align {align}"), of)
            else:
                address = self.value(f"getelementptr {vector}, ptr {from_}, i64 {index}")
                new = self.value(f"load {vector}, ptr {address}, align {align}")
            target = self.value(f"getelementptr {vector}, ptr {to}, i64 {index}")
            if copy.blended and self.mask:
                old = self.value(f"load {vector}, ptr {target}, align {align}")
                new = self.value(f"select {self.vector('i1')} {self.mask}, {vector} {new}, {vector} {old}")
            self.line(f"store {vector} {new}, ptr {target}, align {align}")

        self.counted(copy.source.size, index, one)

    def counted(
        self, count: int, index: str, body: Callable[[], None], carried: Sequence[tuple[int, int, int]] = ()
    ) -> None:
        """A loop over 0, ..., count − 1. `carried`: as in `For`."""
        head = self.label()
        inner = self.label()
        after = self.label()
        firsts = [self.operand(first, uniform=self.lanes == 1) for _, first, _ in carried]
        before = self.body.block
        self.begin(head)
        at = len(self.body.lines)
        self.body.lines.extend([""] * (1 + len(carried)))
        test = self.value(f"icmp slt i64 {index}, {count}")
        self.begin(inner, after=f"br i1 {test}, label %{inner}, label %{after}")
        body()
        thens = [self.operand(then, uniform=self.lanes == 1) for _, _, then in carried]
        self.line(f"{index}n = add i64 {index}, 1")
        last = self.body.block
        self.body.lines[at] = f"{index} = phi i64 [0, %{before}], [{index}n, %{last}]"
        for number, ((scalar, _, _), first, then) in enumerate(zip(carried, firsts, thens, strict=True)):
            kind = self.type(scalar)
            self.body.lines[at + 1 + number] = f"%v{scalar} = phi {kind} [{first}, %{before}], [{then}, %{last}]"
        self.begin(after, after=f"br label %{head}")


def memory_dtype(buffer: Buffer) -> np.dtype:
    """How entries are kept: truth values as bytes."""
    return np.dtype(np.uint8) if buffer.dtype == BOOL else buffer.dtype


def _alignment(buffer):
    return memory_dtype(buffer).itemsize


def array_text(buffer: Buffer) -> str:
    """Constants in LLVM's language."""
    assert buffer.data is not None
    kind = memory_type(buffer.dtype)
    data = buffer.data.astype(memory_dtype(buffer))
    if not np.any(data.view(f"u{data.itemsize}")):
        return "zeroinitializer"
    return "[" + ", ".join(f"{kind} {literal(value)}" for value in data) + "]"
