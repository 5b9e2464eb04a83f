"""Loops, branches and calls, with what is carried in numbers and in memory."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import agrees, numbers
from jax import lax

SHAPES = [(3,), (40, 30)]


def newton(x, y):
    """A loop of unknown length, which carries a counter, an array and one that stays."""
    going = lambda carry: (carry[0] < 60) & (jnp.max(jnp.abs(carry[1] ** 2 - carry[2])) > 1e-9)
    return lax.while_loop(
        going, lambda carry: (carry[0] + 1, (carry[1] + carry[2] / carry[1]) / 2, carry[2]), (0, x**2 + 1, y**2 + 1)
    )


def swapped(x, y):
    """What is carried changes places, and part of it is known all along."""

    def body(carry):
        k, a, b, zeros = carry
        return k + 1, b * 0.5, a + zeros, zeros * 2.0

    return lax.while_loop(lambda carry: carry[0] < 5, body, (0, x, y, jnp.zeros_like(x)))


def known_for_a_while(x, y):
    """An entry is zero at first, and no longer after some passes."""
    start = jnp.concatenate([jnp.zeros(3), jnp.ones(1)])
    return lax.fori_loop(0, 6, lambda k, carry: jnp.roll(carry, 1) * (1.0 + x.ravel()[0]), start)


def scanned(x, y):
    def body(carry, row):
        carry = jnp.cos(carry) + row
        return carry, (carry * 2, jnp.sum(row))

    return lax.scan(body, x[0], y), lax.scan(body, x[0], y, reverse=True)


def long_scan(x, y):
    return lax.scan(lambda carry, k: (carry * 0.99 + jnp.sin(k), carry), x, jnp.arange(200.0))


def saved(x, y):
    """A record that is written row by row, where a condition holds, as a run saves its states."""

    def body(carry):
        k, row, record, x = carry
        x = jnp.sin(x) + 0.1 * k
        keep = k % 3 != 1
        record = jnp.where(keep, record.at[row].set(x), record)
        return k + 1, row + keep, record, x

    return lax.while_loop(lambda carry: carry[0] < 20, body, (0, 0, jnp.full((20, *x.shape), jnp.inf), x))


def saved_in_a_branch(x, y):
    def body(k, carry):
        record, x = carry
        record = lax.cond(jnp.sum(x) > 0, lambda: record.at[k].set(x), lambda: record)
        return record, jnp.cos(x + k)

    return lax.fori_loop(0, 20, body, (jnp.zeros((20, *x.shape)), x))


def branches(x, y):
    choice = (jnp.sum(jnp.abs(x)) * 10).astype(int)
    found = lax.switch(
        choice % 4,
        [lambda: x, lambda: y, lambda: x @ x.T if x.ndim > 1 and x.shape[0] == x.shape[1] else x * y, lambda: x - y],
    )
    one = lax.cond(jnp.sum(y) > 0, lambda x: (x, 1.0, y), lambda x: (x * 2, 0.0, y), x)
    return found, one, lax.cond(True, lambda: x, lambda: y)


def nested(x, y):
    def outer(k, carry):
        inner = lax.while_loop(lambda c: jnp.sum(c[1]) < k, lambda c: (c[0] + 1, c[1] + jnp.abs(y)), (0, carry * 0.0))
        return lax.cond(inner[0] > 1, lambda: carry + inner[1], lambda: carry - 1.0)

    return lax.fori_loop(0, 8, outer, x)


@jax.jit
def shared(x, y):
    z = jnp.sin(x) * jnp.cos(y) + jnp.exp(-(x**2))
    z = z / (1 + z**2) + jnp.tanh(z) - jnp.arctan(x)
    return z + jnp.mean(z) - jnp.sort(z), jnp.cumsum(z) if z.ndim == 1 else z.T, x, jnp.zeros_like(x)


def called(x, y):
    """A function that is called with numbers, with constants, and with its own results."""
    one = shared(x, y)
    two = shared(one[0], jnp.zeros_like(y))
    return one, two, lax.fori_loop(0, 4, lambda k, z: shared(z, two[0])[0], x)


@jax.custom_jvp
def own_rule(x):
    return jnp.sin(x)


own_rule.defjvp(lambda x, dx: (own_rule(*x), 2.0 * dx[0]))


def batch_of_loops(x, y):
    """Traced as one loop, with a condition for each member."""
    return jax.vmap(newton)(x, y)


FUNCTIONS = [
    batch_of_loops,
    newton,
    swapped,
    known_for_a_while,
    scanned,
    long_scan,
    saved,
    saved_in_a_branch,
    branches,
    nested,
    called,
]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_control(function, shape):
    agrees(function, numbers(*shape), numbers(*shape, seed=1), rtol=1e-11)  # sums of 1200 numbers in another order


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_members_of_a_batch_go_their_own_ways(function, shape):
    """Of 11 in vectors of 8, each with its own length of loops and its own branches."""
    x, y = numbers(11, *shape), numbers(11, *shape, seed=1)
    x[3:5] *= 10.0
    from scalarjit import scalarised

    of_batch = jax.vmap(scalarised(function))(x, y)
    alone = [scalarised(function)(*pair) for pair in zip(x, y, strict=True)]
    jax.tree.map(lambda batch, *each: np.testing.assert_allclose(batch, np.stack(each), rtol=1e-13), of_batch, *alone)


def test_rules_of_derivatives_of_ones_own():
    agrees(jax.grad(lambda x: jnp.sum(own_rule(x))), numbers(4))
    agrees(jax.vmap(jax.checkpoint(partial(jnp.linalg.norm))), numbers(4, 3))
