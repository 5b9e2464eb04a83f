"""The decorator: functions of arrays, compiled by LLVM, under JAX's transformations."""

import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from scalarjit.arrays import NONE
from scalarjit.function import Function
from scalarjit.functions import function_of
from scalarjit.graph import constants, value_of
from scalarjit.parts import in_parts, is_compilable

try:
    from scalarjit.handlers import Handler
except (ImportError, OSError) as error:
    Handler = None
    warnings.warn(
        f"scalarjit: functions are left to XLA, as llvmlite does not load: {error}", RuntimeWarning, stacklevel=2
    )

LANES = 8  # members of a batch in one vector


class Batch(NamedTuple):
    """How many members a batch has, and which arguments have one row for each."""

    members: int
    batched: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class Derivative:
    """That a function is the change of another one, with those of its arguments that move: linear in their changes."""

    jaxpr: ClosedJaxpr
    moves: tuple[bool, ...]


scalarised_p = Primitive("scalarised")
scalarised_p.multiple_results = True


def scalarised(function: Callable[..., Any], known: Callable[..., Any] = lambda *_: ()) -> Callable[..., Any]:
    """Compile a function of arrays by LLVM.

    It computes what `jax.jit(function)` does, under JAX's transformations too. What it consists of is unrolled where
    that is short: constants fold, entries that are zero cost nothing, and equal ones are computed once.

    **Arguments:** `function`: of pytrees of arrays, that JAX can trace. `known`: of the same arguments, for each of
    their arrays the values that the program may take for granted, and NaN for others; or None.
    """
    traced = jax.jit(function)

    @wraps(function)
    def compute(*args: Any) -> Any:
        given = jax.tree.leaves(args)
        trace = traced.trace(*args)
        jaxpr = trace.jaxpr
        outside = []
        if len(jaxpr.in_avals) > len(given):  # numbers from around it that are traced, too, which JAX tells only here
            jaxpr, outside = _with_constants_as_arguments(jax.make_jaxpr(function)(*args))
        if jaxpr.effects:  # what is printed, or called back for more than its results
            return traced(*args)
        known_ = (None,) * len(outside) + _Known.of(known(*args))
        found = _bind([*outside, *map(jnp.asarray, given)], jaxpr, known_)
        return jax.tree.unflatten(jax.tree.structure(trace.out_info), found)

    return compute


def _with_constants_as_arguments(closed: ClosedJaxpr) -> tuple[ClosedJaxpr, list[Any]]:
    """A function whose constants come before its arguments, and these constants."""
    jaxpr = closed.jaxpr
    inner = jaxpr.replace(
        constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars], debug_info=jaxpr.debug_info.with_unknown_names()
    )
    return ClosedJaxpr(inner, ()), list(closed.consts)


def _bind(args, jaxpr, known=(), derivative=None, batch=None):
    return scalarised_p.bind(*args, jaxpr=jaxpr, known=known, derivative=derivative, batch=batch)


