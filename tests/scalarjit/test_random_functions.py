"""Random functions of arrays compute what JAX does, alone, in batches, and in derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from random_functions import RandomFunction, arguments

from scalarjit import scalarised

SEEDS = 40  # functions of fourteen operations each
FEW = 4
TOLERANCES = {np.dtype(np.float64): 1e-13, np.dtype(np.float32): 2e-5}


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
def test_random_functions(seeds, dtype):
    for seed in seeds:
        function, given = RandomFunction(seed), arguments(seed, dtype)
        assert_same(jax.jit(scalarised(function))(*given), jax.jit(function)(*given))


def loss(function):
    """A number of the real results, with derivatives."""

    def of(*given):
        real = [array for array in function(*given) if jnp.issubdtype(array.dtype, jnp.floating)]
        return sum(jnp.sum(jnp.sin(array)) for array in real)

    return of


@pytest.mark.parametrize(
    "seed", [SEEDS, *(pytest.param(SEEDS + later, marks=pytest.mark.slow) for later in range(1, FEW))]
)
def test_batches_and_derivatives_of_random_functions(seed):
    function, given = RandomFunction(seed), arguments(seed)
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

    assert_same(everything(scalarised(function)), everything(function))


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
    found, expected = jax.jit(scalarised(function)), jax.jit(function)
    for index in indices:
        assert_same(found(jnp.array(index)), expected(jnp.array(index)))


def test_what_is_not_finite_spoils_its_own_member_alone():
    function = scalarised(lambda x, y: (x * y, jnp.zeros(2) * x, y > 0.0))
    x = jnp.array([1.0, np.nan, 3.0])
    products, zeros, signs = jax.vmap(function, in_axes=(0, None))(x, jnp.array(2.0))
    np.testing.assert_array_equal(products, [2.0, np.nan, 6.0])
    np.testing.assert_array_equal(zeros, np.zeros((3, 2)))  # times a zero that is a constant
    np.testing.assert_array_equal(signs, [True, True, True])


def test_functions_of_numbers_of_others():
    """Arrays that a function has from outside, traced by another transformation, have derivatives too."""
    of = lambda wrap: jax.jit(
        jax.grad(lambda scale: wrap(lambda x: jnp.sin(scale * x[0]) * x[1])(jnp.array([1.0, 2.0])))
    )
    assert_same(of(scalarised)(0.7), of(lambda function: function)(0.7))


def test_trees_and_static_leaves():
    function = lambda tree, power=1: {"sum": (tree["a"] + tree["b"][0]) ** power, "none": None, "name": tree["name"]}
    given = {"a": jnp.ones(2), "b": (jnp.array(3.0),), "name": "rod"}
    for options in ({}, {"power": 2}):
        found, expected = scalarised(function)(given, **options), function(given, **options)
        assert (found["none"], found["name"]) == (None, "rod")
        np.testing.assert_array_equal(found["sum"], expected["sum"])


def test_nothing_is_compiled_where_jax_may_not():
    with jax.disable_jit():
        found = scalarised(lambda x: jnp.sin(x) * np.asarray(x))(jnp.arange(3.0))  # NumPy's takes no tracers
    np.testing.assert_allclose(found, np.sin(np.arange(3.0)) * np.arange(3.0), rtol=1e-15)


def test_what_is_printed_leaves_the_rest_compiled(capfd):
    def function(x):
        halved = lax.while_loop(lambda y: jnp.sum(y) > 1.0, lambda y: (jax.debug.print("{}", y[0]), y / 2)[1], x)
        return jnp.sin(halved) @ x

    found = jax.jit(scalarised(function))(jnp.ones(3))
    jax.effects_barrier()
    np.testing.assert_allclose(found, 3 * np.sin(0.25), rtol=1e-15)
    assert capfd.readouterr().out.split() == ["1.0", "0.5"]


def test_alone_and_within_others():
    """Concrete arguments are computed at once, with no part in what is traced around."""
    double = scalarised(lambda x: 2.0 * x)

    def plus_six(x):
        six = double(np.asarray(3.0))
        assert not isinstance(six, jax.core.Tracer)
        return x + six

    assert jax.jit(plus_six)(1.0) == 7.0
    assert jax.jit(double)(1.0) == 2.0
    assert jax.grad(double)(1.0) == 2.0
    np.testing.assert_array_equal(jax.vmap(double)(np.arange(3.0)), [0.0, 2.0, 4.0])
