"""Tolerances: expansions against closed forms, samples against both, and what fails told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar
from refusals import refused
from scipy import stats

import linkax as lx

QUIET = {"progress": False}


def analytic(function, params, deviations, **options):
    return lx.tolerance_analysis(function, params, deviations, samples=0, **options)


def test_a_linear_function_is_exact_to_all_orders():
    rows = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1.0]])
    correlation = [[1.0, 0.4, -0.2], [0.4, 1.0, 0.0], [-0.2, 0.0, 1.0]]
    spreads = np.array([0.1, 0.2, 0.3])
    covariance = np.diag(spreads) @ correlation @ np.diag(spreads)
    found = lx.tolerance_analysis(
        lambda p: {"sum": rows @ jnp.stack([p["a"], *p["b"]]), "many": jnp.arange(3)},
        {"a": 1, "b": [2.0, 3.0], "exact": 7.0},
        {"a": 0.1, "b": [0.2, 0.3], "exact": 0.0},
        correlation=correlation,
        **QUIET,
    )
    assert found.names == ["a", "b.0", "b.1"]
    variance = np.diag(rows @ covariance @ rows.T)
    np.testing.assert_allclose(found.covariance, covariance, atol=1e-15)
    np.testing.assert_allclose(found.sensitivities["sum"], rows, rtol=1e-12)
    for moments in (found.first, found.second):
        assert moments.mean["many"] is None
        np.testing.assert_allclose(moments.mean["sum"], rows @ [1.0, 2.0, 3.0], rtol=1e-12)
        np.testing.assert_allclose(moments.standard_deviation["sum"], np.sqrt(variance), rtol=1e-12)
    np.testing.assert_allclose(found.contributions["sum"], rows * (rows @ covariance) / variance[:, None], rtol=1e-12)
    lowest, highest = (worst["sum"] for worst in found.worst_case)
    np.testing.assert_allclose(highest - lowest, 2.0 * 3.0 * np.abs(rows) @ spreads, rtol=1e-12)
    np.testing.assert_allclose(found.samples.standard_deviation["sum"], np.sqrt(variance), rtol=1e-2)
    np.testing.assert_allclose(found.samples.mean["sum"], rows @ [1.0, 2.0, 3.0], atol=1e-3)


T = 0.6
DISTRIBUTIONS = {
    "normal": (0.3, stats.norm(scale=0.3)),
    "uniform": (stats.uniform(-T, 2 * T),) * 2,
    "one-sided": (stats.uniform(0.0, T),) * 2,
    "skewed": (stats.triang(0.1, -0.1, 1.0),) * 2,
    "unbounded": (stats.gamma(3.0, scale=0.2),) * 2,
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_a_quadratic_function_has_its_mean_and_variance(name):
    """Against the moments of the distribution, as SciPy integrates them."""
    deviation, exact = DISTRIBUTIONS[name]
    square = lambda x: 2.0 + 0.7 * x + 1.3 * x**2
    found = lx.tolerance_analysis(lambda p: square(p["x"]), {"x": 1.0}, {"x": deviation}, samples=4096, **QUIET)
    mean = exact.expect(lambda x: square(1.0 + x))
    deviation = np.sqrt(exact.expect(lambda x: (square(1.0 + x) - mean) ** 2))
    np.testing.assert_allclose(found.second.mean, mean, rtol=1e-7)
    np.testing.assert_allclose(found.second.standard_deviation, deviation, rtol=1e-7)
    first = abs(0.7 + 2.6 * (1.0 + exact.mean())) * exact.std()
    np.testing.assert_allclose(found.first.standard_deviation, first, rtol=1e-12)
    errors = found.samples.standard_errors
    assert abs(found.samples.mean - mean) < 3.0 * errors.mean
    assert abs(found.samples.standard_deviation - deviation) < 3.0 * errors.standard_deviation
    ends = np.array(exact.support())
    ends = np.where(np.isfinite(ends), ends, exact.mean() + 3.0 * exact.std() * np.array([-1.0, 1.0]))
    slope = 0.7 + 2.6 * (1.0 + exact.mean())
    np.testing.assert_allclose(found.worst_case, square(1.0 + exact.mean()) + slope * (ends - exact.mean()), rtol=1e-12)


def test_the_product_of_two_correlated_numbers():
    """Var(x y) = μ² (σ² + τ²) + 2 μ² ρ σ τ + σ² τ² (1 + ρ²) at means μ."""
    for rho in (0.6, -1.0):
        found = analytic(
            lambda p: p["x"] * p["y"], {"x": 2.0, "y": 2.0}, {"x": 0.3, "y": 0.5}, correlation=[[1.0, rho], [rho, 1.0]]
        )
        np.testing.assert_allclose(found.second.mean, 4.0 + rho * 0.15, rtol=1e-12)
        variance = 4.0 * (0.09 + 0.25 + 2.0 * rho * 0.15) + 0.0225 * (1.0 + rho**2)
        np.testing.assert_allclose(found.second.standard_deviation, np.sqrt(variance), rtol=1e-12)


def test_sobol_indices_of_ishigamis_function():
    """Ishigami and Homma, An importance quantification technique, ISUMA 1990; the closed forms of its variances."""
    a, b = 7.0, 0.1
    ishigami = lambda p: (
        1e3 + jnp.stack([jnp.sin(p[0]) + a * jnp.sin(p[1]) ** 2 + b * p[2] ** 4 * jnp.sin(p[0]), 0.0 * p[0]])
    )
    everywhere = stats.uniform(-np.pi, 2.0 * np.pi)
    found = lx.tolerance_analysis(ishigami, np.zeros(3), everywhere, samples=4096, indices=True, order=1, **QUIET)
    assert found.second is None
    ones = [0.5 * (1.0 + b * np.pi**4 / 5.0) ** 2, a**2 / 8.0, 0.0]
    both = b**2 * np.pi**8 * 8.0 / 225.0
    variance = sum(ones) + both
    indices = found.samples.indices
    assert indices.count == 4096
    np.testing.assert_allclose(indices.first[0], np.array(ones) / variance, atol=0.01)
    np.testing.assert_allclose(indices.total[0], np.array([ones[0] + both, ones[1], both]) / variance, atol=0.01)
    np.testing.assert_array_equal(indices.first[1], 0.0)
    np.testing.assert_allclose(found.samples.standard_deviation[0], np.sqrt(variance), rtol=0.01)
    assert "0.31, 0.56" in repr(found)


def test_quantiles_and_yield():
    found = lx.tolerance_analysis(lambda p: {"x": p, "y": jnp.stack([2.0 * p, p])}, 1.0, 0.1, samples=4096, **QUIET)
    samples = found.samples
    np.testing.assert_allclose(samples.quantile(0.975)["y"], [2.0 + 0.2 * 1.96, 1.0 + 0.1 * 1.96], rtol=1e-3)
    share, (low, high) = samples.within({"x": 0.9}, {"y": np.array([2.2, 9.0])})
    assert abs(share - 0.6827) < 2e-3
    assert low < share < high
    assert high - low < 0.03
    assert samples.within()[0] == 1.0
    assert abs(samples.within(1.0)[0] - 0.5) < 1e-3
    assert samples.within(upper={"y": 9.0})[1][0] > 0.99


def test_samples_that_fail_are_counted_and_left_out():
    """A root that there is for positive x alone, with the mean at 2.5 standard deviations from zero."""
    found = lx.tolerance_analysis(
        lambda p: {"root": jnp.sqrt(p["x"]), "sum": p["x"] + p["y"]},
        {"x": 1.0, "y": 0.0},
        {"x": 0.4, "y": 1.0},
        indices=True,
        **QUIET,
    )
    samples = found.samples
    failed = np.flatnonzero(1.0 + samples.deviations[:, 0] < 0.0)
    assert 4 <= len(failed) <= 9
    assert list(samples.sweep.failed) == failed.tolist()
    np.testing.assert_array_equal(np.flatnonzero(~samples.ok), failed)
    np.testing.assert_allclose(
        samples.mean["root"], np.mean(np.sqrt(np.delete(1.0 + samples.deviations[:, 0], failed)))
    )
    assert samples.within()[0] == 1.0 - len(failed) / 1024
    assert samples.indices.count == 512
    np.testing.assert_allclose(samples.indices.total["root"], [1.0, 0.0], atol=0.05)
    assert f"1024, {len(failed)} of them failed" in repr(found)
    assert "not finite" in repr(found)


def test_options_reach_the_sweep(tmp_path):
    run = lambda: lx.tolerance_analysis(
        lambda p: p["x"] ** 2, {"x": 1.0}, {"x": 0.1}, samples=64, store=tmp_path, **QUIET
    )
    first, again = run(), run()
    np.testing.assert_array_equal(first.samples.output, again.samples.output)
    assert np.isnan(again.samples.sweep.seconds_per_member)


def bent(params):
    return jnp.stack([params["x"] ** 2 * params["y"], jnp.sin(params["y"]) * params["x"], params["x"] ** 2])


@pytest.mark.parametrize("order", ["first", "second"])
def test_derivatives_by_parameters_and_deviations(order):
    def spread(numbers):
        params, deviations = {"x": numbers[0], "y": numbers[1]}, {"x": numbers[2], "y": numbers[3]}
        found = getattr(analytic(bent, params, deviations), order)
        return jnp.concatenate([found.mean, found.standard_deviation])

    at = jnp.array([1.2, 0.7, 0.1, 0.2])
    forward, reverse = jax.jit(jax.jacfwd(spread))(at), jax.jit(jax.jacrev(spread))(at)
    steps = 1e-5 * np.eye(4)
    numeric = np.stack([(spread(at + step) - spread(at - step)) / 2e-5 for step in steps], axis=-1)
    np.testing.assert_allclose(forward, numeric, atol=1e-9)
    np.testing.assert_allclose(reverse, forward, atol=1e-12)


ANGLES = jnp.array([1.0, np.pi])  # the latter near the toggle position, in which coupler and rocker are one line
LENGTHS = {"crank": 0.4, "coupler": 0.55, "rocker": 0.9}


def at_angle(params, angle):
    """A four-bar's rocker angle at an angle of its crank [rad], and whether it can be assembled there."""
    mechanism = four_bar(params["crank"], params["coupler"], params["rocker"], cut="rocker_pin")
    guess = {"crank_pin": 0.8 - angle, "rocker_bearing": 2.6}
    here = lx.Solution.of_state(mechanism, lx.assemble(mechanism, {"crank_bearing": angle}, guess=guess))
    return {"rocker": here.joint("rocker_bearing")[0], "result": here.result}


