"""Lines of LLVM's language: blocks, types and operands, of one member or of vectors of members."""

from dataclasses import dataclass, field

import numpy as np

from scalarjit.graph import BOOL, Graph, value_of
from scalarjit.operations import llvm_type

# Lines of a block. At level 0 LLVM selects instructions of a whole block the slow way, in a time that grows with the
# square of its length, from the first one that its quick way does not know.
BLOCK = 200


def literal(value: np.generic) -> str:
    """A constant in LLVM's language."""
    if value.dtype == BOOL:
        return "true" if value else "false"
    if value.dtype.kind == "f":
        return f"0x{np.float64(value).view(np.uint64):016X}"
    return str(int(value))


def mangled(kind: str) -> str:
    """A type in the name of a function of LLVM."""
    if kind.startswith("<"):
        count, of = kind[1:-1].split(" x ")
        return f"v{count}{mangled(of)}"
    return {"double": "f64", "float": "f32"}.get(kind, kind)


@dataclass
class Body:
    """What is written of one piece.

    - `is_heavy`: it is a loop of a module of its own.
    - `first`: lines before all others; `loads`: names of what other pieces have computed, by scalars and blocks.
    """

    piece: int = 0
    is_heavy: bool = False
    first: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    block: str = "entry"
    in_block: int = 0  # lines
    loads: dict[tuple[int, str], str] = field(default_factory=dict)


class Writer:
    """Lines of functions, of a number of members at once."""

    def __init__(self, graph: Graph, lanes: int) -> None:
        self.graph = graph
        self.lanes = lanes
        self.body = Body()
        self.declared: set[str] = set()
        self.uniform: set[int] = set()  # scalars that are the same for all members
        self._count = 0

    def line(self, text: str) -> None:
        self.body.lines.append(text)
        self.body.in_block += 1
        if self.body.in_block > BLOCK:
            self.begin(self.label())

    def value(self, text: str) -> str:
        self._count += 1
        name = f"%t{self._count}"
        self.line(f"{name} = {text}")
        return name

    def label(self) -> str:
        self._count += 1
        return f"b{self._count}"

    def begin(self, label: str, *, after: str | None = None) -> None:
        """Begin a block, to which the one before goes on, or ends with a line."""
        self.body.lines += [after or f"br label %{label}", f"{label}:"]
        self.body.block = label
        self.body.in_block = 0

    def is_uniform(self, scalar: int) -> bool:
        return self.lanes == 1 or scalar < 0 or scalar in self.uniform

    def vector(self, of: str) -> str:
        return f"<{self.lanes} x {of}>"

    def type(self, scalar: int, uniform: bool | None = None) -> str:
        of = llvm_type(self.graph.dtype(scalar))
        uniform = self.is_uniform(scalar) if uniform is None else uniform
        return of if uniform or self.lanes == 1 else self.vector(of)

    def operand(self, scalar: int, uniform: bool = True) -> str:
        """A scalar as an operand of an operation that is the same for all members, or differs."""
        if scalar < 0:
            text = literal(value_of(scalar))
            if uniform or self.lanes == 1:
                return text
            return f"splat ({llvm_type(self.graph.dtype(scalar))} {text})"
        if uniform or not self.is_uniform(scalar) or self.lanes == 1:
            return self.at_hand(scalar)
        return self.splat(self.at_hand(scalar), llvm_type(self.graph.dtype(scalar)))

    def at_hand(self, scalar: int) -> str:
        """The name of a scalar that is no constant."""
        return f"%v{scalar}"

    def splat(self, text: str, of: str) -> str:
        vector = self.vector(of)
        one = self.value(f"insertelement {vector} poison, {of} {text}, i64 0")
        return self.value(f"shufflevector {vector} {one}, {vector} poison, <{self.lanes} x i32> zeroinitializer")
