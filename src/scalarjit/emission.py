"""From graphs to the text of LLVM's language, for one member or for the members of a batch in vectors.

A function has the signature (arguments..., results..., memory, cell): pointers to arrays, memory of its own and for
what it calls, and its cell: [address of its code, number of calls, cells of what it calls...]. It calls by way of
cells, so that better code can take a function's place while programs run, and so that its text is the same in each
process. At the end of such a call stands which function it calls: `units` writes those in its place.

Loops that do many times what their text says are functions of a module of their own, which is compiled with more
care at once: they are most of the work of large functions, and little of their text.

In vectors each entry of an array takes as many places in memory as a vector has members, one after another. Constants
in memory, and what follows from them alone, are the same for all members and stay scalars.
"""

import re
from dataclasses import dataclass

from scalarjit.function import Function
from scalarjit.graph import Buffer, Call, Copy, For, If, Region, Store, While
from scalarjit.memory import Memory, array_text
from scalarjit.operations import memory_type
from scalarjit.weights import is_heavy, used_scalars

CALLEES = 2  # entries of a cell before those of what the function calls


@dataclass
class Code:
    """The text of a function, that of its heavy loops, the functions that it calls, and the memory of its own.

    - `callees`: in the order of its cell.
    """

    text: str
    loops: str
    callees: list[Function]
    own_memory: int


def emitted(function: Function, lanes: int, symbol: str) -> Code:
    """Write a function for a number of members at once."""
    return _Emission(function, lanes, symbol).code()


