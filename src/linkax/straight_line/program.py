"""A traced function as straight lines: kernels of scalar operations, and what stays on arrays between them."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from linkax.straight_line.entries import Entries, NotStraight, is_known, known_entries, values_of, where
from linkax.straight_line.graph import Graph
from linkax.straight_line.rules import RULES

Pattern = tuple[tuple[int, ...], bytes]  # shape, and the values that are known, NaN elsewhere, in double precision
MOST_PASSES = 64  # of a loop that is unrolled


class OnArrays(NamedTuple):
    """An operation that stays on arrays: traced, with what it reads and the scalars of what it returns."""

    traced: ClosedJaxpr
    reads: list[Entries]
    returns: list[Entries]


class Program(NamedTuple):
    """A function as scalars of a graph.

    - `inputs`, `outputs`: entries of the function's arguments and results. `between`: what stays on arrays, in order.
    """

    graph: Graph
    inputs: list[Entries]
    outputs: list[Entries]
    between: list[OnArrays]


def straighten(traced: ClosedJaxpr, known: Sequence[Pattern | None], most: int | None) -> Program:
    """Go through a traced function, entry by entry.

    **Arguments:** `known`: for each argument its entries that are known, or None. `most`: how many scalar operations
    there may be.

    **Raises:** `TooLong` for more operations.
    """
    graph = Graph(most)
    inputs = [
        _input(graph, variable.aval, pattern) for variable, pattern in zip(traced.jaxpr.invars, known, strict=True)
    ]
    walk = _Walk(graph)
    outputs = walk.closed(traced, inputs)
    return Program(graph, inputs, outputs, walk.between)


def _input(graph, aval, pattern=None) -> Entries:
    size = math.prod(aval.shape)
    values = [math.nan] * size if pattern is None else np.frombuffer(pattern[1]).tolist()
    entries = [graph.input(aval.dtype) if math.isnan(value) else graph.known(value, aval.dtype) for value in values]
    return np.array(entries, dtype=int).reshape(aval.shape)


def _pattern(graph, entries, is_batched) -> Pattern | None:
    """What is known of an array; of a batch, what is the same in all lanes."""
    first = entries[0] if is_batched else entries
    same = np.all(entries == first, axis=0) if is_batched else np.ones(first.shape, bool)
    values = [graph.values[index] if is_same else None for index, is_same in zip(first.flat, same.flat, strict=True)]
    values = [np.nan if value is None or value.dtype.kind != "f" else float(value) for value in values]
    return first.shape, np.array(values, float).tobytes()


class _Walk:
    """The way through a traced function; `between`: see `Program`."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.between: list[OnArrays] = []

    def closed(self, traced: ClosedJaxpr, arguments: Sequence[Entries]) -> list[Entries]:
        constants = [known_entries(self.graph, constant) for constant in traced.consts]
        return self.open(traced.jaxpr, constants, arguments)

    def open(self, traced: Jaxpr, constants: Sequence[Entries], arguments: Sequence[Entries]) -> list[Entries]:
        found: dict[Any, Entries] = dict(zip(traced.constvars, constants, strict=True))
        found.update(zip(traced.invars, arguments, strict=True))
        literal = lambda atom: known_entries(self.graph, np.asarray(atom.val, atom.aval.dtype))
        read = lambda atom: literal(atom) if isinstance(atom, Literal) else found[atom]
        for equation in traced.eqns:
            results = self.equation(traced, equation, [read(atom) for atom in equation.invars])
            found.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in traced.outvars]

    def equation(self, within: Jaxpr, equation: Any, arrays: list[Entries]) -> list[Entries]:
        begun = len(self.between)
        try:
            name, results = equation.primitive.name, [variable.aval for variable in equation.outvars]
            if name in RULES:
                return RULES[name](self.graph, equation.params, arrays, results)
            inside = getattr(self, f"_{name}", None)
            if inside is None:
                raise NotStraight
            return inside(equation.params, arrays)
        except NotStraight:
            del self.between[begun:]
            returns = [_input(self.graph, variable.aval) for variable in equation.outvars]
            variables = dict(
                (atom, entries)
                for atom, entries in zip(equation.invars, arrays, strict=True)
                if not isinstance(atom, Literal)
            )
            alone = within.replace(
                constvars=[],
                invars=list(variables),
                outvars=equation.outvars,
                eqns=[equation],
                debug_info=within.debug_info.with_unknown_names(),
            )
            self.between.append(OnArrays(ClosedJaxpr(alone, []), list(variables.values()), returns))
            return returns

    def _jit(self, params, arrays):
        return self.closed(params["jaxpr"], arrays)

    _pjit = _jit

    def _straight_line(self, params, arrays):
        if params["lanes"] is None:
            return self.closed(params["traced"].jaxpr, arrays)
        # Over lanes it stays one of its own, which knows what is the same in all of them.
        lanes, batched, graph = params["lanes"], params["batched"], self.graph
        patterns = [_pattern(graph, array, of_batch) for array, of_batch in zip(arrays, batched, strict=True)]
        traced = params["traced"].knowing(tuple(patterns))
        if traced.program is None:
            raise NotStraight
        over_lanes = traced.over_lanes(lanes, batched)
        returns = []
        for entries, aval in zip(traced.program.outputs, over_lanes.out_avals, strict=True):
            values = [traced.program.graph.values[index] for index in entries.ravel().tolist()]
            known = [None if value is None else graph.known(value, aval.dtype) for value in values]
            one = lambda known, aval=aval: [graph.input(aval.dtype) if index is None else index for index in known]
            returns.append(np.array([one(known) for _ in range(lanes)], dtype=int).reshape(aval.shape))
        self.between.append(OnArrays(over_lanes, arrays, returns))
        return returns

    def _closed_call(self, params, arrays):
        return self.closed(params["call_jaxpr"], arrays)

    def _remat2(self, params, arrays):
        return self.open(params["jaxpr"], [], arrays)

    _checkpoint = _remat2
    _custom_jvp_call = _closed_call
    _custom_vjp_call = _closed_call

    def _custom_vmap_call(self, params, arrays):
        return self.closed(params["call"], arrays)

    def _platform_index(self, params, arrays):
        # The branch for the CPU.
        platforms = params["platforms"]
        index = next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
        return [known_entries(self.graph, np.int32(index))]

    def _custom_linear_solve(self, params, arrays):
        lengths, parts = params["const_lengths"], params["jaxprs"]
        before = lengths.matvec + lengths.vecmat
        constants = arrays[before : before + lengths.solve]
        right = arrays[before + lengths.solve + lengths.transpose_solve :]
        return self.closed(parts.solve, [*constants, *right])

    def _cond(self, params, arrays):
        (index, *arguments), branches, graph = arrays, params["branches"], self.graph
        if is_known(graph, index):
            chosen = min(max(int(values_of(graph, index).item()), 0), len(branches) - 1)
            return self.closed(branches[chosen], arguments)
        found = self.closed(branches[0], arguments)
        for number, branch in enumerate(branches[1:], start=1):
            is_it = graph.compare("eq", index.item(), graph.known(number, graph.dtypes[index.item()]))
            taken = self.closed(branch, arguments)
            select = lambda old, new, is_it=is_it: where(graph, is_it, new, old)
            found = [select(old, new) for old, new in zip(found, taken, strict=True)]
        return found

    def _scan(self, params, arrays):
        if params["length"] > MOST_PASSES or _has_straight_lines(params["jaxpr"]):
            raise NotStraight
        first, carried = _lengths_of_scan(params)
        constants, carry, rows = arrays[:first], arrays[first : first + carried], arrays[first + carried :]
        made, order = [], range(params["length"])
        for k in reversed(order) if params["reverse"] else order:
            found = self.closed(params["jaxpr"], [*constants, *carry, *(np.asarray(row[k]) for row in rows)])
            carry = found[:carried]
            made.append(found[carried:])
        if params["reverse"]:
            made.reverse()
        if not made:
            raise NotStraight
        return [*carry, *(np.stack(parts) for parts in zip(*made, strict=True))]

    def _while(self, params, arrays):
        """Unroll a loop whose condition is known."""
        if _has_straight_lines(params["body_jaxpr"]):
            raise NotStraight
        for_condition, for_body = params["cond_nconsts"], params["body_nconsts"]
        condition = arrays[:for_condition]
        body, carry = arrays[for_condition : for_condition + for_body], arrays[for_condition + for_body :]
        for _ in range(MOST_PASSES):
            (goes_on,) = self.closed(params["cond_jaxpr"], [*condition, *carry])
            if not is_known(self.graph, goes_on):
                raise NotStraight
            if not values_of(self.graph, goes_on).item():
                return carry
            carry = self.closed(params["body_jaxpr"], [*body, *carry])
        raise NotStraight


def _has_straight_lines(traced: ClosedJaxpr | Jaxpr) -> bool:
    """Whether a loop goes around straight lines: it stays one."""
    inside = lambda value: [part for part in jax.tree.leaves(value) if isinstance(part, ClosedJaxpr | Jaxpr)]
    return any(
        equation.primitive.name == "straight_line"
        or any(map(_has_straight_lines, inside(list(equation.params.values()))))
        for equation in traced.eqns
    )


def _lengths_of_scan(params) -> tuple[int, int]:
    """How many constants and how many carried arrays a scan has; JAX 0.12 says so in another way."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    parts = [0 if part is None else len(part) for part in params["ft_in"].unpack()]
    return parts[0], parts[1]
