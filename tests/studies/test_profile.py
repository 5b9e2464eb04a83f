"""Profiles: those of a straight line are the textbook's, of a bent one the likelihood's; flat ones are told."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import t as student

import linkax as lx

TIMES = np.linspace(0.0, 4.0, 8)


def line(params, data):
    return params["at_zero"] + params["slope"] * TIMES - data


@cache
def fitted_line():
    return fitted_from({"slope": 1.0, "at_zero": 2.0})


def fitted_from(start):
    data = 1.0 + 0.5 * TIMES + 0.1 * np.random.default_rng(3).normal(size=TIMES.shape)
    return lx.fit(line, start, (data,)), (data,)


def test_of_a_straight_line_it_is_linear_regression():
    """The signed root is t, the refits are those of the other parameter, the interval is Student's."""
    found, args = fitted_line()
    profile = lx.profile(line, found, "slope", args)
    error = found.standard_errors["slope"]
    np.testing.assert_allclose(profile.roots, (profile.values - found.params["slope"]) / error, atol=1e-5)
    others = np.mean(args[0] - profile.values[:, None] * TIMES, axis=1)
    np.testing.assert_allclose(profile.params["at_zero"], others, rtol=1e-6)
    for level in (0.5, 0.95):
        half = student.ppf(0.5 + level / 2.0, len(TIMES) - 2) * error
        expected = found.params["slope"] - half, found.params["slope"] + half
        np.testing.assert_allclose(profile.interval(level), expected, rtol=1e-6)
    assert np.all(profile.converged)
    assert "95%" in str(profile)


def decay(params, data):
    return params["size"] * jnp.exp(-params["rate"] * TIMES) - data


def test_of_a_bent_residual_it_is_that_of_the_likelihood():
    """Two parameters, of which the other one has a closed form at each value."""
    data = 3.0 * np.exp(-0.7 * TIMES) + 0.4 * np.random.default_rng(5).normal(size=TIMES.shape)
    found = lx.fit(decay, {"size": 2.0, "rate": 1.0}, (data,), tolerance=1e-10)
    profile = lx.profile(decay, found, "rate", (data,), count=41)

    def loss(rate):
        shape = np.exp(-rate * TIMES)
        return 0.5 * np.sum((shape * (shape @ data) / (shape @ shape) - data) ** 2)

    np.testing.assert_allclose(profile.losses, list(map(loss, profile.values)), rtol=1e-7)
    best = minimize_scalar(loss, (0.4, 1.0), tol=1e-12)
    freedom = len(TIMES) - 2
    threshold = best.fun * (1.0 + student.ppf(0.975, freedom) ** 2 / freedom)
    above = lambda rate: loss(rate) - threshold
    exact = brentq(above, 0.01, best.x), brentq(above, best.x, 10.0)
    np.testing.assert_allclose(profile.interval(), exact, rtol=1e-3)
    assert found.interval()[1]["rate"] < 0.98 * exact[1]  # which the covariance does not see


def test_values_of_ones_own_and_a_refit_that_fails():
    """The one beyond which the function is not finite is marked, and the others are as without it."""

    def broken(params, data):
        return line(params, data) + jnp.where(params["slope"] > 0.6, jnp.nan, 0.0)

    found, args = fitted_line()
    values = [0.7, 0.5, 0.4, 0.3]
    with pytest.warns(UserWarning, match="does not rise to the threshold of 95 % above"):
        profile = lx.profile(broken, found, "slope", args, values=values)
    whole = lx.profile(line, found, "slope", args, values=values)
    np.testing.assert_array_equal(profile.values, np.sort(values))
    np.testing.assert_array_equal(profile.converged, [True, True, True, False])
    np.testing.assert_allclose(profile.losses[:3], whole.losses[:3], rtol=1e-12)
    assert profile.interval()[1] == np.inf
    assert np.isfinite(profile.interval()[0])


def test_a_flat_profile_is_told():
    data = 2.0 * TIMES + 0.1 * np.random.default_rng(0).normal(size=TIMES.shape)
    residual = lambda params, data: params["a"] * params["b"] * TIMES - data
    with pytest.warns(UserWarning, match="do not determine"):
        found = lx.fit(residual, {"a": 1.5, "b": lx.Positive(1.0)}, (data,))
    with pytest.warns(UserWarning, match=r"'b' does not rise.*\n?.*do not determine"):
        profile = lx.profile(residual, found, "b", (data,))
    np.testing.assert_allclose(profile.losses, found.loss, rtol=1e-6)
    assert profile.interval() == (-np.inf, np.inf)
    assert np.ptp(np.log(profile.values)) > 1.9
    with pytest.raises(ValueError, match="do not determine 'a', 'b', so no draws"):
        found.sample(jax.random.key(0), 3)