class _Emission(Memory):
    def __init__(self, function: Function, lanes: int, symbol: str) -> None:
        super().__init__(function.graph, lanes)
        self.function = function
        self.symbol = symbol
        self.expanded: dict[Buffer, Buffer] = {}  # constants as vectors
        self.callees: list[Function] = []
        self.used = used_scalars(function)
        self.is_apart = False  # in a loop of a module of its own
        self.loops: list[str] = []
        self.loop_heads: list[str] = []

    def code(self) -> Code:
        function = self.function
        parameters = []
        for number, buffer in enumerate(function.passed):
            self.places[buffer] = f"%a{number}"
            parameters.append(f"ptr noalias readonly %a{number}")
        for number, buffer in enumerate(function.buffers):
            self.places[buffer] = f"%r{number}"
            parameters.append(f"ptr noalias %r{number}")
        parameters += ["ptr %memory", "ptr %cell"]
        self.counts(1)
        self.region(function.graph.root)
        self.lines.append("ret void")
        entry = f"""%counter = getelementptr i64, ptr %cell, i64 1
%beyond = getelementptr i8, ptr %memory, i64 {self.own_memory}"""
        body = "\n".join(self.lines)
        own = f"define void @{self.symbol}({', '.join(parameters)}) nounwind {{\nentry:\n{entry}\n{body}\n}}\n"
        text = self.module("\n".join([*self.loop_heads, own]), self.symbol)
        loops = self.module("\n".join(self.loops), f"{self.symbol}.loops") if self.loops else ""
        return Code(text, loops, self.callees, self.own_memory)

    def module(self, functions: str, symbol: str) -> str:
        """The text of functions, with what they need."""
        named = set(re.findall(r"@c\d+(?=@)", functions))
        constants = "\n".join(
            f"{name}.{symbol} = private constant [{buffer.size} x {memory_type(buffer.dtype)}] {array_text(buffer)}"
            for buffer, name in self.constants.items()
            if name in named
        )
        declarations = "\n".join(sorted(self.declared))
        functions = re.sub(r"(@c\d+)@", rf"\1.{symbol}", functions)
        return f"{constants}\n{declarations}\n{functions}"

    def region(self, region: Region) -> None:
        expanded = self.expanded.copy()  # what is expanded in a branch is so there alone
        for item in region.items:
            if isinstance(item, int):
                if item in self.used:
                    self.scalar(item)
            elif isinstance(item, Store):
                self.stored(item)
            elif isinstance(item, Copy):
                self.copied(item)
            elif isinstance(item, For):
                self.for_(item)
            elif isinstance(item, While):
                self.while_(item)
            elif isinstance(item, If):
                self.if_(item)
            else:
                self.called(item)
        self.expanded = expanded

    def scalar(self, scalar: int) -> None:
        name = self.graph.names[scalar]
        if name in ("index", "carried"):  # written by loops
            return
        if isinstance(name, tuple) and name[0] == "load":
            if self.lanes > 1 and name[1].kind == "constant" and self.is_uniform(self.graph.operands[scalar][0]):
                self.uniform.add(scalar)
            self.loaded(scalar)
        else:
            self.operation(scalar)

    def for_(self, loop: For) -> None:
        if not self.is_apart and is_heavy(loop, self.used):
            self.apart(loop)
        else:
            self.within(loop)
            self.counts(loop.count)

    def within(self, loop: For) -> None:
        self.uniform.add(loop.index)
        self.counted(loop.count, f"%v{loop.index}", lambda: self.region(loop.region), self.carried(loop))

    def carried(self, loop: For) -> list[tuple[int, int, int]]:
        return [each for each in loop.carried if each[0] in self.used]

    def apart(self, loop: For) -> None:
        """Write a loop as a function, whose arguments are what it needs; what it carries it hands on in memory."""
        outer_lines = self.lines
        outer_block = self.block
        self.lines = []
        self.block = "entry"
        self.is_apart = True
        self.within(loop)
        handed_on = []
        for scalar, _, _ in self.carried(loop):
            place = f"getelementptr i8, ptr %memory, i64 {self.room(8)}"
            handed_on.append((scalar, place))
            self.line(f"store {self.type(scalar)} %v{scalar}, ptr {self.value(place)}")
        self.line("ret void")
        body = "\n".join(["entry:", *self.lines])
        self.is_apart = False
        self.lines = outer_lines
        self.block = outer_block
        names = set(re.findall(r"%\w+", body)) - set(re.findall(r"^(%\w+) =", body, re.MULTILINE))
        labels = {f"%{label}" for label in re.findall(r"^(\w+):", body, re.MULTILINE)}
        given = [(self.type_of(name), name) for name in sorted(names - labels)]
        name = f"@loop{len(self.loops)}.{self.symbol}"
        types = ", ".join(kind for kind, _ in given)
        parameters = ", ".join(f"{kind}{' noalias' if kind == 'ptr' else ''} {each}" for kind, each in given)
        self.loop_heads.append(f"declare void {name}({types})")
        self.loops.append(f"define void {name}({parameters}) nounwind {{\n{body}\n}}\n")
        self.line(f"call void {name}({', '.join(' '.join(each) for each in given)})")
        for scalar, place in handed_on:
            self.line(f"%v{scalar} = load {self.type(scalar)}, ptr {self.value(place)}")

    def type_of(self, name: str) -> str:
        """The type of what stands outside of a loop."""
        if name.startswith("%v"):
            return self.type(int(name[2:]))
        return self.vector("i1") if name == self.mask else "ptr"

    def counts(self, number: int) -> None:
        """Count passes of loops as calls: what makes many of them is worth better code, but for those that have it."""
        if self.is_apart:
            return
        calls = self.value("load i64, ptr %counter")
        self.line(f"store i64 {self.value(f'add i64 {calls}, {number}')}, ptr %counter")

    def while_(self, loop: While) -> None:
        head = self.label()
        inner = self.label()
        after = self.label()
        outer = self.mask
        self.begin(head)
        self.region(loop.test)
        taken = self.taken(loop.goes_on)
        self.begin(inner, after=f"br i1 {taken}, label %{inner}, label %{after}")
        self.region(loop.region)
        self.counts(1)
        self.begin(after, after=f"br label %{head}")
        self.mask = outer

    def if_(self, branch: If) -> None:
        inner = self.label()
        after = self.label()
        outer = self.mask
        taken = self.taken(branch.condition)
        self.begin(inner, after=f"br i1 {taken}, label %{inner}, label %{after}")
        self.region(branch.region)
        self.begin(after)
        self.mask = outer

    def taken(self, condition: int) -> str:
        """Whether any member takes a branch, which becomes the mask."""
        if self.is_uniform(condition):
            return self.operand(condition)
        mask = self.operand(condition, uniform=False)
        if self.mask:
            mask = self.value(f"and {self.vector('i1')} {mask}, {self.mask}")
        self.mask = mask
        self.declared.add(f"declare i1 @llvm.vector.reduce.or.v{self.lanes}i1({self.vector('i1')})")
        return self.value(f"call i1 @llvm.vector.reduce.or.v{self.lanes}i1({self.vector('i1')} {mask})")

    def called(self, call: Call) -> None:
        function = call.function
        if function not in self.callees:
            self.callees.append(function)
        addresses = []
        for buffer in call.arguments:
            if self.lanes > 1 and buffer.kind == "constant":
                if buffer not in self.expanded:
                    self.expanded[buffer] = Buffer(buffer.dtype, buffer.size)
                room = self.expanded[buffer]
                self.copied_by_vectors(Copy(room, buffer))
                buffer = room
            addresses.append(self.address(buffer))
        addresses += [self.address(buffer) for buffer in call.results]
        slot = self.value(f"getelementptr ptr, ptr %cell, i64 {CALLEES + self.callees.index(function)}")
        cell = self.value(f"load ptr, ptr {slot}")
        code = self.value(f"load ptr, ptr {cell}")
        given = ", ".join(f"ptr {address}" for address in [*addresses, "%beyond", cell])
        self.line(f"call void {code}({given}) ; callee {self.callees.index(function)}")
