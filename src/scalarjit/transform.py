"""Functions of arrays, compiled by LLVM, under JAX's transformations: a primitive."""

import itertools
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from scalarjit.arrays import NONE
from scalarjit.function import Function
from scalarjit.functions import function_of
from scalarjit.garbage import collected_later
from scalarjit.graph import constants, value_of
from scalarjit.known import Pattern
from scalarjit.parts import in_parts, is_compilable

try:
    from scalarjit import handlers
except (ImportError, OSError) as error:
    handlers = None
    warnings.warn(
        f"scalarjit: functions are left to XLA, as llvmlite does not load: {error}", RuntimeWarning, stacklevel=2
    )

LANES = 8  # members of a batch in one vector, at most
MOST_SOURCES = 4096  # functions that are found again where JAX has traced them

Known = tuple[Pattern | None, ...]
Moves = tuple[bool, ...]  # which arguments have a change


class Batch(NamedTuple):
    """How many members a batch has, and which arguments have one row for each."""

    members: int
    batched: tuple[bool, ...]


class Source:
    """What is compiled: a function that JAX traces; what has been made of it lives as long.

    - `trace`: gives it as JAX has traced it. A gradient asks for no change, only for what is pulled back.
    - `known`: of each argument a `Pattern` or None. `outs`: what is returned.
    - `change_of`: of which function this is the change, and which of its arguments move: it is linear in their changes.
    """

    def __init__(
        self,
        trace: Callable[[], ClosedJaxpr],
        known: Known,
        outs: Sequence[Any],
        change_of: "tuple[Source, Moves] | None" = None,
    ) -> None:
        self._trace, self.known, self.outs, self.change_of = trace, known, outs, change_of
        self._handlers: dict[Batch | None, str] = {}
        self._jitted: dict[Batch | None, Any] = {}
        self._changes: dict[Moves, Source] = {}
        self._pulled_back: dict[Moves, Source] = {}

    def __repr__(self) -> str:  # JAX prints parameters of primitives where it transforms them
        return f"<{len(self.outs)} results>"

    @cached_property
    def jaxpr(self) -> ClosedJaxpr:
        """The function as JAX has traced it."""
        with collected_later():
            return self._trace()

    @cached_property
    def function(self) -> Function:
        """What LLVM compiles."""
        known = itertools.zip_longest(self.known, self.jaxpr.in_avals)
        return function_of(self.jaxpr, [_constants(pattern, aval) for pattern, aval in known])

    def handler(self, batch: Batch | None) -> str:
        """The name by which JAX calls it."""
        if batch not in self._handlers:
            assert handlers is not None
            members, batched = batch or (None, ())
            lanes = min(LANES, 1 << ((members or 1) - 1).bit_length())
            handler = handlers.handler_of(self.function, lanes, members, batched)
            handler.register()
            self._handlers[batch] = handler.name
        return self._handlers[batch]

    def jitted(self, batch: Batch | None) -> Callable[..., list[Any]]:
        """A program of this alone."""
        if batch not in self._jitted:
            self._jitted[batch] = jax.jit(lambda *args: _bind(args, self, batch))
        return self._jitted[batch]

    def change(self, moves: Moves) -> "Source":
        """How what it returns changes, of its arguments and the changes of those that move."""
        if moves not in self._changes:
            trace = partial(_change, self.jaxpr, moves)
            self._changes[moves] = Source(trace, self.known, list(filter(_is_real, self.outs)), (self, moves))
        return self._changes[moves]

    def pulled_back(self, moves: Moves) -> "Source":
        """Cotangents of arguments that move, of all arguments and the cotangents of what it returns that is real."""
        if moves not in self._pulled_back:
            trace = partial(_pulled_back, self.jaxpr, moves)
            self._pulled_back[moves] = Source(trace, self.known, _moving(self.jaxpr.in_avals, moves))
        return self._pulled_back[moves]


@lru_cache(MOST_SOURCES)
def _source(jaxpr: ClosedJaxpr, known: Known) -> Source:
    return Source(lambda: jaxpr, known, jaxpr.out_avals)


def clear() -> None:
    _source.cache_clear()


