"""Values close to a singular configuration, as limits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.formulations.singular_limit import NEAR, Direction, Value, singular_limit

UNITS = jnp.ones(2)


def spoiled(noise, t, q, kink=0.0, gap=0.0):
    """A smooth function of q, and what a singular configuration at q[0] = 0 does to it."""
    added = jnp.where(jnp.abs(q[0]) < 0.5 * NEAR, noise, 0.0)
    smooth = jnp.stack([jnp.sin(q[0]) + q[1], jnp.cos(2.0 * q[0])])
    return Value((q, smooth + added + kink * jnp.abs(q[0])), jnp.abs(q[0]), jnp.asarray(gap))


kinked, open_between = partial(spoiled, kink=1.0), partial(spoiled, gap=1e-9)


def unbounded(noise, t, q):
    """Odd: it cancels in the mean of both sides."""
    found = spoiled(noise, t, q)
    return found._replace(answers=(q, found.answers[1] + 1.0 / q[0]))


def no_number(noise, t, q):
    """At the state itself and at the interpolated one."""
    found = spoiled(noise, t, q)
    return found._replace(answers=(q, jnp.where(jnp.abs(q[0]) < 0.5 * NEAR, jnp.nan, found.answers[1])))


AT = jnp.array([1e-9, 0.3])
V = jnp.array([2.0, 1.0])


def answer(function, noise, q):
    course = Direction(jnp.zeros(()), q, V, UNITS, jnp.add, advances=False)
    return singular_limit(function, (0, 1), noise, course)[0][1]


def test_noise_is_left_out():
    np.testing.assert_allclose(answer(spoiled, 1e6, AT), answer(spoiled, 0.0, AT), atol=1e-12)
    away = jnp.array([2.0 * NEAR, 0.3])
    np.testing.assert_array_equal(answer(spoiled, 1e6, away), spoiled(1e6, 0.0, away).answers[1])


@pytest.mark.parametrize("function", [kinked, open_between, unbounded])
def test_where_there_is_no_limit_the_value_itself_stands(function):
    np.testing.assert_array_equal(answer(function, 0.25, AT), function(0.25, 0.0, AT).answers[1])


def test_a_state_without_a_number_has_a_limit():
    np.testing.assert_array_equal(answer(no_number, 0.0, AT), answer(spoiled, 0.0, AT))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_limit(mode):
    exact = jax.jacfwd(lambda q: spoiled(0.0, 0.0, q).answers[1])(AT)
    np.testing.assert_allclose(mode(lambda q: answer(spoiled, 1e6, q))(AT), exact, atol=1e-10)


def test_members_of_a_batch_do_not_meet():
    many = jnp.array([[1e-9, 0.3], [0.5, 0.1]])
    together = jax.vmap(lambda q: answer(spoiled, 1e6, q))(many)
    np.testing.assert_allclose(together, [answer(spoiled, 1e6, q) for q in many], rtol=1e-14)