def at_angles(params):
    return jax.vmap(lambda angle: at_angle(params, angle))(ANGLES)


@pytest.mark.slow
def test_a_four_bar_near_its_toggle_position():
    """Derivatives of the closed loop |d + c e^{iψ} − a e^{iφ}|² = b²; samples tell which order is right, some fail."""
    deviations = {name: 0.0087 for name in LENGTHS}
    found = lx.tolerance_analysis(at_angles, LENGTHS, deviations, samples=4096, **QUIET)
    a, b, c = (LENGTHS[name] for name in ("crank", "coupler", "rocker"))
    psi = np.asarray(found.first.mean["rocker"])
    to_tip = 1.0 + c * np.exp(1j * psi) - a * np.exp(1j * np.asarray(ANGLES))
    np.testing.assert_allclose(np.abs(to_tip), b, rtol=1e-12)
    along = lambda change: np.real(np.conj(to_tip) * change)
    by_psi = along(1j * c * np.exp(1j * psi))
    by_length = {"coupler": b, "crank": along(np.exp(1j * np.asarray(ANGLES))), "rocker": -along(np.exp(1j * psi))}
    slopes = np.stack([by_length[name] / by_psi for name in found.names], axis=-1)
    np.testing.assert_allclose(found.sensitivities["rocker"], slopes, rtol=1e-10)
    np.testing.assert_allclose(found.first.standard_deviation["rocker"], 0.0087 * np.linalg.norm(slopes, axis=1))
    samples, error = found.samples, found.samples.standard_errors.mean["rocker"]
    off = {
        order: np.abs(getattr(found, order).mean["rocker"] - samples.mean["rocker"]) / error
        for order in ("first", "second")
    }
    assert np.all(off["second"] < 1.5)
    assert off["first"][1] > 4.0
    # Those whose lengths cannot reach.
    lengths = {name: LENGTHS[name] + samples.deviations[:, index] for index, name in enumerate(found.names)}
    cannot = 1.0 + lengths["crank"] > lengths["coupler"] + lengths["rocker"]
    np.testing.assert_array_equal(~samples.ok, cannot)
    assert 1 <= np.sum(cannot) <= 5
    assert "cannot be closed" in repr(found)


