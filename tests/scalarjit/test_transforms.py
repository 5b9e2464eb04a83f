"""Derivatives in both modes, of higher order and in batches, and what is made once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import numbers
from jax import lax

from scalarjit import scalarised, with_known_entries


def few(x, y):
    return jnp.sin(x) @ y, jnp.sum(x * y), (9 * x).astype(int)


def many(x, y):
    product = jnp.tile(x, (5, 1)) @ jnp.tile(y, (1, 5))
    return jnp.tanh(product / 30), jnp.cumsum(product, 0)[-1]


def loop(x, y):
    return lax.fori_loop(0, 5, lambda k, z: jnp.cos(z @ y / 3) + k, x), x[0, 0] * 2.0


def scan(x, y):
    return lax.scan(lambda carry, row: (jnp.sin(carry + row), carry * row), x[0], jnp.tile(y, (20, 1)))


def branch(x, y):
    return lax.cond(x[0, 0] > 0, lambda: (x @ y, y), lambda: (x * y, x))


FIRST = {"forward": jax.jacfwd, "reverse": jax.jacrev}
SECOND = {
    "forward over reverse": lambda f: jax.jacfwd(jax.jacrev(f)),
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
}
CASES = [(function, FIRST) for function in (few, many, loop, scan, branch)]
CASES += [(function, SECOND) for function in (few, loop, branch)]


@pytest.mark.parametrize(("function", "transforms"), CASES)
def test_derivatives(function, transforms):
    x, y = jnp.asarray(numbers(4, 4)), jnp.asarray(numbers(4, 4, seed=1))
    real = lambda function: lambda *args: [part for part in jax.tree.leaves(function(*args)) if part.dtype == float]
    for transform in transforms.values():
        found, expected = (jax.tree.leaves(transform(real(f))(x, y)) for f in (scalarised(function), function))
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("function", [few, many, loop, scan, branch])
def test_derivatives_in_batches(function):
    xs, y = jnp.asarray(numbers(9, 4, 4)), jnp.asarray(numbers(4, 4, seed=1))
    loss = lambda function: lambda x, y: sum(jnp.sum(part**2) for part in jax.tree.leaves(function(x, y))[:2])
    for transform in (jax.grad, lambda f: jax.grad(f, argnums=1)):
        found = jax.vmap(transform(loss(scalarised(function))), (0, None))(xs, y)
        expected = jax.vmap(transform(loss(function)), (0, None))(xs, y)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    of_batch = jax.grad(lambda y: jnp.sum(jax.vmap(loss(scalarised(function)), (0, None))(xs, y)))(y)
    expected = jax.grad(lambda y: jnp.sum(jax.vmap(loss(function), (0, None))(xs, y)))(y)
    np.testing.assert_allclose(of_batch, expected, rtol=1e-10, atol=1e-9)


def test_batches_of_batches():
    xs, ys = jnp.asarray(numbers(3, 5, 4, 4)), jnp.asarray(numbers(5, 4, 4, seed=1))
    both = lambda function: jax.vmap(jax.vmap(function), (0, None))(xs, ys)
    for one, other in zip(both(scalarised(few)), both(few), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_within_programs_of_jax():
    x, y = jnp.asarray(numbers(4, 4)), jnp.asarray(numbers(4, 4, seed=1))
    inside = lambda function: jax.jit(lambda x: lax.fori_loop(0, 3, lambda k, z: function(z, y)[0] + k, x))(x)
    np.testing.assert_allclose(inside(scalarised(few)), inside(few), rtol=1e-12)


def test_within_each_other():
    """A function compiled by itself is part of another one, for one member and for many."""
    xs, y = jnp.asarray(numbers(20, 4, 4)), jnp.asarray(numbers(4, 4, seed=1))
    inner = lambda function: lambda xs, y: (function(xs[0], y), jax.vmap(function, (0, None))(xs, y))
    found, expected = scalarised(inner(scalarised(few)))(xs, y), inner(few)(xs, y)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_known_entries_are_taken_for_granted():
    """They need not be the ones that are passed."""
    function = scalarised(lambda flat: flat.tree @ flat.tree)
    given = with_known_entries(np.array([[1.0, 2.0], [5.0, 0.0]]))
    others = jax.tree.map(lambda array: 0.0 * array + 3.0, given)
    taken = np.array([[1.0, 3.0], [3.0, 0.0]])
    np.testing.assert_allclose(function(others), taken @ taken)
    slopes = jax.grad(lambda flat: jnp.sum(function(flat)))(given).tree
    np.testing.assert_allclose(slopes, jax.grad(lambda x: jnp.sum(x @ x))(given.tree))
