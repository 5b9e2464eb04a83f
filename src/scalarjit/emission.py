"""From graphs to the text of LLVM's language, for one member or for the members of a batch in vectors.

A function has the signature (arguments..., results..., memory, cell): pointers to arrays, memory of its own and for
what it calls, and its cell: [address of its code, number of calls, cells of what it calls...]. It calls by way of
cells, so that better code can take a function's place while programs run, and so that its text is the same in each
process. At the end of such a call stands which function it calls: `units` writes those in its place.

Long code is cut into pieces, which are functions of their own. Loops that do many times what their text says are
pieces in a module of their own, which is compiled with more care at once: they are most of the work of large functions,
and little of their text.

In vectors each entry of an array takes as many places in memory as a vector has members, one after another. Constants
in memory, and what follows from them alone, are the same for all members and stay scalars.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scalarjit.function import Function
from scalarjit.graph import BOOL, Buffer, Call, Copy, For, If, Region, Store, While
from scalarjit.memory import Memory, array_text
from scalarjit.operations import memory_type
from scalarjit.pieces import pieces, used_scalars
from scalarjit.writer import Body

# Of functions. A stack that overflows is told by its guard page, as each page of a frame is touched: the frames of long
# code are larger than that page, and beyond it may lie the stack of another thread.
ATTRIBUTES = 'nounwind "probe-stack"="inline-asm"'
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
        self.expanded: dict[Buffer, Buffer] = {}  # constants as vectors, which each call writes anew
        self.callees: list[Function] = []
        self.used = used_scalars(function)
        self.pieces = pieces(function, self.used, lanes)
        self.functions: list[str] = []
        self.loops: list[str] = []
        self.loop_heads: list[str] = []
        self.parameters: list[str] = []
        self.slots: dict[int, int] = {}  # where scalars are that other pieces need

    def code(self) -> Code:
        function = self.function
        for number, buffer in enumerate(function.passed):
            self.places[buffer] = f"%a{number}"
            self.parameters.append(f"ptr noalias readonly %a{number}")
        for number, buffer in enumerate(function.buffers):
            self.places[buffer] = f"%r{number}"
            self.parameters.append(f"ptr noalias %r{number}")
        self.counts(1)
        self.region(function.graph.root)
        self.body.lines.append("ret void")
        entry = f"""%counter = getelementptr i64, ptr %cell, i64 1
%beyond = getelementptr i8, ptr %memory, i64 {self.own_memory}"""
        body = "\n".join(self.body.lines)
        parameters = ", ".join([*self.parameters, "ptr %memory", "ptr %cell"])
        own = f"define void @{self.symbol}({parameters}) {ATTRIBUTES} {{\nentry:\n{entry}\n{body}\n}}\n"
        text = self.module("\n".join([*self.loop_heads, *self.functions, own]), self.symbol)
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
        groups = self.pieces.groups.get(region)
        if groups is None:
            self.items(region.items)
            return
        for number, items in groups:
            self.apart(Body(number), lambda items=items: self.items(items))

    def items(self, items: list[Any]) -> None:
        for item in items:
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

    def apart(self, body: Body, write: Callable[[], None]) -> None:
        """Write a piece as a function, and call it."""
        outer = self.body
        self.body = body
        self.begin("begin")
        write()
        self.body = outer
        text = "\n".join(["entry:", *body.first, *body.lines, "ret void"])
        pointers = ["ptr noalias %memory", "ptr noalias %beyond", "ptr %cell", "ptr %counter"]
        parameters = [*self.parameters, *pointers]
        if self.mask:
            parameters.append(f"{self.vector('i1')} {self.mask}")
        name = f"@{'loop' if body.is_heavy else 'piece'}{body.piece}.{self.symbol}"
        head = f"void {name}({', '.join(parameters)})"
        if body.is_heavy:
            self.loop_heads.append(f"declare {head}")
            self.loops.append(f"define {head} {ATTRIBUTES} {{\n{text}\n}}\n")
        else:
            self.functions.append(f"define internal {head} noinline {ATTRIBUTES} {{\n{text}\n}}\n")
        given = ", ".join(each.replace("noalias ", "").replace("readonly ", "") for each in parameters)
        self.line(f"call void {name}({given})")

    def at_hand(self, scalar: int) -> str:
        """The name of a scalar, which is loaded where another piece has computed it."""
        body = self.body
        if self.pieces.home.get(scalar, 0) == body.piece:
            return f"%v{scalar}"
        block = "entry" if body.is_heavy else body.block  # before a loop, once
        name = body.loads.get((scalar, block))
        if name is None:
            name = body.loads[scalar, block] = f"%{self.label()}"
            kind = self.type(scalar)
            lines = body.first if body.is_heavy else body.lines
            lines.append(f"{name}p = getelementptr i8, ptr %memory, i64 {self.slots[scalar]}")
            if self.graph.dtype(scalar) == BOOL:
                byte = kind.replace("i1", "i8")
                lines += [f"{name}b = load {byte}, ptr {name}p", f"{name} = trunc {byte} {name}b to {kind}"]
            else:
                lines.append(f"{name} = load {kind}, ptr {name}p")
        return name

    def hand_on(self, scalar: int) -> None:
        """Store a scalar that other pieces need."""
        kind = self.type(scalar)
        value = f"%v{scalar}"
        if self.graph.dtype(scalar) == BOOL:
            byte = kind.replace("i1", "i8")
            value = self.value(f"zext {kind} {value} to {byte}")
            kind = byte
        if scalar not in self.slots:
            self.slots[scalar] = self.room(8)
        place = self.value(f"getelementptr i8, ptr %memory, i64 {self.slots[scalar]}")
        self.line(f"store {kind} {value}, ptr {place}")

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
        if scalar in self.pieces.crossing:
            self.hand_on(scalar)

    def for_(self, loop: For) -> None:
        number = self.pieces.heavy.get(loop)
        if number is not None:
            self.apart(Body(number, is_heavy=True), lambda: self.within(loop))
        else:
            self.within(loop)
            self.counts(loop.count)

    def within(self, loop: For) -> None:
        self.uniform.add(loop.index)
        carried = [each for each in loop.carried if each[0] in self.used]
        crossing = [each for each, _, _ in carried if each in self.pieces.crossing]

        def one() -> None:
            if not self.body.is_heavy:
                for scalar in crossing:
                    self.hand_on(scalar)
                if loop.index in self.pieces.crossing:
                    self.hand_on(loop.index)
            self.region(loop.region)

        self.counted(loop.count, f"%v{loop.index}", one, carried)
        for scalar in crossing:
            self.hand_on(scalar)

    def counts(self, number: int) -> None:
        """Count passes of loops as calls: what makes many of them is worth better code, but for those that have it."""
        if self.body.is_heavy:
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
