"""The walk through what JAX has traced: from equations on arrays to operations on scalars, loops, branches, calls."""

import math
from collections.abc import Callable
from typing import Any, cast

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from scalarjit.arrays import NONE, Array, Delayed, Entries, Stored, Updated, by_entry, every, known_of
from scalarjit.carried import Carried
from scalarjit.factorisations import FACTORISATIONS, traced
from scalarjit.function import Function
from scalarjit.graph import (
    BOOL,
    INDEX,
    Buffer,
    Call,
    For,
    Graph,
    If,
    Index,
    While,
    constant,
    constants,
    number_of,
    value_of,
)
from scalarjit.rules import RULES
from scalarjit.rules.rule import SMALL, Unsupported
from scalarjit.traced import (
    by_implementation,
    called_by,
    check,
    has_scalars,
    in_order,
    lengths_of_scan,
    num_equations,
    stays_as_it_is,
    uses_of,
)

FEW = 8  # equations of a function that is always computed in place
# The same of what a primitive is made of, such as that by which loops of Equinox keep a row of an array: a call of it
# would copy all rows, in each step of a run that keeps its steps.
FEW_OF_A_PRIMITIVE = 32
MOST_PASSES = 64  # of a scan that is written pass by pass
MOST_EQUATIONS = 400  # of such a scan


