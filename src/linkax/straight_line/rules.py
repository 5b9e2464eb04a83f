"""What operations of JAX do with arrays by their entries: arrays of the indices of scalars in a `Graph`.

Each rule takes (graph, parameters, arrays, shapes of the results), and returns the results. What has no rule, or needs
to know an index that is not known, raises `NotStraight`.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from linkax.straight_line.entries import Entries, NotStraight, each, known_entries
from linkax.straight_line.indexing import dynamic_slice, dynamic_update_slice, gather, scatter


def _each_of(name):
    """Rule for an operation on each entry that the graph folds by a method of its own."""
    return lambda graph, params, arrays, results: [each(getattr(graph, name), *arrays)]


def _other(name):
    """Rule for another operation on each entry."""

    def rule(graph, params, arrays, results):
        kept = tuple(sorted(params.items(), key=lambda item: item[0]))
        if name in _ACCURATE:
            kept = ()
        dtype = results[0].dtype
        return [each(lambda *operands: graph.of_known(name, operands, dtype, kept), *arrays)]

    return rule


def _compared(name):
    return lambda graph, params, arrays, results: [each(lambda a, b: graph.compare(name, a, b), *arrays)]


def _reduced(combine):
    def rule(graph, params, arrays, results):
        (array,), axes = arrays, params["axes"]
        rest = [axis for axis in range(array.ndim) if axis not in axes]
        summed = math.prod(array.shape[axis] for axis in axes)
        rows = np.transpose(array, [*rest, *axes]).reshape(results[0].size, summed)
        found = [combine(graph, row) for row in rows.tolist()]
        return [np.array(found, dtype=int).reshape(results[0].shape)]

    return rule


def _sum_of(graph, dtype, terms):
    found = graph.reduce(graph.add, [term for term in terms if not graph.is_zero(term)])
    return graph.known(0, dtype) if found is None else found


def _reduce_sum(graph, params, arrays, results):
    return _reduced(lambda graph, row: _sum_of(graph, results[0].dtype, row))(graph, params, arrays, results)


def _reduced_by(method, nothing):
    """Rule for a reduction by a method of the graph; `nothing`: of no terms, by type."""

    def combine(graph, dtype, row):
        found = graph.reduce(getattr(graph, method), row)
        return graph.known(nothing(dtype), dtype) if found is None else found

    def rule(graph, params, arrays, results):
        return _reduced(lambda graph, row: combine(graph, results[0].dtype, row))(graph, params, arrays, results)

    return rule


def _extreme(sign):
    """The largest number of a type, or the smallest."""
    return lambda dtype: (
        sign * np.inf if dtype.kind == "f" else (np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min)
    )


def _first_extreme(comparison):
    def rule(graph, params, arrays, results):
        (array,), (axis,) = arrays, params["axes"]
        dtype = results[0].dtype

        def first(row):
            best, place = row[0], graph.known(0, dtype)
            for k, entry in enumerate(row[1:], start=1):
                is_better = graph.compare(comparison, entry, best)
                best = graph.select(is_better, best, entry)
                place = graph.select(is_better, place, graph.known(k, dtype))
            return place

        rows = np.moveaxis(array, axis, -1).reshape(results[0].size, array.shape[axis]).tolist()
        return [np.array([first(row) for row in rows], dtype=int).reshape(results[0].shape)]

    return rule


def _dot_general(graph, params, arrays, results):
    (contracted, shared), left = params["dimension_numbers"], arrays[0]
    own = [
        [axis for axis in range(array.ndim) if axis not in (*c, *s)]
        for array, c, s in zip(arrays, contracted, shared, strict=True)
    ]
    batch, dtype = [left.shape[axis] for axis in shared[0]], results[0].dtype
    rows, columns = (
        np.transpose(array, [*s, *o, *c]).reshape(
            math.prod(batch), *(math.prod(array.shape[axis] for axis in part) for part in (o, c))
        )
        for array, s, o, c in zip(arrays, shared, own, contracted, strict=True)
    )

    def terms(array):
        """Of each row the entries that are not zero, and where they are."""
        return [
            [[(k, entry) for k, entry in enumerate(row) if not graph.is_zero(entry)] for row in part]
            for part in array.tolist()
        ]

    found = []
    for left_part, right_part in zip(terms(rows), terms(columns), strict=True):
        right_maps = [dict(row) for row in right_part]
        for row in left_part:
            for column in right_maps:
                products = [graph.mul(entry, column[k]) for k, entry in row if k in column]
                found.append(_sum_of(graph, dtype, products))
    return [np.array(found, dtype=int).reshape(results[0].shape)]


def _cross(graph, params, arrays, results):
    a, b = arrays
    product = lambda i, j: each(graph.mul, a[..., i], b[..., j])
    component = lambda i, j: each(graph.sub, product(i, j), product(j, i))
    return [np.stack([component(1, 2), component(2, 0), component(0, 1)], axis=-1)]


def _broadcast_in_dim(graph, params, arrays, results):
    array, shape = arrays[0], params["shape"]
    if len(arrays) > 1:
        raise NotStraight
    spread = [1] * len(shape)
    for axis, to in enumerate(params["broadcast_dimensions"]):
        spread[to] = array.shape[axis]
    return [np.broadcast_to(array.reshape(spread), shape)]


def _iota(graph, params, arrays, results):
    shape, axis = params["shape"], params["dimension"]
    along = np.arange(shape[axis]).reshape([-1 if k == axis else 1 for k in range(len(shape))])
    return [known_entries(graph, np.broadcast_to(along, shape).astype(params["dtype"]))]


def _slice(graph, params, arrays, results):
    strides = params["strides"] or [1] * arrays[0].ndim
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return [arrays[0][tuple(slice(*bound) for bound in bounds)]]


def _pad(graph, params, arrays, results):
    array, value = arrays
    found, places = np.full(results[0].shape, value.item(), dtype=int), []
    # Negative padding takes entries away.
    for (low, _, between), size, length in zip(params["padding_config"], array.shape, found.shape, strict=True):
        at = low + np.arange(size) * (between + 1)
        places.append((np.flatnonzero((at >= 0) & (at < length)), at[(at >= 0) & (at < length)]))
    found[np.ix_(*(at for _, at in places))] = array[np.ix_(*(of for of, _ in places))]
    return [found]


def _select_n(graph, params, arrays, results):
    which, *cases = arrays
    if len(cases) != 2:
        raise NotStraight
    if which.size and graph.dtypes[which.flat[0]].kind != "b":
        which = each(lambda index: graph.compare("ne", index, graph.known(0, graph.dtypes[index])), which)
    return [each(graph.select, which, *cases)]


def _clamp(graph, params, arrays, results):
    return [each(lambda low, x, high: graph.min(graph.max(x, low), high), *arrays)]


def _integer_pow(graph, params, arrays, results):
    return [each(lambda a: graph.power(a, params["y"]), arrays[0])]


def _convert(graph, params, arrays, results):
    return [each(lambda a: graph.convert(a, params["new_dtype"]), arrays[0])]


def _split(graph, params, arrays, results):
    return np.split(arrays[0], np.cumsum(params["sizes"])[:-1], params["axis"])


def _cumulative(combine):
    def rule(graph, params, arrays, results):
        axis = params["axis"]
        array = np.moveaxis(arrays[0], axis, -1)
        rows = array.reshape(math.prod(array.shape[:-1]), array.shape[-1]).tolist()
        found = []
        for row in rows:
            row = row[::-1] if params["reverse"] else row
            row = list(itertools.accumulate(row, lambda a, b: combine(graph, a, b)))
            found.append(row[::-1] if params["reverse"] else row)
        return [np.moveaxis(np.array(found, dtype=int).reshape(array.shape), -1, axis)]

    return rule


def _cholesky(graph, params, arrays, results):
    """L of a matrix L Lᵀ, of which the lower triangle is read."""
    array = arrays[0]
    if array.ndim != 2:
        raise NotStraight
    n, zero = len(array), graph.known(0, results[0].dtype)
    dtype = results[0].dtype
    lower = np.full((n, n), zero, dtype=int)
    for k in range(n):
        for i in range(k, n):
            rest = _sum_of(graph, dtype, [graph.mul(lower[i, j].item(), lower[k, j].item()) for j in range(k)])
            rest = graph.sub(array[i, k].item(), rest)
            lower[i, k] = graph.of_known("sqrt", (rest,), dtype) if i == k else graph.div(rest, lower[k, k].item())
    return [lower]


def _tile(graph, params, arrays, results):
    return [np.tile(arrays[0], params["reps"])]


def _unstack(graph, params, arrays, results):
    return [np.asarray(part) for part in np.moveaxis(arrays[0], params["axis"], 0)]


def _empty(graph, params, arrays, results):
    return [known_entries(graph, np.zeros(result.shape, result.dtype)) for result in results]


def _plain(function: Callable[[Any, Sequence[Entries]], Any]):
    """Rule for what only moves entries."""
    return lambda graph, params, arrays, results: [function(params, arrays)]


_ACCURATE = {"sin", "cos", "tan", "sqrt", "rsqrt", "exp", "log", "tanh", "logistic", "exp2", "log1p", "expm1", "cbrt"}
OTHERS = (
    *_ACCURATE,
    *("abs", "sign", "floor", "ceil", "is_finite", "atan2", "pow", "rem", "asin", "acos", "atan", "sinh", "cosh"),
    *("asinh", "acosh", "atanh", "erf", "erfc", "erf_inv", "lgamma", "digamma", "round", "nextafter", "xor"),
    *("shift_left", "shift_right_logical", "shift_right_arithmetic", "population_count", "clz"),
)
RULES: dict[str, Callable[..., list[Any]]] = {
    **{name: _other(name) for name in OTHERS},
    **{name: _each_of(name) for name in ("add", "sub", "mul", "div", "neg", "max", "min")},
    **{name: _compared(name) for name in ("lt", "le", "gt", "ge", "eq", "ne")},
    "add_any": _each_of("add"),
    "and": _each_of("logical_and"),
    "or": _each_of("logical_or"),
    "not": _each_of("logical_not"),
    "square": lambda graph, params, arrays, results: [each(lambda a: graph.mul(a, a), arrays[0])],
    "integer_pow": _integer_pow,
    "convert_element_type": _convert,
    "select_n": _select_n,
    "clamp": _clamp,
    "reduce_sum": _reduce_sum,
    "reduce_max": _reduced_by("max", _extreme(-1)),
    "reduce_min": _reduced_by("min", _extreme(1)),
    "reduce_and": _reduced_by("logical_and", lambda dtype: True),
    "reduce_or": _reduced_by("logical_or", lambda dtype: False),
    "reduce_prod": _reduced_by("mul", lambda dtype: 1),
    "argmax": _first_extreme("gt"),
    "argmin": _first_extreme("lt"),
    "dot_general": _dot_general,
    "cross": _cross,
    "cumsum": _cumulative(lambda graph, a, b: graph.add(a, b)),
    "cumprod": _cumulative(lambda graph, a, b: graph.mul(a, b)),
    "cummax": _cumulative(lambda graph, a, b: graph.max(a, b)),
    "cummin": _cumulative(lambda graph, a, b: graph.min(a, b)),
    "cholesky": _cholesky,
    "broadcast_in_dim": _broadcast_in_dim,
    "iota": _iota,
    "slice": _slice,
    "pad": _pad,
    "gather": gather,
    "scatter": scatter(lambda graph, old, new: new),
    "scatter-add": scatter(lambda graph, old, new: graph.add(old, new)),
    "scatter-mul": scatter(lambda graph, old, new: graph.mul(old, new)),
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "split": _split,
    "tile": _tile,
    "unstack": _unstack,
    "empty": _empty,
    "empty2": _empty,
    "concatenate": _plain(lambda params, arrays: np.concatenate(arrays, params["dimension"])),
    "stack": _plain(lambda params, arrays: np.stack(arrays, params.get("axis", params.get("dimension", 0)))),
    "transpose": _plain(lambda params, arrays: np.transpose(arrays[0], params["permutation"])),
    "reshape": _plain(lambda params, arrays: arrays[0].reshape(params["new_sizes"])),
    "squeeze": _plain(lambda params, arrays: np.squeeze(arrays[0], tuple(params["dimensions"]))),
    "expand_dims": _plain(lambda params, arrays: np.expand_dims(arrays[0], tuple(params["dimensions"]))),
    "rev": _plain(lambda params, arrays: np.flip(arrays[0], params["dimensions"])),
    **{
        name: (lambda graph, params, arrays, results: list(arrays))
        for name in ("stop_gradient", "copy", "copy_p", "optimization_barrier")
    },
}