@dataclass(frozen=True)
class _Known:
    """What is known of an array: its values, NaN where they are not."""

    shape: tuple[int, ...]
    values: bytes

    @staticmethod
    def of(arrays: Any) -> tuple["_Known | None", ...]:
        return tuple(None if array is None else _Known(array.shape, array.tobytes()) for array in arrays)

    def constants(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        values = np.broadcast_to(np.frombuffer(self.values).reshape(self.shape), shape)
        return np.where(np.isnan(values), NONE, constants(values.astype(dtype)))


def _once(function):
    """Keep what a function made of a jaxpr, and of what else it takes."""
    made: dict[Any, Any] = {}

    @wraps(function)
    def find(jaxpr, *more):
        key = id(jaxpr), *more
        if key not in made:
            made[key] = jaxpr, function(jaxpr, *more)
        return made[key][1]

    return find


@scalarised_p.def_impl
def _now(*args, jaxpr, known, derivative, batch):
    return _jitted(jaxpr, known, derivative, batch)(*args)


@_once
def _jitted(jaxpr, known, derivative, batch):
    return jax.jit(lambda *args: _bind(args, jaxpr, known, derivative, batch))


@scalarised_p.def_abstract_eval
def _abstract(*avals, jaxpr, known, derivative, batch):
    assert len(avals) == len(jaxpr.in_avals)  # compiled code reads as many
    return [aval.update(shape=(*_lead(batch), *aval.shape)) for aval in jaxpr.out_avals]


def _lead(batch):
    return () if batch is None else (batch.members,)


# Code.

_names = itertools.count()
_kept: list[Any] = []  # handlers, which JAX's programs may call as long as the process lives


@_once
def _function(jaxpr: ClosedJaxpr, known: tuple[_Known | None, ...]) -> Function:
    """What LLVM compiles."""
    return function_of(
        jaxpr,
        [
            None if each is None else each.constants(aval.shape, np.dtype(aval.dtype))
            for each, aval in itertools.zip_longest(known, jaxpr.in_avals)
        ],
    )


@_once
def _handler(jaxpr: ClosedJaxpr, known: tuple[_Known | None, ...], batch: Batch | None) -> str:
    """The name by which JAX calls the function of a jaxpr."""
    function = _function(jaxpr, known)
    assert Handler is not None
    members, batched = batch or (None, ())
    handler = Handler(function, 1 if batch is None else LANES, members, batched)
    _kept.append(handler)
    name = f"scalarjit_{next(_names)}"
    jax.ffi.register_ffi_target(name, handler.capsule, platform="cpu", api_version=1)
    return name


def _called(*args, jaxpr, known, derivative, batch):
    """A call of compiled code among XLA's operations."""
    if Handler is None:
        return _as_it_stands(*args, jaxpr=jaxpr, known=known, derivative=derivative, batch=batch)
    if not is_compilable(jaxpr.jaxpr):
        compile = lambda part, known: lambda *args: _bind(args, part, known)
        return _of_members(in_parts(jaxpr, known, compile), args, batch)
    function = _function(jaxpr, known)
    lead = _lead(batch)
    written = [
        jax.ShapeDtypeStruct((*lead, *result.shape), result.dtype) for result in function.results if result.is_written
    ]
    found = iter(jax.ffi.ffi_call(_handler(jaxpr, known, batch), written)(*args)) if written else iter(())
    outs = []
    for result in function.results:
        if result.is_written:
            outs.append(next(found))
            continue
        values = args[result.argument] if result.argument is not None else _values(result)
        outs.append(jnp.broadcast_to(values, (*lead, *result.shape)))
    return outs


def _values(result):
    flat = [value_of(scalar) for scalar in result.known.ravel().tolist()]
    return np.array(flat, result.dtype).reshape(result.shape)


def _as_it_stands(*args, jaxpr, known, derivative, batch):
    return _of_members(jaxpr_as_fun(jaxpr), args, batch)


def _of_members(compute, args, batch):
    if batch is None:
        return compute(*args)
    axes = [0 if is_batched else None for is_batched in batch.batched]
    return jax.vmap(compute, axes, axis_size=batch.members)(*args)


mlir.register_lowering(scalarised_p, mlir.lower_fun(_as_it_stands, multiple_results=True))
mlir.register_lowering(scalarised_p, mlir.lower_fun(_called, multiple_results=True), platform="cpu")


# Batches.


def _batched(args, dims, *, jaxpr, known, derivative, batch):
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
    found = _bind(rows, jaxpr, known, derivative, Batch(count * inner.members, flags))
    if batch is not None:
        found = [array.reshape(count, inner.members, *array.shape[1:]) for array in found]
    return found, [0] * len(found)


batching.primitive_batchers[scalarised_p] = _batched


# Derivatives.


@_once
def _change_of(jaxpr: ClosedJaxpr, moves: tuple[bool, ...]) -> tuple[ClosedJaxpr, Derivative]:
    """How what a function returns changes, of its arguments and the changes of those that move."""
    compute = jaxpr_as_fun(jaxpr)

    def change(args, changes):
        left = iter(changes)
        tangents = [next(left) if move else _no_change(arg) for arg, move in zip(args, moves, strict=True)]
        _, found = jax.jvp(compute, args, tangents)
        return [part for part, aval in zip(found, jaxpr.out_avals, strict=True) if _is_real(aval)]

    args = _shapes(jaxpr.in_avals)
    return jax.make_jaxpr(change)(args, _moving(args, moves)), Derivative(jaxpr, moves)


@_once
def _pulled_back(jaxpr: ClosedJaxpr, moves: tuple[bool, ...]) -> ClosedJaxpr:
    """Cotangents of the arguments that move, of the arguments and the cotangents of what is real in what it returns."""
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


def _jvp(args, tangents, *, jaxpr, known, derivative, batch):
    found = _bind(args, jaxpr, known, derivative, batch)
    moves = tuple(not isinstance(tangent, ad.Zero) for tangent in tangents)
    change, of = _change_of(jaxpr, moves)
    rows = None if batch is None else Batch(batch.members, (*batch.batched, *_moving(batch.batched, moves)))
    changed = iter(_bind([*args, *_moving(tangents, moves)], change, known, of, rows))
    return found, [next(changed) if _is_real(out) else ad.Zero(jax.typeof(out).to_tangent_aval()) for out in found]


def _transpose(cotangents, *args, jaxpr, known, derivative, batch):
    given = args[: len(derivative.moves)]
    outs = [aval.update(shape=(*_lead(batch), *aval.shape)) for aval in derivative.jaxpr.out_avals if _is_real(aval)]
    cotangents = [
        jnp.zeros(aval.shape, aval.dtype) if isinstance(cotangent, ad.Zero) else cotangent
        for cotangent, aval in zip(cotangents, outs, strict=True)
    ]
    pulled = _pulled_back(derivative.jaxpr, derivative.moves)
    if batch is None:
        return [None] * len(given) + _bind([*given, *cotangents], pulled, known)
    batched = batch.batched[: len(given)]
    rows = Batch(batch.members, (*batched, *[True] * len(cotangents)))
    found = _bind([*given, *cotangents], pulled, known, None, rows)
    back = [
        array if is_batched else jnp.sum(array, axis=0)
        for array, is_batched in zip(found, _moving(batched, derivative.moves), strict=True)
    ]
    return [None] * len(given) + back


ad.primitive_jvps[scalarised_p] = _jvp
ad.primitive_transposes[scalarised_p] = _transpose