class Walk:
    """A walk through equations, which adds what they compute to a graph."""

    def __init__(self, graph: Graph, find: Callable[[ClosedJaxpr, list[Array]], Function]) -> None:
        self.graph = graph
        self._find = find

    def closed(self, closed: ClosedJaxpr, inputs: list[Array]) -> list[Array]:
        consts = [self._constant(value) for value in closed.consts]
        return self.equations(closed.jaxpr, consts, inputs)

    def _constant(self, value) -> Array:
        if not hasattr(value, "dtype"):
            value = np.asarray(value)
        if value.dtype == jax.dtypes.float0:  # the change of a whole number: there is none
            value = np.zeros(value.shape, bool)
        if not has_scalars(value.dtype):
            raise Unsupported(f"constants of {value.dtype}")
        value = np.asarray(value)
        return Entries(self.graph, constants(value), value.dtype)

    def equations(self, jaxpr: Jaxpr, consts: list[Array], inputs: list[Array]) -> list[Array]:
        """Walk through equations, and give the arrays that they return."""
        values: dict[Any, Array] = {}
        values.update(zip(jaxpr.constvars, consts, strict=True))
        values.update(zip(jaxpr.invars, inputs, strict=True))
        uses, last = uses_of(jaxpr)

        def read(atom):
            if isinstance(atom, Literal):
                return self._constant(np.asarray(atom.val, cast(Any, atom.aval).dtype))
            return values[atom]

        for number, equation in enumerate(jaxpr.eqns):
            found = self.equation(equation, [read(atom) for atom in equation.invars])
            for var, array in zip(equation.outvars, found, strict=True):
                # What is asked for more than once is computed once.
                if isinstance(array, Delayed) and not array.is_steady and uses.get(var, 0) > 1:
                    array = array.stored()
                values[var] = array
            for var in last.get(number, ()):
                del values[var]
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[Array]) -> list[Array]:
        name = equation.primitive.name
        params = equation.params
        for var in equation.outvars:
            check(var.aval)
        if name in CONTROL:
            return CONTROL[name](self, inputs, **params)
        if name in FACTORISATIONS:
            shapes = tuple((var.aval.shape, np.dtype(var.aval.dtype)) for var in equation.invars)
            return self.call(traced(name, shapes, tuple(params.items())), inputs)
        if closed := called_by(name, params):
            return self.call(closed, inputs)
        outs = [jax.ShapeDtypeStruct(var.aval.shape, np.dtype(var.aval.dtype)) for var in equation.outvars]
        if name in RULES:
            several = equation.primitive.multiple_results
            found = RULES[name](self.graph, name, outs if several else outs[0], inputs, **params)
            return list(found) if several else [found]
        closed = by_implementation(equation)
        short = num_equations(closed.jaxpr) <= FEW_OF_A_PRIMITIVE
        return self.closed(closed, inputs) if short else self.call(closed, inputs)

    def call(self, closed: ClosedJaxpr, inputs: list[Array]) -> list[Array]:
        """Compute a function in place where it is short, else call it."""
        if num_equations(closed.jaxpr) <= FEW or all(_all_constant(array) for array in inputs):
            return self.closed(closed, inputs)
        return self.called(self._find(closed, inputs), inputs)

    def called(self, function: Function, inputs: list[Array]) -> list[Array]:
        graph = self.graph
        arguments = [
            array.stored().buffer
            for array, buffer in zip(inputs, function.arguments, strict=True)
            if buffer is not None
        ]
        buffers = [Buffer(buffer.dtype, buffer.size) for buffer in function.buffers]
        graph.do(Call(function, arguments, buffers))
        left = iter(buffers)
        found: list[Array] = []
        for result in function.results:
            if result.argument is not None:
                found.append(inputs[result.argument])
            elif result.is_written:
                found.append(Stored(graph, result.shape, next(left), result.known))
            else:
                found.append(Entries(graph, result.known, result.dtype))
        return found

    # Branches.

    def cond(self, inputs: list[Array], *, branches: Any, **params: Any) -> list[Array]:
        graph = self.graph
        which, *inputs = inputs
        scalar = which.at(())
        if scalar < 0:
            number = min(max(int(value_of(scalar)), 0), len(branches) - 1)
            return self.call(branches[number], inputs)
        if which.dtype == BOOL:
            conditions = [graph.op("not", scalar), scalar]
        else:
            last = len(branches) - 1
            clamped = graph.op("max", graph.op("min", scalar, constant(last, which.dtype)), constant(0, which.dtype))
            conditions = [graph.op("eq", clamped, constant(number, which.dtype)) for number in range(len(branches))]
        regions = []
        found = []
        for branch in branches:
            with graph.inside() as region:
                regions.append(region)
                found.append(self.closed(branch, inputs))
        outputs = []
        for arrays in zip(*found, strict=True):
            if all(array is arrays[0] for array in arrays) and any(arrays[0] is given for given in inputs):
                outputs.append(arrays[0])
                continue
            known = _agreed(arrays)
            if known is not None and np.all(known != NONE):
                outputs.append(Entries(graph, known, arrays[0].dtype))
                continue
            buffer = Buffer(arrays[0].dtype, arrays[0].size)
            for region, array in zip(regions, arrays, strict=True):
                with graph.inside(region):
                    array.write(buffer, blended=True)
            outputs.append(Stored(graph, arrays[0].shape, buffer, known))
        for condition, region in zip(conditions, regions, strict=True):
            graph.do(If(condition, region))
        return outputs

    # Loops.

    def while_(
        self,
        inputs: list[Array],
        *,
        cond_jaxpr: ClosedJaxpr,
        body_jaxpr: ClosedJaxpr,
        cond_nconsts: int,
        body_nconsts: int,
    ) -> list[Array]:
        graph = self.graph
        of_test, of_body = inputs[:cond_nconsts], inputs[cond_nconsts : cond_nconsts + body_nconsts]
        init = inputs[cond_nconsts + body_nconsts :]
        stays = stays_as_it_is(body_jaxpr.jaxpr, body_nconsts, range(len(init)))

        def condition(carry):
            (going,) = self.closed(cond_jaxpr, [*of_test, *carry])
            return going

        def body(carry):
            found = self.closed(body_jaxpr, [*of_body, *carry])
            if not cond_jaxpr.out_avals[0].shape:
                return found
            # Of a batch of loops, each goes on by itself: what has ended stays.
            going = condition(carry)
            return [
                after if after is before else _where(going, after, before)
                for before, after in zip(carry, found, strict=True)
            ]

        carried = Carried(graph, init, stays)
        region = carried.settle(body)
        with graph.inside() as test:
            going = condition(carried.arrays())
            if going.shape:
                any_of = jax.ShapeDtypeStruct((), BOOL)
                going = RULES["reduce_or"](graph, "reduce_or", any_of, [going], axes=tuple(range(len(going.shape))))
            goes_on = going.at(())
        graph.do(While(test, goes_on, region))
        return carried.arrays()

    def scan(self, inputs: list[Array], **params: Any) -> list[Array]:
        return self._scan(inputs, params["jaxpr"], params["length"], params["reverse"], *lengths_of_scan(params))

    def _scan(
        self,
        inputs: list[Array],
        jaxpr: ClosedJaxpr,
        length: int,
        reverse: bool,
        num_consts: int,
        num_carry: int,
    ) -> list[Array]:
        graph = self.graph
        consts, init = inputs[:num_consts], inputs[num_consts : num_consts + num_carry]
        sequences = inputs[num_consts + num_carry :]
        outs = jaxpr.jaxpr.outvars[num_carry:]
        if length <= MOST_PASSES and length * num_equations(jaxpr.jaxpr) <= MOST_EQUATIONS:
            carry = init
            rows = []
            for number in range(length)[:: -1 if reverse else 1]:
                found = self.call(jaxpr, [*consts, *carry, *(_row(array, number) for array in sequences)])
                carry = found[:num_carry]
                rows.append(found[num_carry:])
            rows = rows[:: -1 if reverse else 1]
            stacked = [_stacked(graph, [row[k] for row in rows], outs[k].aval) for k in range(len(outs))]
            return [*carry, *stacked]
        buffers = [Buffer(np.dtype(out.aval.dtype), length * math.prod(out.aval.shape)) for out in outs]
        stays = stays_as_it_is(jaxpr.jaxpr, num_consts, range(num_carry))
        index: list[int] = []

        def body(carry):
            index[:] = [graph.new("index", (), INDEX)]
            number = number_of(graph, index[0])
            place = length - 1 - number if reverse else number
            found = self.closed(jaxpr, [*consts, *carry, *(_row(array, place) for array in sequences)])
            for buffer, array in zip(buffers, found[num_carry:], strict=True):
                whole = Stored(graph, (length, *array.shape), buffer)
                window = _reshaped(array, (1, *array.shape))
                Updated(whole, (place, *[0] * len(array.shape)), window).write_window(buffer, True)
            return found[:num_carry]

        carried = Carried(graph, init, stays)
        region = carried.settle(body)
        graph.do(For(length, index[0], region))
        found = [Stored(graph, (length, *out.aval.shape), buffer) for out, buffer in zip(outs, buffers, strict=True)]
        return [*carried.arrays(), *found]

    def members(self, inputs: list[Array], *, jaxpr: ClosedJaxpr, batch: Any, **params: Any) -> list[Array]:
        """A function that is compiled by itself elsewhere, of one member or of all of a batch, one after another."""
        if batch is None:
            return self.call(jaxpr, inputs)
        order = sorted(range(len(inputs)), key=batch.batched.__getitem__)
        given = [inputs[number] for number in order]
        return self._scan(
            given, in_order(jaxpr, tuple(order)), batch.members, False, batch.batched.count(False), num_carry=0
        )