scalarised_p = Primitive("scalarised")
scalarised_p.multiple_results = True


def compiled_by_llvm(function: Callable[..., Any], known: Callable[..., Any] = lambda *_: ()) -> Callable[..., Any]:
    """Compile a function of pytrees of arrays, which JAX traces once for each kind of arguments.

    **Arguments:** `known`: of the same arguments, a `Pattern` or None for each of their arrays.
    """
    traced = jax.jit(function)

    @wraps(function)
    def flat(*args: Any) -> Any:
        given = jax.tree.leaves(args)
        trace = traced.trace(*args)
        jaxpr = trace.jaxpr
        out = trace.out_info
        outside = []
        if len(jaxpr.jaxpr.invars) > len(given):  # numbers from outside that are traced, which JAX does not tell here
            jaxpr, out = jax.make_jaxpr(function, return_shape=True)(*args)
            jaxpr, outside = _with_constants_as_arguments(jaxpr)
        known_entries = (None,) * len(outside) + tuple(known(*args))
        # What is printed, or called back for more than its results, is left to XLA.
        compute = in_parts(jaxpr, known_entries, _bind_part) if jaxpr.effects else _bind_part(jaxpr, known_entries)
        found = compute(*outside, *map(jnp.asarray, given))
        return jax.tree.unflatten(jax.tree.structure(out), found)

    return flat


def _with_constants_as_arguments(closed: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    jaxpr = closed.jaxpr
    inner = jaxpr.replace(
        constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars], debug_info=jaxpr.debug_info.with_unknown_names()
    )
    return ClosedJaxpr(inner, []), list(closed.consts)


def _bind_part(part, known):
    source = _source(part, known)
    return lambda *args: _bind(args, source)


def _bind(args, source, batch=None):
    return scalarised_p.bind(*args, source=source, batch=batch)


def _constants(pattern, aval):
    if pattern is None:
        return None
    values = np.broadcast_to(pattern.values, aval.shape)
    return np.where(np.isnan(values), NONE, constants(values.astype(aval.dtype)))


@scalarised_p.def_impl
def _now(*args, source, batch):
    return source.jitted(batch)(*args)


@scalarised_p.def_abstract_eval
def _abstract(*avals, source, batch):
    return [aval.update(shape=(*_lead(batch), *aval.shape)) for aval in source.outs]


def _lead(batch):
    return () if batch is None else (batch.members,)


# Code.


@collected_later()
def _called(*args, source, batch):
    """A call of compiled code among XLA's operations."""
    if handlers is None:
        return _as_it_stands(*args, source=source, batch=batch)
    if not is_compilable(source.jaxpr.jaxpr):
        return _of_members(in_parts(source.jaxpr, source.known, _bind_part), args, batch)
    lead = _lead(batch)
    results = source.function.results
    written = [jax.ShapeDtypeStruct((*lead, *result.shape), result.dtype) for result in results if result.is_written]
    found = iter(jax.ffi.ffi_call(source.handler(batch), written)(*args)) if written else iter(())
    outs = []
    for result in results:
        if result.is_written:
            outs.append(next(found))
            continue
        values = args[result.argument] if result.argument is not None else _values(result)
        outs.append(jnp.broadcast_to(values, (*lead, *result.shape)))
    return outs


def _values(result):
    flat = [value_of(scalar) for scalar in result.known.ravel().tolist()]
    return np.array(flat, result.dtype).reshape(result.shape)


def _as_it_stands(*args, source, batch):
    return _of_members(jaxpr_as_fun(source.jaxpr), args, batch)


def _of_members(compute, args, batch):
    if batch is None:
        return compute(*args)
    axes = [0 if is_batched else None for is_batched in batch.batched]
    return jax.vmap(compute, axes, axis_size=batch.members)(*args)


mlir.register_lowering(scalarised_p, mlir.lower_fun(_as_it_stands, multiple_results=True))
mlir.register_lowering(scalarised_p, mlir.lower_fun(_called, multiple_results=True), platform="cpu")


# Batches.


