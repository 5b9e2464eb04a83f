"""Fits: known parameters found again, their uncertainty right, and what cannot be found named."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import linkax as lx
from linkax.studies.fits import fit_search

TIMES = np.linspace(0.0, 4.0, 60)


def decay(params):
    return params["size"] * jnp.exp(-params["rate"] * TIMES)


TRUTH = {"size": 3.0, "rate": 0.7}
START = {"size": 1.0, "rate": 2.0}


def measured(seed, noise=0.05):
    return decay(TRUTH) + noise * np.random.default_rng(seed).normal(size=TIMES.shape)


def apart(params, data):
    return decay(params) - data


SOLVERS = [optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9), optx.GaussNewton(rtol=1e-9, atol=1e-9), optax.adam(0.05)]


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_optimiser_finds_the_least_squares(solver):
    start = {"size": 2.0, "rate": 1.0}
    found = lx.fit(apart, start, (measured(0),), optimiser=solver, steps=3000, patience=200)
    best = lx.fit(apart, TRUTH, (measured(0),), tolerance=1e-9)
    for name in TRUTH:
        np.testing.assert_allclose(found.params[name], best.params[name], rtol=1e-5)
    np.testing.assert_allclose(found.loss, best.loss, rtol=1e-9)
    assert found.ended != "out of steps"
    assert len(found.history["loss"]) == found.steps + 1


def test_covariance_and_intervals_are_those_of_linear_regression():
    """Against the textbook, of a straight line."""
    data = 1.0 + 0.5 * TIMES + 0.1 * np.random.default_rng(3).normal(size=TIMES.shape)
    found = lx.fit(lambda p: p["at_zero"] + p["slope"] * TIMES - data, {"slope": 1.0, "at_zero": 2.0})
    assert found.names == ["at_zero", "slope"]
    rows = np.stack([np.ones_like(TIMES), TIMES], axis=1)
    best, left, *_ = np.linalg.lstsq(rows, data, rcond=None)
    covariance = left[0] / (len(TIMES) - 2) * np.linalg.inv(rows.T @ rows)
    np.testing.assert_allclose([found.params["at_zero"], found.params["slope"]], best, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8)
    lower, upper = found.interval(0.95)
    np.testing.assert_allclose(upper["slope"] - lower["slope"], 2 * 2.0017 * np.sqrt(covariance[1, 1]), rtol=1e-4)
    np.testing.assert_allclose(found.standard_errors["slope"], np.sqrt(covariance[1, 1]), rtol=1e-8)


def test_what_the_data_do_not_determine_is_named():
    """Two factors of which only the product matters, and a number that does nothing."""
    data = measured(1)

    def residual(p):
        return p["a"] * p["b"] * jnp.exp(-p["rate"] * TIMES) + 0.0 * p["idle"] - data

    with pytest.warns(UserWarning, match="do not determine 'a', 'b', 'idle'"):
        found = lx.fit(residual, {"a": 1.0, "b": 2.0, "idle": 1.0, "rate": 1.0})
    assert found.undetermined == ["a", "b", "idle"]
    errors = found.standard_errors
    assert np.isinf(errors["a"])
    assert np.isinf(errors["idle"])
    np.testing.assert_allclose(
        errors["rate"], lx.fit(lambda p: decay(p) - data, START).standard_errors["rate"], rtol=1e-5
    )


def test_bounds_hold():
    residual = lambda p: jnp.stack([p["x"] - 5.0, p["y"] + 1.0])
    with pytest.warns(UserWarning, match=r"'x' \(the upper one\), 'y' \(the lower one\)"):
        found = lx.fit(residual, {"x": lx.Bounded(0.5, 0, 2), "y": lx.Positive(1.0)})
    assert 1.9 < found.params["x"] < 2.0
    assert 0.0 < found.params["y"] < 0.1


def test_physical_inertia_is_that_of_a_body():
    inertia = np.array([[0.5, 0.1, 0.0], [0.1, 0.6, -0.05], [0.0, -0.05, 0.7]])
    parameter = lx.PhysicalInertia(2.0, [0.1, -0.2, 0.3], inertia)
    back = parameter.value_of(parameter.free)
    for found, given in zip(back, (2.0, [0.1, -0.2, 0.3], inertia), strict=True):
        np.testing.assert_allclose(found, given, rtol=1e-12, atol=1e-15)
    for seed in range(20):
        mass, _, tensor = parameter.value_of(jnp.asarray(np.random.default_rng(seed).normal(size=10)))
        moments = np.linalg.eigvalsh(tensor)
        assert mass > 0.0
        assert moments[0] > 0.0
        assert moments[2] <= (moments[0] + moments[1]) * (1.0 + 1e-9)
    with pytest.raises(ValueError, match="no body"):
        lx.PhysicalInertia(1.0, inertia=[1.0, 1.0, 3.0])


@pytest.mark.parametrize("off_diagonal", [0.0, 0.1])
def test_physical_inertia_is_found(off_diagonal):
    """Products of inertia that are zero have no influence on the moments, but for rounding."""
    inertia = np.array([[0.5, off_diagonal, 0.0], [off_diagonal, 0.6, 0.0], [0.0, 0.0, 0.7]])
    residual = lambda p: (p["of"].mass - 2.0, p["of"].center_of_mass - 0.3, jnp.diagonal(p["of"].inertia - inertia))
    start = {"of": lx.PhysicalInertia(1.0, [0.5, 0.0, 0.0], inertia)}
    products = ", ".join(f"'of.inertia[{i}, {j}]'" for i in range(3) for j in range(3) if i != j)
    with pytest.warns(UserWarning, match=re.escape(f"do not determine {products}: ")):
        found = lx.fit(residual, start).params["of"]
    for part, exact in zip(residual({"of": found}), (0.0, 0.0, 0.0), strict=True):
        np.testing.assert_allclose(part, exact, atol=1e-9)


def test_killed_and_resumed(tmp_path):
    """A fit that stops after three steps goes on from there, to the same numbers by the same steps."""
    args, file = (measured(2),), tmp_path / "fit.npz"
    whole = lx.fit(apart, START, args)
    part = lx.fit(apart, START, args, steps=3, checkpoint=file)
    assert part.ended == "out of steps"
    rest = lx.fit(apart, START, args, checkpoint=file)
    np.testing.assert_array_equal(rest.history["loss"], whole.history["loss"])
    assert rest.params == whole.params
    with pytest.raises(ValueError, match="holds another fit"):
        lx.fit(lambda p: decay({"size": p["x"], "rate": 1.0}), {"x": 1.0}, checkpoint=file)
    # Of the same names and shapes, from other starts or to other data.
    for start, data in ((jax.tree.map(lambda x: 1.1 * x, START), args), (START, (measured(3),))):
        with pytest.raises(ValueError, match="their start or bounds, the data"):
            lx.fit(apart, start, data, checkpoint=file)


def test_killed_while_it_searched_from_several_starts(tmp_path, monkeypatch):
    """It goes on from the step at which it was killed; starts that have ended are not searched again."""
    starts = {"size": np.array([1.0, 2.5, 1.0]), "rate": np.array([2.0, 0.9, np.inf])}
    given = {"params": START, "args": (measured(2),), "starts": starts}
    whole, save, saved = lx.fit(apart, **given), fit_search._Checkpoint.save, []

    def counted(self, tree, **told):
        save(self, tree, **told)
        saved.append(self.path.name)
        if saved == 4 * ["fit.starts.npz"]:
            raise KeyboardInterrupt

    monkeypatch.setattr(fit_search._Checkpoint, "save", counted)
    with pytest.raises(KeyboardInterrupt):
        lx.fit(apart, **given, checkpoint=tmp_path / "fit.npz")
    assert [file.name for file in tmp_path.iterdir()] == ["fit.starts.npz"]
    for more in (True, False):
        before = len(saved)
        rest = lx.fit(apart, **given, checkpoint=tmp_path / "fit.npz")
        np.testing.assert_array_equal(rest.history["loss"], whole.history["loss"])
        np.testing.assert_array_equal(rest.starts.losses, whole.starts.losses)
        assert rest.starts.ended == whole.starts.ended
        assert rest.ended == whole.ended
        assert (len(saved) > before) == more  # a fit that has ended stays as it is
    other = given | {"starts": jax.tree.map(lambda x: 1.01 * x, starts)}
    with pytest.raises(ValueError, match="holds another fit"):
        lx.fit(apart, **other, checkpoint=tmp_path / "fit.npz")


def test_a_residual_by_reverse_mode_has_the_same_covariance():
    forward, reverse = (lx.fit(apart, START, (measured(2),), mode=mode) for mode in ("forward", "reverse"))
    np.testing.assert_allclose(reverse.covariance, forward.covariance, rtol=1e-6)


def test_a_residual_of_one_entry_is_squared():
    found = lx.fit(lambda p: p["x"][None] - 3.0, {"x": 1.0}, optimiser=optax.adam(0.1), steps=300)
    np.testing.assert_allclose(found.params["x"], 3.0, atol=1e-4)


def test_a_fit_without_noise_says_so(tmp_path):
    """Of data that are exact, and of as many numbers as data; not of one with noise."""
    line, told = lambda p, data: p["a"] + p["b"] * TIMES[: len(data)] - data, "standard errors tell of no noise"
    exact = 3.0 + 2.0 * TIMES
    fits = [lx.fit(line, {"a": 1.0, "b": 1.0}, (data,)) for data in (exact, exact[:2], exact + np.sin(9.0 * TIMES))]
    assert [told in str(found) for found in fits] == [True, True, False]
    assert told in fits[0].report(tmp_path / "fit.html").read_text()


def test_patience_with_losses_below_zero():
    with pytest.warns(UserWarning, match="do not determine 'x': a small change of it leaves the loss"):
        found = lx.fit(lambda p: -1.0 + 0.0 * p["x"], {"x": 1.0}, patience=5)
    assert (found.ended, found.steps) == ("stopped early", 5)


def test_loss_by_gradients_of_either_mode():
    loss = lambda p: jnp.sum((p["x"] - jnp.arange(5.0)) ** 2) + (p["y"] - 2.0) ** 2
    for mode in ("forward", "reverse", None):
        found = lx.fit(loss, {"x": jnp.ones(5), "y": 1.0}, optimiser=optax.lbfgs(), steps=50, mode=mode, patience=5)
        np.testing.assert_allclose(found.params["x"], np.arange(5.0), atol=1e-6)
    with pytest.raises(ValueError, match="fit a residual"):
        found.interval()


def test_bad_input():
    with pytest.raises(ValueError, match="not finite at the parameters"):
        lx.fit(lambda p: jnp.log(p["a"] - jnp.arange(3.0)), {"a": 0.0})
    with pytest.raises(ValueError, match="least squares need a residual"):
        lx.fit(lambda p: p["a"] ** 2, {"a": 1.0}, optimiser=optx.LevenbergMarquardt(1e-6, 1e-6))


OUTPUTS = {
    "None, no numbers": lambda p: None,
    "{}, no numbers": lambda p: {},
    "no numbers": lambda p: {"gap": p["x"] * jnp.zeros(0), "other": ()},
    "int64 in its value, which has no derivative": lambda p: jnp.arange(3) + jnp.round(p["x"]).astype(int),
    "bool in its value, which has no derivative": lambda p: p["x"] > jnp.arange(3),
    "complex numbers in ['gap']": lambda p: {"gap": 1j * p["x"] * TIMES},
    "complex numbers in its value": lambda p: 1j * p["x"],
    "'far' in ['gap']": lambda p: {"gap": "far", "other": p["x"]},
}


@pytest.mark.parametrize("words", OUTPUTS)
def test_what_is_no_residual_is_named(words):
    with pytest.raises(ValueError, match=r"the function returned .*" + re.escape(words)):
        lx.fit(OUTPUTS[words], {"x": 1.0})


ROOT = lambda x: jnp.sqrt(jnp.maximum(x, 0.0))  # without derivative from zero down


@pytest.mark.parametrize("form", [lambda r: r, jnp.sum], ids=["residual", "loss"])
def test_where_there_is_no_derivative_is_told(form):
    with pytest.raises(ValueError, match="no derivative at the parameters where the fit starts"):
        lx.fit(lambda p: form(p["x"] - TIMES + ROOT(p["y"])), {"x": 1.0, "y": 0.0})
    function = lambda p: form((p["x"] - 3.0 - 0.0 * TIMES) ** 2 + 0.0 * jnp.where(p["x"] > 1.05, ROOT(-p["x"]), 1.0))
    with pytest.warns(UserWarning, match="ended 'no derivative': the function is finite"):
        found = lx.fit(function, {"x": 1.0})
    assert found.ended == "no derivative"
    assert found.steps < 20
    with pytest.raises(ValueError, match="has no covariance, it ended 'no derivative'"):
        found.interval()


EDGES = {
    "the best lies beyond": lambda p: jnp.where(p["x"] > 2.0, jnp.nan, p["x"] - 3.0) - TIMES / 100.0,
    "of a flat valley": lambda p: jnp.where(p["x"] > 2.0, jnp.nan, (p["x"] - 2.5) ** 3) - TIMES / 100.0,
    "with another parameter": lambda p: (jnp.where(p["x"] > 2.0, jnp.nan, p["x"] - 3.0), p["y"] - TIMES),
}


@pytest.mark.parametrize("case", EDGES)
def test_a_fit_that_is_stuck_at_an_edge_says_so(case):
    with pytest.warns(UserWarning, match="ended 'at an edge'"):
        found = lx.fit(EDGES[case], {"x": 1.0, "y": 1.0} if "another" in case else {"x": 1.0})
    assert found.ended == "at an edge"
    assert 1.9 < found.params["x"] <= 2.0
    assert found.covariance is None
    assert found.undetermined == []


@pytest.mark.parametrize("best", [1.5, 1.99])
def test_a_minimum_before_an_edge_is_found(best):
    """Though steps on the way to it lead beyond."""
    function = lambda p: jnp.where(p["x"] > 2.0, jnp.nan, jnp.exp(p["x"]) - jnp.exp(best)) - 1e-3 * jnp.sin(9.0 * TIMES)
    found = lx.fit(function, {"x": -1.0})
    assert found.ended == "converged"
    np.testing.assert_allclose(found.params["x"], best, atol=1e-3)