def _agreed(arrays):
    """Constants that all branches return, and `NONE` in other places; None where there are no such arrays."""
    first, *others = map(known_of, arrays)
    if first is None or any(each is None for each in others):
        return None
    same = np.all([each == first for each in [first, *others]], axis=0) & (first < 0)
    return np.where(same, first, NONE)


def _where(condition: Array, yes: Array, no: Array) -> Array:
    """One of two arrays, by a condition of their first axes."""
    aligned = _reshaped(condition, (*condition.shape, *[1] * (len(yes.shape) - len(condition.shape))))
    return RULES["select_n"](yes.graph, "select_n", jax.ShapeDtypeStruct(yes.shape, yes.dtype), [aligned, no, yes])


def _row(array: Array, place: Any) -> Array:
    """A row of an array, at a place that may be found as the program runs."""
    graph = array.graph
    shape = array.shape[1:]
    if not isinstance(place, Index) and isinstance(array, Entries):
        return Entries(graph, array.ids[place], array.dtype)
    source = array.stored() if isinstance(array, Entries) else array.steady()

    def element(index):
        return source.at((place, *index))

    if math.prod(shape) <= SMALL and not isinstance(place, Index):
        return Entries(graph, element(every(shape)), array.dtype)
    if math.prod(shape) <= SMALL:
        ids = [element(index) for index in np.ndindex(*shape)]
        return Entries(graph, np.array(ids, np.int64).reshape(shape), array.dtype)
    return Delayed(graph, shape, array.dtype, by_entry(element), is_steady=True)


def _reshaped(array: Array, shape: tuple[int, ...]) -> Array:
    out = jax.ShapeDtypeStruct(shape, array.dtype)
    return RULES["reshape"](array.graph, "reshape", out, [array])


def _stacked(graph: Graph, rows: list[Array], aval: Any) -> Array:
    """Rows one below the other."""
    out = jax.ShapeDtypeStruct((len(rows), *aval.shape), np.dtype(aval.dtype))
    if math.prod(out.shape) == 0:
        return Entries(graph, np.zeros(out.shape, np.int64), out.dtype)
    return RULES["stack"](graph, "stack", out, rows, axis=0)


def _all_constant(array):
    return isinstance(array, Entries) and bool(np.all(array.ids < 0))


CONTROL = {"cond": Walk.cond, "while": Walk.while_, "scan": Walk.scan, "scalarised": Walk.members}
