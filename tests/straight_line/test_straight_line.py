"""`straight_line` computes what the function itself computes, in fewer operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from programs import Program, arguments

from linkax.straight_line import kernel, rules
from linkax.straight_line.graph import Graph
from linkax.straight_line.transform import Traced, computes_kernels, straight_line

SEEDS = 40  # programs of fourteen functions each
FEW = 4
TOLERANCES = {np.dtype(np.float64): 1e-13, np.dtype(np.float32): 2e-5}


def operations(function, *arguments):
    """How many scalar operations the results need, and how many operations stay on arrays."""
    program = Traced(jax.make_jaxpr(function)(*arguments), [None] * len(arguments), 10_000).program
    assert program is not None
    results = [index for entries in program.outputs for index in entries.ravel().tolist()]
    needed = program.graph.needed(results, {})
    names = [program.graph.operations[index].name for index in needed]
    return sum(name not in ("input", "known") for name in names), len(program.between)


def assert_same(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        tolerance = TOLERANCES.get(a.dtype, 0.0)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


RANDOM = [
    pytest.param(seeds, dtype, id=f"{dtype.__name__}-{seeds[0]}-{seeds[-1]}", marks=[pytest.mark.slow] if later else [])
    for dtype in (np.float64, np.float32)
    for later, seeds in enumerate(np.array_split(np.arange(SEEDS), 4))
]


@pytest.mark.parametrize(("seeds", "dtype"), RANDOM)
def test_random_programs(seeds, dtype):
    for seed in seeds:
        program, given = Program(seed), arguments(seed, dtype)
        assert_same(jax.jit(straight_line(program))(*given), jax.jit(program)(*given))


def test_nothing_is_compiled_where_jax_may_not():
    with jax.disable_jit():
        found = straight_line(lambda x: jnp.sin(x) * np.asarray(x))(jnp.arange(3.0))  # NumPy's takes no tracers
    np.testing.assert_allclose(found, np.sin(np.arange(3.0)) * np.arange(3.0), rtol=1e-15)


def loss(function):
    """A number of the real results, with derivatives."""

    def of(*given):
        real = [array for array in function(*given) if jnp.issubdtype(array.dtype, jnp.floating)]
        return sum(jnp.sum(jnp.sin(array)) for array in real)

    return of


@pytest.mark.parametrize(
    "seed", [SEEDS, *(pytest.param(SEEDS + later, marks=pytest.mark.slow) for later in range(1, FEW))]
)
def test_batches_and_derivatives_of_random_programs(seed):
    program, given = Program(seed), arguments(seed)
    several = [jnp.stack([array, 0.3 - array, 2.0 * array]) for array in given]
    axes = (0, None, 0)
    mapped = [array if axis is None else many for array, many, axis in zip(given, several, axes, strict=True)]

    def everything(function):
        of = loss(function)
        batch = jax.vmap(function, in_axes=axes)
        backwards, forwards = jax.grad(of, argnums=(0, 1, 2)), jax.jacfwd(of, argnums=2)

        def compute(given, mapped):
            # Of a batch, with an argument that its members share.
            shared = jax.grad(lambda vector: jnp.sum(jax.vmap(of, in_axes=axes)(mapped[0], vector, mapped[2])))
            inner = jax.vmap(batch, in_axes=(None, 0, None))(mapped[0], several[1], mapped[2])
            return batch(*mapped), backwards(*given), forwards(*given), shared(mapped[1]), inner

        return jax.jit(compute)(given, mapped)

    assert_same(everything(straight_line(program)), everything(program))


@pytest.mark.parametrize("mode", ["clip", "fill", "promise_in_bounds"])
def test_indices_that_are_not_known(mode):
    """Also those outside, which are clipped or dropped, as JAX does."""
    matrix = jnp.arange(12.0).reshape(4, 3)

    def function(index):
        read = matrix.at[index].get(mode=mode), matrix[1].at[index].get(mode=mode)
        if mode == "promise_in_bounds":
            return read, matrix.at[index, 1].add(5.0)
        return read, matrix.at[index, 1].add(5.0, mode=mode), matrix.at[jnp.stack([index, 0])].set(7.0, mode=mode)

    indices = (1, 2) if mode == "promise_in_bounds" else (-9, 0, 1, 2, 3, 4, 9)
    straight, plain = jax.jit(straight_line(function)), jax.jit(function)
    assert operations(function, jnp.array(1))[1] == 0
    for index in indices:
        assert_same(straight(jnp.array(index)), plain(jnp.array(index)))


def test_second_derivatives():
    matrix = np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 1.0], [-1.0, 3.0, 0.0]])

    def function(x):
        solved = lax.fori_loop(0, 3, lambda i, y: y - 0.1 * (matrix @ y - jnp.sin(x)), x)
        return jnp.sum(jnp.exp(solved) * x[0])

    x = jnp.array([0.3, -0.7, 1.1])
    for second in (jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f)), lambda f: jax.jacrev(jax.grad(f))):
        assert_same(jax.jit(second(straight_line(function)))(x), jax.jit(second(function))(x))


def test_known_zeros_cost_nothing():
    rotation = lambda angle: jnp.array(
        [[jnp.cos(angle), -jnp.sin(angle), 0.0], [jnp.sin(angle), jnp.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    along = np.array([2.0, 0.0, 0.0])
    # cos, sin, and their products with 2.
    assert operations(lambda angle: rotation(angle) @ along, 0.3) == (4, 0)
    assert operations(lambda x: np.eye(3) @ x + np.zeros(3), jnp.ones(3)) == (0, 0)
    # One product, computed once, whatever the order and sign.
    assert operations(lambda x, y: (x * y, y * x, (-x) * (-y)), 1.0, 2.0) == (1, 0)


def test_a_derivative_folds_anew():
    function = lambda x: jnp.array([2.0 * x[0], x[1] * x[1], 3.0])
    traced = Traced(jax.make_jaxpr(function)(jnp.ones(2)), [None], 100)
    program = traced.tangent((True,)).program
    assert program is not None
    assert program.graph.values[program.outputs[0][2]] == 0.0


def test_folding_keeps_rounding():
    """What is left out of a sum or product changes no digit: 1·x, x + 0, signs."""
    graph = Graph()
    x, y = graph.input(np.dtype(float)), graph.input(np.dtype(float))
    zero, one, minus = (graph.known(value, np.dtype(float)) for value in (0.0, 1.0, -1.0))
    assert graph.add(x, zero) == graph.sub(x, zero) == graph.mul(one, x) == graph.div(x, one) == x
    assert graph.mul(minus, x) == graph.neg(x) == graph.sub(zero, x)
    assert graph.add(x, graph.neg(y)) == graph.sub(x, y)
    assert graph.sub(x, graph.neg(y)) == graph.add(y, x)
    # Not known to be equal to one, or zero, for all that is computed.
    assert graph.values[graph.div(x, x)] is None
    assert graph.values[graph.sub(x, x)] is None
    assert graph.known(0.0, np.dtype(float)) != graph.known(-0.0, np.dtype(float))


def test_what_is_not_finite_spoils_its_own_member_alone():
    function = straight_line(lambda x, y: (x * y, jnp.zeros(2) * x, y > 0.0))
    product, zeros, is_positive = function(jnp.array(np.inf), jnp.array(1.0))
    assert np.isnan(product)
    assert not is_positive
    np.testing.assert_array_equal(zeros, [0.0, 0.0])
    x = jnp.array([1.0, np.nan, 3.0])
    products, _, signs = jax.vmap(function, in_axes=(0, None))(x, jnp.array(2.0))
    np.testing.assert_array_equal(products, [2.0, np.nan, 6.0])
    np.testing.assert_array_equal(signs, [True, False, True])


ON_TWO = ("atan2", "pow", "rem", "nextafter")
ON_INTEGERS = ("shift_left", "shift_right_logical", "shift_right_arithmetic", "population_count", "clz")


@pytest.mark.parametrize("name", sorted({*rules.OTHERS} - {"xor", "round"}))
def test_each_function_of_numbers(name):
    """Alone and in lanes; what JAX makes of several operations of XLA, too."""
    given = [jnp.array([0.3, 0.7]), jnp.array([0.4, 0.9])][: 2 if name in ON_TWO else 1]
    if name in ON_INTEGERS:
        given = [jnp.array([3, 5]), jnp.array([1, 2])][: 2 if name.startswith("shift") else 1]
    if name == "acosh":
        given = [1.0 + array for array in given]
    function = lambda *given: (getattr(lax, name)(*given), given[0])
    assert_same(jax.jit(straight_line(function))(*given), function(*given))
    several = [jnp.stack([array, array[::-1]]) for array in given]
    assert_same(jax.jit(jax.vmap(straight_line(function)))(*several), jax.vmap(function)(*several))


def test_results_that_only_xla_can_tell():
    """Constants and arguments, of each type, beside computed ones: of a fusion XLA expects none."""

    def function(x, n):
        unknown = lax.optimization_barrier(lax.erf(1.0)) * 0.0
        whole = n - n, n * 0 + 7, (n < n).astype(n.dtype)
        return x * 2.0, x - x, x / x, jnp.where(x == x, x, 3.0), x != x, n == n, *whole, lax.erf(1.0), unknown + 1.0

    given = jnp.array(0.7), jnp.array(3)
    assert_same(jax.jit(straight_line(function))(*given), function(*given))
    several = jnp.array([0.7, np.nan, 1.5]), jnp.array([3, 4, 5])
    expected = [np.array(array) for array in jax.vmap(function)(*several)]
    for found, array in zip(jax.jit(jax.vmap(straight_line(function)))(*several), expected, strict=True):
        np.testing.assert_array_equal(np.asarray(found)[::2], array[::2])


def test_one_argument_of_a_type():
    """Read by a select, and by itself."""
    function = lambda x, n, b: (jnp.where(b, x, 2.0 * x), jnp.where(b, n, 3), lax.select(b, b, x > 0.5), x + n)
    given = jnp.array(0.7), jnp.array(3), jnp.array(True)
    for lanes in (1, 3):
        several = [jnp.stack([array] * lanes) for array in given]
        assert_same(jax.jit(jax.vmap(straight_line(function)))(*several), jax.vmap(function)(*several))
    assert_same(jax.jit(straight_line(function))(*given), function(*given))


@pytest.mark.slow
def test_as_many_entries_and_lanes_as_one_kernel_has():
    """XLA must make a kernel of the loop around a fusion, however large."""
    function = lambda x: jnp.sin(x) + jnp.roll(x, 1)
    x = jnp.asarray(np.random.default_rng(0).normal(size=(300, 2000)))
    assert_same(jax.jit(straight_line(function))(x[0]), jax.jit(function)(x[0]))
    assert_same(jax.jit(jax.vmap(straight_line(function)))(x), jax.jit(jax.vmap(function))(x))


def test_more_lanes_than_are_computed_together():
    function = lambda x, y: jnp.sin(x) @ y
    x, y = jnp.asarray(np.random.default_rng(0).normal(size=(1000, 3))), jnp.array([1.0, 2.0, 3.0])
    mapped = lambda function: jax.jit(jax.vmap(function, in_axes=(0, None)))
    assert_same(mapped(straight_line(function))(x, y), mapped(function)(x, y))


def test_what_has_no_straight_line_stays_on_arrays():
    """Loops of unknown length and libraries, between straight lines, in batches and with derivatives."""

    def function(x):
        matrix = jnp.outer(x, x) + jnp.diag(jnp.array([3.0, 4.0, 5.0]))
        solved = jnp.linalg.solve(matrix, jnp.sin(x))
        halved = lax.while_loop(lambda y: jnp.sum(y * y) > 0.01, lambda y: 0.5 * y, lax.stop_gradient(solved))
        return solved * halved[0], jnp.sum(halved)

    x = jnp.array([[0.3, -0.7, 1.1], [0.1, 2.0, 0.5]])
    assert operations(function, x[0])[1] > 0
    assert_same(jax.jit(straight_line(function))(x[0]), jax.jit(function)(x[0]))
    assert_same(jax.jit(jax.vmap(straight_line(function)))(x), jax.jit(jax.vmap(function))(x))
    slope = lambda function: jax.jit(jax.jacrev(lambda x: function(x)[0]))
    assert_same(slope(straight_line(function))(x[0]), slope(function)(x[0]))


def test_a_function_that_is_too_long_is_left_as_it_is():
    function = lambda x: jnp.sin(x) @ jnp.cos(x).T
    x = jnp.ones((20, 20))
    assert "straight_line" not in str(jax.make_jaxpr(straight_line(function, most=100))(x))
    assert "straight_line" in str(jax.make_jaxpr(straight_line(function, most=100))(x[:2, :2]))


def test_kernels_that_compute_something_else_are_noticed(monkeypatch):
    monkeypatch.setitem(kernel.DIRECT, "sub", kernel.DIRECT["add"])
    computes_kernels.cache_clear()
    function = lambda x: jnp.cos(x) * x
    try:
        with pytest.warns(RuntimeWarning, match="several times as long"):
            found = jax.make_jaxpr(straight_line(function))(1.0)
        assert "straight_line" not in str(found)
    finally:
        monkeypatch.undo()
        computes_kernels.cache_clear()
    assert "straight_line" in str(jax.make_jaxpr(straight_line(function))(1.0))


def test_functions_of_numbers_of_others():
    """Arrays that a function has from outside, traced by another transformation, have derivatives too."""
    of = lambda wrap: jax.jit(
        jax.grad(lambda scale: wrap(lambda x: jnp.sin(scale * x[0]) * x[1])(jnp.array([1.0, 2.0])))
    )
    assert_same(of(straight_line)(0.7), of(lambda function: function)(0.7))


def test_without_jit():
    function = lambda tree: {"sum": tree["a"] + tree["b"][0], "none": None}
    given = {"a": jnp.ones(2), "b": (jnp.array(3.0),)}
    assert_same(straight_line(function)(given), function(given))


def test_large_arrays_of_few_scalars():
    """They are gathered from these, in lanes too."""

    def sparse(x):
        matrix = jnp.zeros((25, 30)).at[np.arange(3), np.arange(3)].set(jnp.sin(x))
        return matrix.at[20, 7].set(x[0] * x[1])

    x = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)))
    np.testing.assert_allclose(straight_line(sparse)(x[0]), sparse(x[0]), atol=1e-15)
    np.testing.assert_allclose(jax.vmap(straight_line(sparse))(x), jax.vmap(sparse)(x), atol=1e-15)


@pytest.mark.slow
def test_straight_lines_over_lanes_within_others():
    """They stay of their own, know what is the same in all lanes, and what they know of results is known after."""
    inner = straight_line(lambda x, y: (x * y[0] + y[1], jnp.stack([y[1], 2.0 * y[1]])))

    def function(x):
        y = jnp.zeros((4, 2)).at[:, 0].set(x[:4])
        linear, nothing = jax.vmap(inner, in_axes=(None, 0))(x[0], y)
        return jnp.sum(jnp.sin(linear)) + jnp.sum(nothing @ x[:2])

    x = jnp.array([0.3, -0.7, 1.1, 0.2])
    # Four sines and their sums, but for none of what is zero.
    assert operations(function, x) == (7, 1)
    everything = lambda function: [function(x), *(of(function)(x) for of in (jax.jacfwd, jax.grad, jax.hessian))]
    assert_same(everything(straight_line(function)), everything(function))
    several = jnp.stack([x, 2.0 * x, -x])
    assert_same(jax.vmap(straight_line(function))(several), jax.vmap(function)(several))
