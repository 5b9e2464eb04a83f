"""Screws: brackets and exponentials are those of their matrices, with derivatives, at any angle and at none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.linalg import expm

from linkax.spatial.screws import LEVI_CIVITA, bracket, exponential

RNG = np.random.default_rng(0)
SCREWS = [np.zeros(6), 1e-9 * RNG.normal(size=6), *RNG.normal(size=(3, 6)), np.array([0.0, 3.0, 0.0, 1.0, 2.0, 3.0])]


def matrix(screw):
    """[[â, b], [0, 0]], where â p = a × p."""
    top = jnp.concatenate([-jnp.tensordot(screw[:3], LEVI_CIVITA, 1), screw[3:, None]], axis=1)
    return jnp.concatenate([top, jnp.zeros((1, 4))])


@pytest.mark.parametrize("screw", SCREWS, ids=lambda screw: f"{np.linalg.norm(screw[:3]):.1e}")
def test_exponentials(screw):
    # An exponential by scaling and squaring loses a few digits.
    np.testing.assert_allclose(exponential(screw), expm(matrix(screw)), atol=1e-14)
    of_matrix = jax.jacfwd(lambda screw: expm(matrix(screw)))(screw)
    for derivative in jax.jacfwd, jax.jacrev:
        np.testing.assert_allclose(derivative(exponential)(screw), of_matrix, atol=1e-14)


def test_second_derivatives_at_no_turn():
    """exp S = 1 + S + S² / 2 + …: the second derivative along a screw is that of S² / 2."""
    along = lambda screw: jax.jacfwd(jax.jacfwd(lambda t: exponential(t * screw)))(0.0)
    for screw in SCREWS:
        np.testing.assert_allclose(along(screw), matrix(screw) @ matrix(screw), atol=1e-14)


def test_brackets():
    for first in SCREWS:
        for second in SCREWS:
            x, y = matrix(first), matrix(second)
            np.testing.assert_allclose(matrix(bracket(first, second)), x @ y - y @ x, atol=1e-15)