@pytest.mark.slow
def test_a_derivative_of_a_closed_loops_tolerances():
    """By a length and by its deviation, backwards, against those of the angle in closed form, by the law of cosines."""

    def closed_form(params):
        reach = params["crank"] * jnp.exp(1j * ANGLES[0]) - 1.0
        b, c, k = params["coupler"], params["rocker"], jnp.abs(reach)
        return {"rocker": jnp.angle(reach) - jnp.arccos((k**2 + c**2 - b**2) / (2.0 * c * k))}

    def spread(function):
        def of(crank, deviation):
            params, deviations = LENGTHS | {"crank": crank}, {"crank": deviation, "rocker": 0.01}
            return analytic(function, params, deviations, order=1).first.standard_deviation["rocker"]

        return jax.jit(jax.value_and_grad(of, argnums=(0, 1)))(0.4, 0.01)

    found, known = spread(lambda params: at_angle(params, ANGLES[0])), spread(closed_form)
    np.testing.assert_allclose(jax.tree.leaves(found), jax.tree.leaves(known), rtol=1e-8)


BAD = {
    "function": [None, "sine"],
    "params": [None, {}, {"x": "one"}, {"x": np.nan}, {"x": True}, {"x": lx.Positive(1.0)}],
    "deviations": [
        None, {}, 0.0, {"x": 0.0}, {"x": -0.1}, {"x": np.nan}, {"x": "small"}, {"z": 0.1}, {"x": {"y": 0.1}}, [0.1],
        {"x": [0.1, 0.2]}, {"x": np.array([0.1, 0.2])}, {"x": stats.cauchy()}, {"x": stats.uniform([0.0, 1.0])},
    ],
    "correlation": [
        [[1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]], [[2.0, 0.0], [0.0, 2.0]], "some",
        [[1.0, np.nan], [np.nan, 1.0]],
    ],
    "order": [0, 3, 1.5, "first"],
    "samples": [-1, 1, 1000, 2.0, "many"],
    "indices": ["yes", 1],
    "seed": [-1, 0.5, None],
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_named(name):
    good = {"function": bent, "params": {"x": 1.0, "y": 2.0}, "deviations": {"x": 0.1, "y": 0.1}, "samples": 64} | QUIET
    for value in BAD[name]:
        refused(lambda value=value: lx.tolerance_analysis(**good | {name: value}), {"params": "param"}.get(name, name))


def test_what_cannot_be_told_is_named():
    run = lambda function, deviations=0.1, at=1.0, **options: lx.tolerance_analysis(
        function, {"x": at, "y": 2.0}, deviations, **({"samples": 64} | QUIET | options)
    )
    refused(lambda: run(lambda p: {"many": jnp.arange(3)}), "many", "real numbers")
    refused(lambda: run(lambda p: p["x"] * jnp.array(1j)), "real numbers")
    refused(lambda: run(lambda p: jnp.log(p["x"]), at=-1.0), "mean of the parameters", "not finite")
    refused(lambda: run(lambda p: jnp.sqrt(p["x"]) * p["y"], at=0.0), "first derivative", "'x'")
    refused(lambda: run(lambda p: p["y"] + jnp.abs(p["x"]) ** 1.5, at=0.0), "second derivative", "'x'")
    refused(lambda: run(lambda p: jnp.sqrt(1e-9 - (p["x"] - 1.0) ** 2), samples=2), "0 of 2 samples", "not finite")
    refused(lambda: run(bent, {"x": 0.1}, indices=True), "indices", "x")
    refused(lambda: run(bent, indices=True, samples=0), "indices", "samples")
    refused(lambda: run(bent, indices=True, correlation=[[1.0, 0.5], [0.5, 1.0]]), "indices", "independently")
    refused(lambda: run(bent, {"x": stats.uniform(), "y": 0.1}, correlation=[[1.0, 0.5], [0.5, 1.0]]), "'x'", "normal")
    refused(lambda: jax.jit(lambda at: run(bent, at=at).first.mean)(1.0), "samples", "64")
    samples = run(bent).samples
    refused(lambda: samples.quantile(1.5), "share", "1.5")
    refused(lambda: samples.within(level=1.0), "level", "1.0")
    for limit in ("low", np.nan, np.zeros(2), {"x": 1.0}):
        refused(lambda limit=limit: samples.within(limit), "lower")
