"""Instructions of LLVM for operations on scalars."""

import numpy as np

from scalarjit.graph import BOOL, value_of
from scalarjit.operations import OPERATIONS, llvm_type
from scalarjit.writer import Writer, mangled


class Instructions(Writer):
    """Operations of a graph as instructions."""

    def operation(self, scalar: int) -> None:
        """Write the operation of a scalar."""
        graph = self.graph
        name = graph.names[scalar]
        operands = graph.operands[scalar]
        uniform = all(map(self.is_uniform, operands))
        if uniform and self.lanes > 1:
            self.uniform.add(scalar)
        result = self.type(scalar)
        kind = self.type(operands[-1], uniform)
        texts = [self.operand(operand, uniform or self.lanes == 1) for operand in operands]
        own = f"%v{scalar}"
        if isinstance(name, tuple):
            self.line(f"{own} = {self.converted(graph.dtype(operands[0]), name[1], kind, result, texts[0])}")
            return
        dtype = graph.dtype(operands[-1])
        known = OPERATIONS[name]
        how = known.of_real if dtype.kind == "f" else known.of_signed if dtype.kind == "i" else known.of_unsigned
        if how is None:
            getattr(self, f"_{name}")(own, kind, dtype, texts)
        elif how[0] == "@":
            self.line(f"{own} = {self.intrinsic(how[1:], kind, texts)}")
        elif how[0] == "!":
            self.of_c(own, how[1:], kind, dtype, texts)
        elif name in ("div", "rem") and dtype.kind != "f":
            self.whole_division(own, name, how, kind, operands, texts)
        elif name.startswith("shift"):
            self.shifted(own, how, kind, dtype, operands, texts)
        else:
            self.line(f"{own} = {how} {kind} {', '.join(texts)}")

    def intrinsic(self, name: str, kind: str, texts: list[str]) -> str:
        of = mangled(kind)
        given = ", ".join(f"{kind} {text}" for text in texts)
        self.declared.add(f"declare {kind} @llvm.{name}.{of}({', '.join([kind] * len(texts))})")
        return f"call {kind} @llvm.{name}.{of}({given})"

    def of_c(self, own: str, name: str, kind: str, dtype: np.dtype, texts: list[str]) -> None:
        """A function of C, of each member; in double precision, but for what that would round away."""
        single = dtype.itemsize == 4
        in_double = not (single and name == "nextafter")
        real = "double" if in_double else "float"
        name = name if in_double else f"{name}f"
        self.declared.add(f"declare {real} @{name}({', '.join([real] * len(texts))})")

        def one(texts: list[str]) -> str:
            if single and in_double:
                texts = [self.value(f"fpext float {text} to double") for text in texts]
            found = self.value(f"call {real} @{name}({', '.join(f'{real} {text}' for text in texts)})")
            return self.value(f"fptrunc double {found} to float") if single and in_double else found

        if not kind.startswith("<"):
            of = llvm_type(dtype)
            self.line(f"{own} = select i1 true, {of} {one(texts)}, {of} {texts[0]}")
            return
        of = llvm_type(dtype)
        vector = "poison"
        for lane in range(self.lanes):
            parts = [self.value(f"extractelement {kind} {text}, i64 {lane}") for text in texts]
            found = one(parts)
            if lane == self.lanes - 1:
                self.line(f"{own} = insertelement {kind} {vector}, {of} {found}, i64 {lane}")
            else:
                vector = self.value(f"insertelement {kind} {vector}, {of} {found}, i64 {lane}")

    def whole_division(self, own, name, how, kind, operands, texts) -> None:
        """As JAX has it, x / 0 = −1, x % 0 = x, and x / −1 = −x of the least x, too; processors stop."""
        signed = how[0] == "s"
        if operands[1] < 0 and value_of(operands[1]) not in ((0, -1) if signed else (0,)):
            self.line(f"{own} = {how} {kind} {', '.join(texts)}")
            return
        none = self.number(kind, 0)
        one = self.number(kind, 1)
        all_bits = self.number(kind, -1)
        bools = self.bools(kind)
        by_none = self.value(f"icmp eq {kind} {texts[1]}, {none}")
        safe = self.value(f"select {bools} {by_none}, {kind} {one}, {kind} {texts[1]}")
        if signed:
            by_minus_one = self.value(f"icmp eq {kind} {texts[1]}, {all_bits}")
            safe = self.value(f"select {bools} {by_minus_one}, {kind} {one}, {kind} {safe}")
        found = self.value(f"{how} {kind} {texts[0]}, {safe}")
        if signed and name == "div":
            minus = self.value(f"sub {kind} {none}, {texts[0]}")
            found = self.value(f"select {bools} {by_minus_one}, {kind} {minus}, {kind} {found}")
        other = all_bits if name == "div" else texts[0]
        self.line(f"{own} = select {bools} {by_none}, {kind} {other}, {kind} {found}")

    def shifted(self, own, how, kind, dtype, operands, texts) -> None:
        """As JAX has it, by as many places as there are, or more, nothing is left but the sign; LLVM leaves it open."""
        bits = 8 * dtype.itemsize
        if operands[1] < 0 and 0 <= int(value_of(operands[1])) < bits:
            self.line(f"{own} = {how} {kind} {', '.join(texts)}")
            return
        bools = self.bools(kind)
        none = self.number(kind, 0)
        within = self.value(f"icmp ult {kind} {texts[1]}, {self.number(kind, bits)}")
        places = self.value(f"select {bools} {within}, {kind} {texts[1]}, {kind} {none}")
        found = self.value(f"{how} {kind} {texts[0]}, {places}")
        sign = self.value(f"ashr {kind} {texts[0]}, {self.number(kind, bits - 1)}") if how == "ashr" else none
        self.line(f"{own} = select {bools} {within}, {kind} {found}, {kind} {sign}")

    def bools(self, kind: str) -> str:
        """The type of tests of a type."""
        return self.vector("i1") if kind.startswith("<") else "i1"

    @staticmethod
    def number(kind: str, value: int) -> str:
        if kind.startswith("<"):
            return f"splat ({kind[kind.index('x') + 2 : -1]} {value})"
        return str(value)

    def _neg(self, own, kind, dtype, texts) -> None:
        if dtype.kind == "f":
            self.line(f"{own} = fneg {kind} {texts[0]}")
        else:
            self.line(f"{own} = sub {kind} {self.number(kind, 0)}, {texts[0]}")

    def _abs(self, own, kind, dtype, texts) -> None:
        if dtype.kind == "f":
            self.line(f"{own} = {self.intrinsic('fabs', kind, texts)}")
        elif dtype.kind == "u":
            self.line(f"{own} = add {kind} {texts[0]}, {self.number(kind, 0)}")
        else:
            negative = self.value(f"sub {kind} {self.number(kind, 0)}, {texts[0]}")
            test = self.value(f"icmp slt {kind} {texts[0]}, {self.number(kind, 0)}")
            bools = self.bools(kind)
            self.line(f"{own} = select {bools} {test}, {kind} {negative}, {kind} {texts[0]}")

    def _not(self, own, kind, dtype, texts) -> None:
        ones = "true" if dtype == BOOL else "-1"
        ones = f"splat ({kind[kind.index('x') + 2 : -1]} {ones})" if kind.startswith("<") else ones
        self.line(f"{own} = xor {kind} {texts[0]}, {ones}")

    def _is_finite(self, own, kind, dtype, texts) -> None:
        difference = self.value(f"fsub {kind} {texts[0]}, {texts[0]}")
        zero = "zeroinitializer" if kind.startswith("<") else "0.0"
        self.line(f"{own} = fcmp oeq {kind} {difference}, {zero}")

    def _select(self, own, kind, dtype, texts) -> None:
        bools = self.bools(kind)
        self.line(f"{own} = select {bools} {texts[0]}, {kind} {texts[1]}, {kind} {texts[2]}")

    def _max(self, own, kind, dtype, texts, sign="gt") -> None:
        bools = self.bools(kind)
        if dtype.kind != "f":
            test = self.value(f"icmp {'s' if dtype.kind == 'i' else 'u'}{sign} {kind} {texts[0]}, {texts[1]}")
            self.line(f"{own} = select {bools} {test}, {kind} {texts[0]}, {kind} {texts[1]}")
            return
        test = self.value(f"fcmp u{sign} {kind} {texts[0]}, {texts[1]}")
        found = self.value(f"select {bools} {test}, {kind} {texts[0]}, {kind} {texts[1]}")
        is_nan = self.value(f"fcmp uno {kind} {texts[1]}, {texts[1]}")
        self.line(f"{own} = select {bools} {is_nan}, {kind} {texts[1]}, {kind} {found}")

    def _min(self, own, kind, dtype, texts) -> None:
        self._max(own, kind, dtype, texts, "lt")

    def converted(self, from_: np.dtype, to: np.dtype, kind: str, result: str, text: str) -> str:
        signed = from_.kind == "i"
        if from_.kind == "f" and to.kind == "f":
            return f"{'fpext' if to.itemsize > from_.itemsize else 'fptrunc'} {kind} {text} to {result}"
        if to.kind == "f":
            return f"{'sitofp' if signed else 'uitofp'} {kind} {text} to {result}"
        if from_.kind == "f":
            how = f"llvm.fpto{'s' if to.kind == 'i' else 'u'}i.sat.{mangled(result)}.{mangled(kind)}"
            self.declared.add(f"declare {result} @{how}({kind})")
            return f"call {result} @{how}({kind} {text})"
        if from_ == BOOL or to.itemsize > from_.itemsize:
            return f"{'sext' if signed else 'zext'} {kind} {text} to {result}"
        if to.itemsize < from_.itemsize:
            return f"trunc {kind} {text} to {result}"
        return f"add {kind} {text}, {self.number(kind, 0)}"
