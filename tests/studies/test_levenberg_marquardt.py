"""Steps within bounds are the best there are, and neither they nor the end of a search depend on units."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import lsq_linear

import linkax as lx
from linkax.studies.fits.bounded_least_squares import least_squares_within

X = np.linspace(0.05, 1.0, 40)
NOISE = 0.01 * np.sin(37.0 * np.arange(40) ** 1.5)
TRUTH = {"size": 3.0, "rate": 1.5}


def decay(params):
    return params["size"] * jnp.exp(-params["rate"] * X)


def apart(params, data):
    return decay(params) - data


@pytest.mark.parametrize("damping", [1e-12, 0.1])
def test_steps_within_bounds_are_the_best(damping):
    """Against SciPy, with bounds far away, near, and where the step begins."""
    draw, within = np.random.default_rng(3), jax.jit(least_squares_within)
    for _ in range(100):
        matrix, residual = draw.normal(size=(5, 5)) * 10.0 ** draw.uniform(-3, 0, size=5), draw.normal(size=5)
        low, high = -draw.choice([0.0, 0.3, 1e4], size=5), draw.choice([1e-9, 0.3, 1e4], size=5)
        x = np.asarray(within(matrix, residual, damping, low, high))
        whole = np.concatenate([matrix, np.sqrt(damping) * np.eye(5)])
        rest = np.concatenate([residual, np.zeros(5)])
        best = lsq_linear(whole, -rest, (low, high), method="bvls", tol=1e-14)
        assert np.all((x >= low) & (x <= high))
        assert 0.5 * np.sum((whole @ x + rest) ** 2) <= best.cost * (1.0 + 1e-9) + 1e-15


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_units_of_data_do_not_matter(unit):
    """The steps are the same, of data with noise and without."""
    for noise in (NOISE, 0.0):
        data = np.asarray(decay(TRUTH)) + noise
        one = lx.fit(apart, {"size": 1.0, "rate": 0.1}, (data,))
        other = lx.fit(apart, {"size": unit, "rate": 0.1}, (unit * data,))
        assert (one.ended, other.ended) == ("converged", "converged")
        assert abs(one.steps - other.steps) <= 2
        np.testing.assert_allclose(other.params["size"] / unit, one.params["size"], rtol=1e-9)
        np.testing.assert_allclose(other.params["rate"], one.params["rate"], rtol=1e-9)
        np.testing.assert_allclose(other.loss / unit**2, one.loss, rtol=1e-9, atol=1e-20)


# The unit of the data, and where size and rate start.
FAR_STARTS = [
    *((unit, unit * factor, 0.1) for unit in (1e-9, 1.0, 1e9) for factor in (1e-3, 1e2, 1e5)),
    *((unit, 1.0, 0.1) for unit in (1e-9, 1e-6, 1e6, 1e9)),
    *((unit, lx.Positive(1.0), lx.Positive(10.0)) for unit in (1e-9, 1.0, 1e9)),
    *((unit, lx.Bounded(0.5, -1e9, 1e9), lx.Bounded(0.3, -1e9, 1e9)) for unit in (1.0, 1e9)),
]


@pytest.mark.parametrize(("unit", "size", "rate"), FAR_STARTS)
@pytest.mark.filterwarnings("ignore:the data do not determine", "ignore:the best value lies on a bound")
def test_starts_of_other_magnitudes_are_right_or_it_is_told(unit, size, rate):
    data = np.asarray(decay(TRUTH)) + NOISE
    best = lx.fit(apart, TRUTH, (data,))
    found = lx.fit(apart, {"size": size, "rate": rate}, (unit * data,))
    is_right = found.loss <= best.loss * unit**2 * (1.0 + 1e-4)
    assert is_right or found.ended != "converged" or found.undetermined or found.on_bound


@pytest.mark.parametrize("kind", [float, lx.Positive, partial(lx.Bounded, lower=0.0, upper=1e15)])
@pytest.mark.parametrize("power", [1, 2, 3, 4])
@pytest.mark.filterwarnings("ignore:the data do not", "ignore:the best value", "ignore:the fit ended .no better step")
def test_starts_far_from_a_power_are_right_or_it_is_told(power, kind):
    """Slopes at the start are up to 1e45 times those at the minimum; from 1e-12 to 1e20 it is found."""
    data = 2.0 * X + NOISE
    least = 0.5 * (data @ data - (X @ data) ** 2 / (X @ X))
    for start in (1e-9, 1e-6, 1e-3, 1e3, 1e6, 1e9, 1e12, 1e15):
        found = lx.fit(lambda p: p["a"] ** power * X - data, {"a": kind(start)})
        told = found.ended != "converged" or found.undetermined or found.on_bound
        assert told or found.loss <= least * (1.0 + 1e-4), start
        assert not told or (power > 1 and not 1e-12 < start**power < 1e20), start


@pytest.mark.parametrize("rate", [1.5, 1.5 * (1.0 + 1e-9), 3.0])
def test_data_without_noise_end_by_rounding(rate):
    found = lx.fit(apart, {"size": 3.0, "rate": rate}, (np.asarray(decay(TRUTH)),))
    assert found.ended == "converged"
    assert found.steps < 12
    np.testing.assert_allclose(found.params["rate"], 1.5, rtol=1e-12)


@pytest.mark.parametrize("start", [0.1, 1.0, lx.Bounded(0.3, 0.0, 1.0)])
def test_a_square_that_vanishes_is_found(start):
    """Next to zero slopes vanish, and linear steps would be ever longer."""
    found = lx.fit(lambda p: p["e"] ** 2 * np.sin(9.0 * X) + p["b"] - 2.0, {"e": start, "b": 1.0})
    assert found.ended == "converged"
    assert found.steps < 50
    np.testing.assert_allclose(found.params["e"], 0.0, atol=1e-5)


@pytest.mark.parametrize("size", [1e-10, 1e-8, 1e-6, 1e-5])
def test_roughness_costs_few_steps(size):
    """As that of runs with steps of their own: values are rough, and slopes are not."""
    rough = lambda p: size * jnp.sin(1e7 * X * jax.lax.stop_gradient(p["rate"] * p["size"]))
    data = np.asarray(decay(TRUTH)) + NOISE
    found = lx.fit(lambda p, data: apart(p, data) + rough(p), {"size": 1.0, "rate": 1.0}, (data,))
    assert found.ended == "converged"
    assert found.steps < 12
    np.testing.assert_allclose(found.params["rate"], lx.fit(apart, TRUTH, (data,)).params["rate"], rtol=1e-5)


def test_an_end_beside_a_minimum_is_told():
    """At a kink, down to which the loss falls, and where tolerances of another solver are those of larger data."""
    with pytest.warns(UserWarning, match="ended 'no better step'"):
        found = lx.fit(lambda p: jnp.stack([1.0 + jnp.abs(p["x"] - 0.3), 0.1 * p["x"]]), {"x": 1.0})
    np.testing.assert_allclose(found.params["x"], 0.3, atol=1e-3)
    assert found.covariance is None
    with pytest.warns(UserWarning, match="ended 'no better step'"):
        lx.fit(
            apart, {"size": 1e-9, "rate": 0.1}, (1e-9 * decay(TRUTH),), optimiser=optx.LevenbergMarquardt(1e-6, 1e-6)
        )