def test_of_one_parameter_nothing_is_refitted():
    found = lx.fit(lambda p: p["x"] * TIMES - 2.0 * TIMES - np.sin(9.0 * TIMES), {"x": 1.0})
    profile = lx.profile(lambda p: p["x"] * TIMES - 2.0 * TIMES - np.sin(9.0 * TIMES), found, "x")
    lower, upper = found.interval()
    np.testing.assert_allclose(profile.interval(), (lower["x"], upper["x"]), rtol=1e-6)


def test_draws_of_a_fit_have_its_covariance_and_stay_in_bounds():
    found, _ = fitted_line()
    draws = found.sample(jax.random.key(1), 20000)
    stacked = np.stack([draws[name] for name in found.names])
    correlation = lambda covariance: covariance / np.sqrt(np.outer(*2 * [np.diagonal(covariance)]))
    np.testing.assert_allclose(np.mean(stacked, axis=1), [found.params[name] for name in found.names], atol=3e-3)
    np.testing.assert_allclose(np.std(stacked, axis=1), np.sqrt(np.diagonal(found.covariance)), rtol=0.03)
    np.testing.assert_allclose(correlation(np.cov(stacked)), correlation(found.covariance), atol=0.03)
    bounded, _ = fitted_from({"slope": lx.Bounded(0.4, 0.0, 0.55), "at_zero": lx.Positive(1.0)})
    draws = bounded.sample(jax.random.key(2), 500)
    assert np.all((draws["slope"] > 0.0) & (draws["slope"] < 0.55))
    assert draws["at_zero"].shape == (500,)


LOSS = lx.fit(lambda p: (p["x"] - 1.0) ** 2, {"x": 0.0}, steps=2)
BODY = {"body": lx.PhysicalInertia(1.0), "x": 1.0}
BAD = {
    "function": [None, 3, lambda p, data: 2.0 * line(p, data)],
    "found": [None, 3, LOSS],
    "name": ["mass", None, 0],
    "args": [3.0, "measured", (object(),)],
    "values": ["far", [], [np.nan], 1.0, [1.0j], [0.4, 0.5, 0.5]],
    "count": [2, 1.5],
    "steps": [0, "many"],
    "tolerance": [-1.0, np.nan],
}


@pytest.mark.parametrize("name", BAD)
def test_bad_profiles_are_named(name):
    found, args = fitted_line()
    good = {"function": line, "found": found, "name": "slope", "args": args}
    for value in BAD[name]:
        words = [] if value is LOSS else [name]
        refused(lambda value=value: lx.profile(**(good | {name: value})), *words)


def test_values_out_of_bounds_are_named():
    found, args = fitted_from({"slope": lx.Bounded(0.4, 0.0, 1.0), "at_zero": 1.0})
    refused(lambda: lx.profile(line, found, "slope", args, values=[0.5, 1.5]), "1.5", "slope", "bounds")


def test_a_prior_is_a_part_of_the_likelihood():
    """Of a number that the data do not touch, the interval is that of the prior."""
    measured = 1.0 + 0.1 * np.random.default_rng(0).normal(size=20)
    residual = lambda params, measured: (params["mean"] - measured) / 0.1
    found = lx.fit(residual, {"mean": 0.5, "free": lx.Normal(1.0, 0.3)}, (measured,), progress=False)
    lower, upper = lx.profile(residual, found, "free", (measured,)).interval(0.95)
    wide = 0.3 * student.ppf(0.975, 19)
    np.testing.assert_allclose([lower, upper], [1.0 - wide, 1.0 + wide], rtol=1e-3)


def test_what_cannot_be_profiled():
    residual = lambda params: params["x"] - jnp.array([1.0, 1.1, 0.9])
    found = lx.fit(residual, {"x": 0.5}, progress=False)
    with pytest.raises(ValueError, match=r"some come twice"):
        lx.profile(residual, found, "x", values=[0.9, 1.1, 1.1])
