"""Quotients by what may be zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.spatial.vectors import length
from linkax.xla.derivatives import ratio


@pytest.mark.parametrize(("otherwise", "expected"), [(None, [2.0, 3.0, 5.0, np.nan]), (7.0, [2.0, 7.0, 7.0, 7.0])])
def test_ratio_divides_by_what_is_positive_alone(otherwise, expected):
    a, b = jnp.array([4.0, 3.0, 5.0, np.nan]), jnp.array([2.0, 0.0, -1.0, np.nan])
    np.testing.assert_array_equal(ratio(a, b, otherwise), expected)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_ratio_are_finite_where_it_divides_by_nothing(derivative):
    slopes = derivative(lambda vector: ratio(vector, length(vector), 0.0))
    np.testing.assert_array_equal(slopes(jnp.zeros(3)), np.zeros((3, 3)))
    np.testing.assert_allclose(slopes(jnp.array([2.0, 0.0, 0.0])), np.diag([0.0, 0.5, 0.5]))