def _batched(args, dims, *, source, batch):
    """Members of a batch of batches are members of one."""
    count = next(arg.shape[dim] for arg, dim in zip(args, dims, strict=True) if dim is not None)
    inner = batch or Batch(1, (False,) * len(args))
    rows = []
    for arg, dim, has_rows in zip(args, dims, inner.batched, strict=True):
        if dim is not None:
            arg = jnp.moveaxis(arg, dim, 0)
        elif has_rows:
            arg = jnp.broadcast_to(arg, (count, *arg.shape))
        if batch is not None and (dim is not None or has_rows):
            if not has_rows:
                arg = jnp.broadcast_to(arg[:, None], (count, inner.members, *arg.shape[1:]))
            arg = arg.reshape(count * inner.members, *arg.shape[2:])
        rows.append(arg)
    flags = tuple(dim is not None or has_rows for dim, has_rows in zip(dims, inner.batched, strict=True))
    found = _bind(rows, source, Batch(count * inner.members, flags))
    if batch is not None:
        found = [array.reshape(count, inner.members, *array.shape[1:]) for array in found]
    return found, [0] * len(found)


batching.primitive_batchers[scalarised_p] = _batched


# Derivatives.


def _change(jaxpr, moves):
    compute = jaxpr_as_fun(jaxpr)

    def change(args, changes):
        left = iter(changes)
        tangents = [next(left) if move else _no_change(arg) for arg, move in zip(args, moves, strict=True)]
        _, found = jax.jvp(compute, args, tangents)
        return [part for part, aval in zip(found, jaxpr.out_avals, strict=True) if _is_real(aval)]

    args = _shapes(jaxpr.in_avals)
    return jax.make_jaxpr(change)(args, _moving(args, moves))


def _pulled_back(jaxpr, moves):
    compute = jaxpr_as_fun(jaxpr)

    def pull(args, cotangents):
        def of_moving(*moving):
            left = iter(moving)
            found = compute(*[next(left) if move else arg for arg, move in zip(args, moves, strict=True)])
            return [part for part, aval in zip(found, jaxpr.out_avals, strict=True) if _is_real(aval)]

        _, back = jax.vjp(of_moving, *_moving(args, moves))
        return back(cotangents)

    return jax.make_jaxpr(pull)(_shapes(jaxpr.in_avals), _shapes(filter(_is_real, jaxpr.out_avals)))


def _moving(parts, moves):
    return [part for part, move in zip(parts, moves, strict=True) if move]


def _shapes(avals):
    return [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]


def _is_real(aval):
    return jnp.issubdtype(aval.dtype, jnp.inexact)


def _no_change(arg):
    return jnp.zeros_like(arg) if _is_real(arg) else np.zeros(arg.shape, jax.dtypes.float0)


def _jvp(args, tangents, *, source, batch):
    found = _bind(args, source, batch)
    moves = tuple(not isinstance(tangent, ad.Zero) for tangent in tangents)
    rows = None if batch is None else Batch(batch.members, (*batch.batched, *_moving(batch.batched, moves)))
    changed = iter(_bind([*args, *_moving(tangents, moves)], source.change(moves), rows))
    return found, [next(changed) if _is_real(out) else ad.Zero(jax.typeof(out).to_tangent_aval()) for out in found]


def _transpose(cotangents, *args, source, batch):
    of, moves = source.change_of
    given = args[: len(moves)]
    outs = [aval.update(shape=(*_lead(batch), *aval.shape)) for aval in source.outs]
    cotangents = [
        jnp.zeros(aval.shape, aval.dtype) if isinstance(cotangent, ad.Zero) else cotangent
        for cotangent, aval in zip(cotangents, outs, strict=True)
    ]
    pulled = of.pulled_back(moves)
    if batch is None:
        return [None] * len(given) + _bind([*given, *cotangents], pulled)
    batched = batch.batched[: len(given)]
    found = _bind([*given, *cotangents], pulled, Batch(batch.members, (*batched, *[True] * len(cotangents))))
    back = [
        array if is_batched else jnp.sum(array, axis=0)
        for array, is_batched in zip(found, _moving(batched, moves), strict=True)
    ]
    return [None] * len(given) + back


ad.primitive_jvps[scalarised_p] = _jvp
ad.primitive_transposes[scalarised_p] = _transpose
