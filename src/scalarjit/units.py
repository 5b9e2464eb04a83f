"""Code without addresses, which another process may have too: of one function, or of all that it calls with it."""

import re
import threading
import weakref
from functools import cached_property

from scalarjit.compiler import digest
from scalarjit.emission import emitted
from scalarjit.function import Function
from scalarjit.memory import ALIGNMENT

SYMBOL = "scalars"
ON_STACK = 1 << 14  # bytes of a function's own memory: LLVM keeps in registers what is there, and stacks hold some MB
MOST_TOGETHER = 1_000_000  # characters of a function and all that it calls, up to which they are compiled as one
# As `emission` writes them.
HEAD = re.compile(r"define void (@\w+\(.*)ptr %memory, ptr %cell\) nounwind (.*\{\nentry:\n)")
LOOP_HEAD = re.compile(r"define void (@loop.*) nounwind (.*\{\n)")
CALL = re.compile(r"call void %\w+\((.*)\) ; callee (\d+)")
BEYOND = re.compile(r"^%beyond = getelementptr .*\n", re.MULTILINE)
COUNTED = re.compile(r"^store i64 %\w+, ptr %counter\n", re.MULTILINE)


class Unit:
    """Code of a function for a number of members at once.

    - `text`: of the module of the function; `loops`: of the module of its heavy loops, if there are any.
    - `callees`: what it calls, in the order of its cell; `memory`: bytes that it needs, with what it calls.
    - `key`: what tells it from others, by its text and what it calls.
    """

    def __init__(self, text: str, loops: str, own_memory: int, callees: "list[Unit]") -> None:
        self.text = text
        self.loops = loops
        self.callees = callees
        self._own_memory = own_memory
        self.memory = own_memory + max((each.memory for each in callees), default=0)
        self.key = digest(text, loops, *(each.key for each in callees))

    @cached_property
    def size(self) -> int:
        """Characters of its text, and those of all that it calls."""
        return sum(part.own_size for part in self.all_parts())

    @property
    def own_size(self) -> int:
        return len(self.text) + len(self.loops)

    def all_parts(self) -> "list[Unit]":
        """It, and all that it calls, each once."""
        found: dict[str, Unit] = {}
        waiting = [self]
        while waiting:
            part = waiting.pop()
            if part.key not in found:
                found[part.key] = part
                waiting += part.callees
        return list(found.values())

    @property
    def together(self) -> "list[Unit]":
        """What LLVM compiles with care as one module: it with all that it calls, or it alone where that is long.

        A run of the crank-slider takes 2.8 ms by code that was compiled at once, 2.1 by code that was compiled with
        care, function by function, and 1.1 by code that was compiled together. Where it is long it is little that is
        called for each operation: a row of 40 four-bars takes 35 ms function by function, 43 to 55 as one.
        """
        return self.all_parts() if self.size <= MOST_TOGETHER else [self]

    def text_together(self) -> str:
        """The text of that module: LLVM puts functions in place of calls, and nothing is counted any more."""
        declarations: set[str] = set()
        lines = []
        parts = self.together
        for part in parts:
            for line in self._with(part, len(parts) > 1).split("\n"):
                if not line.startswith("declare"):
                    lines.append(line)
                elif not line.startswith("declare void @loop"):  # which are here
                    declarations.add(line)
        return "\n".join([*sorted(declarations), *lines])

    def _with(self, part, calls_within):
        """The text of it or of what it calls in their module."""
        is_root = part is self
        text = COUNTED.sub("", f"{part.loops}\n{part.text}")
        if calls_within:
            text = CALL.sub(lambda call: f"call void @{SYMBOL}{part.callees[int(call[2])].key}({call[1]})", text)
        begins = "define void" if is_root else "define internal void"
        ends = "nounwind" if is_root else "nounwind alwaysinline"
        memory = "memory"
        room = ""
        if part._own_memory <= ON_STACK:
            memory = "beyond"
            room = f"%memory = alloca [{max(part._own_memory, 1)} x i8], align {ALIGNMENT}\n"
            text = BEYOND.sub("", text)
        text = HEAD.sub(rf"{begins} \1ptr %{memory}, ptr %cell) {ends} \2{room}", text)
        text = LOOP_HEAD.sub(r"define internal void \1 nounwind alwaysinline \2", text)
        # Names of what another text may have too.
        return text if is_root else re.sub(rf"(@\w*?\.?){SYMBOL}(?!\w)", rf"\1{SYMBOL}{part.key}", text)


_units: "weakref.WeakKeyDictionary[Function, dict[int, Unit]]" = weakref.WeakKeyDictionary()
_lock = threading.RLock()


def unit(function: Function, lanes: int) -> Unit:
    """Give the code of a function, which is written once."""
    with _lock:
        versions = _units.setdefault(function, {})
        if lanes not in versions:
            code = emitted(function.with_graph(), lanes, SYMBOL)
            function.let_go_of_graph()
            versions[lanes] = Unit(code.text, code.loops, code.own_memory, [unit(each, lanes) for each in code.callees])
        return versions[lanes]
