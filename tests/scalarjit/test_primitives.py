"""What each primitive computes: of few numbers, which are written one by one, and of many, in loops over memory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import agrees, numbers
from jax import lax

from scalarjit import scalarised

FEW, MANY = (3, 4), (40, 30)
OF_ONE = {
    "neg": jnp.negative,
    "sign": jnp.sign,
    "abs": jnp.abs,
    "floor": jnp.floor,
    "ceil": jnp.ceil,
    "round": jnp.round,
    "round_away": lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO),
    "sin": jnp.sin,
    "cos": jnp.cos,
    "tan": jnp.tan,
    "asin": lambda x: jnp.arcsin(x / 9),
    "acos": lambda x: jnp.arccos(x / 9),
    "atan": jnp.arctan,
    "sinh": jnp.sinh,
    "cosh": jnp.cosh,
    "tanh": jnp.tanh,
    "asinh": jnp.arcsinh,
    "acosh": lambda x: jnp.arccosh(x + 9),
    "atanh": lambda x: jnp.arctanh(x / 9),
    "exp": jnp.exp,
    "exp2": jnp.exp2,
    "log": lambda x: jnp.log(x + 9),
    "log1p": lambda x: jnp.log1p(x / 9),
    "expm1": jnp.expm1,
    "cbrt": jnp.cbrt,
    "sqrt": lambda x: jnp.sqrt(x + 9),
    "rsqrt": lambda x: lax.rsqrt(x + 9),
    "logistic": jax.nn.sigmoid,
    "erf": lax.erf,
    "square": jnp.square,
    "cube": lambda x: x**3,
    "inverse_square": lambda x: x**-2,
    "power": lambda x: jnp.power(x + 9, 0.3),
    "is_finite": lambda x: jnp.isfinite(jnp.where(x > 1, jnp.inf, x)),
    "to_int": lambda x: (9 * x).astype(int),
    "to_int32": lambda x: (9 * x).astype(jnp.int32),
    "to_bool": lambda x: x.astype(bool),
    "to_unsigned": lambda x: (9 * jnp.abs(x)).astype(jnp.uint32),
    "to_single": lambda x: x.astype(jnp.float32),
    "clamp": lambda x: jnp.clip(x, -0.5, 0.7),
    "not": lambda x: ~(x > 0),
    "nan_to_num": jnp.nan_to_num,
    "sums": lambda x: (jnp.sum(x), jnp.sum(x, 0), jnp.sum(x, 1), jnp.mean(x, axis=(0, 1))),
    "products": lambda x: (jnp.prod(x / 2, 0), jnp.max(x, 1), jnp.min(x, 0), jnp.any(x > 2, 1), jnp.all(x > -2, 0)),
    "arguments": lambda x: (jnp.argmax(x, 0), jnp.argmin(x, 1), jnp.argmax(x)),
    "of_nan": lambda x: (jnp.max(jnp.where(x > 1, jnp.nan, x), 1), jnp.argmax(jnp.where(x > 1, jnp.nan, x), 1)),
    "cumulated": lambda x: (jnp.cumsum(x, 0), jnp.cumprod(x / 2, 1), lax.cummax(x, 1, reverse=True), lax.cummin(x)),
    "sorted": lambda x: (jnp.sort(x, 1), jnp.argsort(x, 0), jnp.sort(jnp.where(x > 1, jnp.nan, x))),
    "by_two_keys": lambda x: lax.sort((jnp.round(x), x, x + 1), num_keys=2, dimension=0),
    "transposed": lambda x: x.T + 1,
    "reshaped": lambda x: (x.reshape(2, -1), x.ravel() * 2, x[None, :, None]),
    "sliced": lambda x: (x[1:, ::2], x[-1], x[:, ::-1] + 0, jnp.flip(x)),
    "split": lambda x: jnp.split(x, [1, 2]),
    "padded": lambda x: (jnp.pad(x, ((1, 2), (0, 3))), lax.pad(x, 5.0, [(-1, 1, 2), (2, -1, 0)])),
    "joined": lambda x: (
        jnp.concatenate([x, 2 * x, x[:1]]),
        jnp.stack([x, x + 1], 1),
        jnp.hstack([x, jnp.ones((len(x), 2))]),
    ),
    "repeated": lambda x: (
        jnp.tile(x, (2, 3)),
        jnp.broadcast_to(x[:, None], (len(x), 2, x.shape[1])),
        jnp.repeat(x, 2, 0),
    ),
    "counted": lambda x: jnp.arange(x.shape[1]) * x + jnp.eye(*x.shape),
    "triangles": lambda x: (jnp.tril(x), jnp.diagonal(x)),
    "products_of_matrices": lambda x: (
        x @ x.T,
        x.T @ x,
        x @ x[0],
        jnp.einsum("ij,kj->ik", x, x),
        jnp.outer(x[0], x[1]),
    ),
    "batches_of_matrices": lambda x: jnp.einsum(
        "bij,bjk->bik", x[:, :, None] * x[:, None], x[:, None] + jnp.ones((1, x.shape[1], 1))
    ),
    "sparse": lambda x: (jnp.diag(x[0]) @ jnp.eye(x.shape[1], 5)) + 0 * x[0][:, None],
    "cross": lambda x: jnp.cross(x[:, :3], x[:, 1:4]),
    "selected": lambda x: jnp.select([x > 1, x > 0], [x, 2 * x], -x),
    "norm": lambda x: jnp.linalg.norm(x, axis=1),
    "chosen": lambda x: lax.select_n(jnp.argmax(x[0]) % 3, x, x + 1, x + 2),
}
OF_TWO = {
    "add": jnp.add,
    "sub": jnp.subtract,
    "mul": jnp.multiply,
    "div": jnp.divide,
    "max": jnp.maximum,
    "min": jnp.minimum,
    "atan2": jnp.arctan2,
    "rem": lax.rem,
    "mod": jnp.mod,
    "eq": jnp.equal,
    "ne": jnp.not_equal,
    "lt": jnp.less,
    "le": jnp.less_equal,
    "gt": jnp.greater,
    "ge": jnp.greater_equal,
    "pow": lambda x, y: jnp.power(jnp.abs(x), y),
    "nextafter": jnp.nextafter,
    "hypot": jnp.hypot,
    "xor": lambda x, y: (x > 0) ^ (y > 0),
    "broadcast": lambda x, y: x[:1] * y - x[:, :1],
    "where": lambda x, y: jnp.where(x > y, x, y * 2),
}
WHOLE = {
    "add": lambda x, y: x + y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: lax.div(x, y),
    "rem": lambda x, y: lax.rem(x, y),
    "floor_div": lambda x, y: x // (y * y + 1),
    "and": lambda x, y: x & y,
    "or": lambda x, y: x | y,
    "xor": lambda x, y: x ^ y,
    "not": lambda x, y: ~x,
    "shift": lambda x, y: (x << (y & 7)) + (x >> (y & 3)),
    "logical_shift": lambda x, y: lax.shift_right_logical(x, y & 7),
    "abs": lambda x, y: (abs(x), jnp.sign(y)),
    "compare": lambda x, y: (x < y, x == y, jnp.maximum(x, y)),
    "float": lambda x, y: x.astype(float) / 3 + y,
}


@pytest.mark.parametrize("shape", [FEW, MANY])
@pytest.mark.parametrize("name", OF_ONE)
def test_functions_of_one_array(name, shape):
    agrees(OF_ONE[name], numbers(*shape))


@pytest.mark.parametrize("shape", [FEW, MANY])
@pytest.mark.parametrize("name", OF_TWO)
def test_functions_of_two_arrays(name, shape):
    agrees(OF_TWO[name], numbers(*shape), numbers(*shape, seed=1))


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32])
@pytest.mark.parametrize("name", WHOLE)
def test_whole_numbers(name, dtype):
    for shape in FEW, MANY:
        one, other = (np.abs(9 * numbers(*shape, seed=seed)).astype(dtype) for seed in (0, 1))
        if dtype != np.uint32:
            one = one - dtype(4)
        agrees(WHOLE[name], one, other)


ENDS = {
    "div": lax.div,
    "rem": lax.rem,
    "shift_left": lax.shift_left,
    "shift_right": lax.shift_right_arithmetic,
    "logical_shift": lax.shift_right_logical,
}


@pytest.mark.parametrize("dtype", [np.int8, np.int64, np.uint32])
@pytest.mark.parametrize("name", ENDS)
def test_whole_numbers_at_their_ends(name, dtype):
    """The least one by −1, at which processors stop, quotients that reals would round, shifts by all bits and more."""
    ends = np.iinfo(dtype)
    ones = np.array([ends.min, ends.max, ends.max - 1, 5, 0], dtype).repeat(8)
    others = np.tile(np.array([-1, 0, 1, 3, 7, 8, 63, 64]).astype(dtype), 5)
    agrees(ENDS[name], ones, others)
    agrees(jax.vmap(ENDS[name]), ones, others)
    # Of constants, too; XLA ends the process where it computes some of these before a program runs.
    found = scalarised(lambda zero: ENDS[name](jnp.asarray(ones), jnp.asarray(others)) + zero)(np.zeros(40, dtype))
    np.testing.assert_array_equal(found, jax.jit(ENDS[name])(ones, others))


def test_the_next_number_in_single_precision():
    one, other = (numbers(*FEW, seed=seed, dtype=np.float32) for seed in (0, 1))
    agrees(jnp.nextafter, one, other, rtol=0.0, atol=0.0)
    agrees(jax.vmap(jnp.nextafter), one, other, rtol=0.0, atol=0.0)


def test_poles_of_constants():
    agrees(lambda x: x + lax.lgamma(jnp.array([0.0, -1.0, 1e306])), np.ones(3))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("method", ["scan", "scan_unrolled", "sort", "compare_all"])
def test_searches(method, side):
    """Among numbers, and zeros with a sign, infinities and what is no number."""
    ends = np.array([-np.inf, -1.0, -0.0, 0.0, 1.0, np.inf, np.nan])
    agrees(lambda found, x: jnp.searchsorted(found, x, side=side, method=method), ends, ends)
    agrees(lambda found, x: jnp.searchsorted(found, x, side=side, method=method), np.arange(5), np.arange(9) - 2)


def test_sorting_puts_numbers_that_are_none_last():
    agrees(lambda x: jnp.sort(x), np.array([np.nan, 1.0, -np.inf, -np.nan, 0.0, np.inf, -0.0]))


@pytest.mark.parametrize("name", ["sin", "products_of_matrices", "sorted", "clamp", "to_int", "sums"])
def test_single_precision(name):
    for shape in FEW, MANY:
        agrees(OF_ONE[name], numbers(*shape, dtype=np.float32))


@pytest.mark.parametrize("count", [1, 3, 30])
def test_factorisations(count):
    matrix, right = numbers(count, count), numbers(count, 2, seed=1)
    positive = matrix @ matrix.T + np.eye(count)
    solve = lambda **how: lambda a, b: jax.scipy.linalg.solve_triangular(a, b, **how)
    agrees(jnp.linalg.cholesky, positive)
    agrees(jnp.linalg.solve, matrix, right, rtol=1e-8)
    agrees(lambda a: (jnp.linalg.det(a), jnp.linalg.inv(a)), matrix / 3, rtol=1e-8)
    for how in ({"lower": True}, {"lower": False}, {"trans": 1}, {"lower": True, "trans": 1, "unit_diagonal": True}):
        agrees(solve(**how), positive, right)
    agrees(jax.vmap(jnp.linalg.cholesky), np.stack([positive, positive + 1]))
    assert np.all(np.isnan(jnp.tril(jax.jit(jnp.linalg.cholesky)(-positive))[-1, -1]))
    agrees(lambda a: jnp.diagonal(jnp.linalg.cholesky(a))[-1], -positive)


INDICES = np.array([2, 0, -1, 7, 2])


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("shape", [FEW, MANY])
def test_places_that_are_known_or_found(shape, known):
    """Also those outside of an array, as each mode of JAX has it."""
    x = numbers(*shape)
    found = [
        lambda x, at: x[at],
        lambda x, at: x[:, at],
        lambda x, at: x[at, at],
        lambda x, at: x.at[at].get(mode="fill", fill_value=3.0),
        lambda x, at: x.at[at].get(mode="clip"),
        lambda x, at: x[at[0]],
        lambda x, at: x[1, at[1]],
        lambda x, at: jnp.take(x, at, axis=1),
        lambda x, at: x.at[at].set(1.0),
        lambda x, at: x.at[at].add(x[:1]),
        lambda x, at: x.at[:, at].multiply(2.0),
        lambda x, at: x.at[at, at].max(0.3),
        lambda x, at: x.at[at[0]].set(x[0]),
        lambda x, at: x.at[at[3], 1].add(1.0),
        lambda x, at: x.at[at[0], at[1]].min(-1.0),
        lambda x, at: x.at[1:3, at[0]].set(0.0),
        lambda x, at: lax.dynamic_slice(x, (at[0], at[3]), (2, 3)),
        lambda x, at: lax.dynamic_slice_in_dim(x, at[3], 2),
        lambda x, at: lax.dynamic_update_slice(x, x[:2, :2] + 1, (at[3], at[1])),
        lambda x, at: jnp.take_along_axis(x, jnp.argsort(x, 1), 1),
        lambda x, at: jax.vmap(lambda row, k: row[k])(x, at[:3].repeat(len(x))[: len(x)]),
    ]
    for function in found:
        if known:
            agrees(lambda x, function=function: function(x, jnp.asarray(INDICES)), x)
        else:
            agrees(function, x, INDICES)


def test_what_is_empty():
    agrees(lambda x: (x * 2, jnp.sum(x), jnp.concatenate([x, jnp.ones((2, 3))]), x.T, jnp.max(x, 1)), np.zeros((0, 3)))
    agrees(lambda x: (jnp.zeros((0,)), x[:0], x @ jnp.zeros((4, 0)), jnp.sort(x[:, :0])), numbers(*FEW))
