"""Fits from random starts, on bounds too, are right, or it is told; what lies on a bound is named, and has no error."""

import warnings
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from mechanisms import pendulum
from scipy.stats import t as student

import linkax as lx

X = np.linspace(0.05, 1.0, 40)
NOISE = 0.01 * np.sin(37.0 * np.arange(40) ** 1.5)
SAVED = {"t1": 1.0, "saveat": diffrax.SaveAt(ts=X), "throw": False}


def swing(p):
    mechanism = pendulum(length=p["length"], forces=[lx.JointDamper("hinge", p["damping"])])
    return lx.simulate(mechanism, lx.State(jnp.array([-0.6]), jnp.zeros(1)), **SAVED).joint("hinge")


def sprung(p):
    block = lx.point_mass("block", 1.0)
    forces = [lx.JointSpring("guide", p["stiffness"]), lx.JointDamper("guide", p["damping"])]
    mechanism = lx.Mechanism([block], [lx.Prismatic("guide", lx.GROUND, block, axis="x")], forces)
    return lx.simulate(mechanism, lx.State(jnp.array([1.0]), jnp.zeros(1)), **SAVED).joint("guide")


def resonance(p):
    square = (X / p["frequency"]) ** 2
    return 1.0 / jnp.sqrt((1.0 - square) ** 2 + 4.0 * p["damping"] ** 2 * square)


def line(p):
    return p["a"] * X + p["b"]


def bounded(*bounds):
    return partial(lx.Bounded, lower=bounds[0], upper=bounds[1]), bounds


def positive(*range_of_starts):
    return lx.Positive, range_of_starts


# What is predicted, the truth, and of each parameter its kind and between which numbers it starts.
MODELS = {
    "line": (line, (2.0, -0.3), {"a": bounded(0.0, 5.0), "b": bounded(-1.0, 1.0)}),
    "decay": (
        lambda p: p["size"] * jnp.exp(-p["rate"] * X),
        (3.0, 1.5),
        {"size": bounded(0.0, 10.0), "rate": bounded(0.0, 20.0)},
    ),
    "optimum beyond a bound": (line, (3.0, 0.2), {"a": bounded(0.0, 2.5), "b": bounded(-1.0, 1.0)}),
    "optimum near a bound": (
        lambda p: p["a"] * X + p["b"] * X**2,
        (1.0, 0.003),
        {"a": bounded(0.0, 5.0), "b": bounded(0.0, 3.0)},
    ),
    "hard to tell apart": (
        lambda p: p["a"] * X + p["b"] * (X + 0.01 * jnp.sin(9.0 * X)),
        (1.0, 2.0),
        {"a": bounded(-20.0, 20.0), "b": bounded(-20.0, 20.0)},
    ),
    "saturation": (
        lambda p: p["most"] * X / (p["half"] + X),
        (3.0, 0.4),
        {"most": positive(1e-3, 1e3), "half": positive(1e-3, 1e3)},
    ),
    "resonance": (resonance, (0.6, 0.2), {"frequency": positive(0.05, 5.0), "damping": bounded(0.0, 1.0)}),
    "optimum below zero": (
        lambda p: p["a"] * X**2 + p["b"] * X,
        (-0.5, 2.0),
        {"a": positive(1e-3, 1e3), "b": positive(1e-3, 1e3)},
    ),
    "pendulum": (swing, (1.0, 0.5), {"length": bounded(0.3, 4.0), "damping": bounded(0.0, 5.0)}),
    "spring and mass": (sprung, (20.0, 0.4), {"stiffness": positive(0.1, 100.0), "damping": bounded(0.0, 5.0)}),
}
QUICK = ("optimum beyond a bound", "optimum below zero", "resonance")


def starts(kinds, count):
    """At random; each fourth one of `Bounded` within 1e-12 to 1e-1 of the range from a bound, or on it."""
    draw = np.random.default_rng(7)
    for i in range(count):
        start = {}
        for name, (kind, (low, high)) in kinds.items():
            place = draw.uniform()
            if kind is lx.Positive:
                start[name] = kind(low * (high / low) ** place)
                continue
            if i % 4 == 0:
                near = 0.0 if i % 8 == 0 else 10.0 ** -draw.uniform(1.0, 12.0)
                place = abs(np.round(place) - near)
            start[name] = kind(low + (high - low) * place)
        yield start


@pytest.mark.parametrize(
    ("model", "count"),
    [*((model, 10) for model in QUICK), *(pytest.param(model, 200, marks=pytest.mark.slow) for model in MODELS)],
)
def test_fits_from_random_starts_are_right_or_it_is_told(model, count):
    """With the least loss that any of them found; and nearly all are right."""
    predict, truth, kinds = MODELS[model]
    data = np.asarray(jax.jit(predict)(dict(zip(kinds, truth, strict=True)))) + NOISE
    residual = lambda p, data: predict(p) - data
    found = []
    for start in starts(kinds, count):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found.append((lx.fit(residual, start, (data,)), told))
    best = min(fit.loss for fit, _ in found)
    right = [fit.loss <= best * (1.0 + 1e-4) for fit, _ in found]
    for (fit, told), is_right in zip(found, right, strict=True):
        assert is_right or told or fit.ended != "converged", fit
    assert np.mean(right) > 0.97


def scaled(p, data):
    return p["a"] * X - data


DATA = 2.0 * X + NOISE
EXACT = float(X @ DATA / (X @ X))
AT_BOUNDS = [lx.Bounded(a, 0.0, 5.0) for a in (0.0, 1e-12, 4.9, 5.0 - 1e-12, 5.0)]


@pytest.mark.parametrize("solver", [None, optx.LevenbergMarquardt(1e-9, 1e-9), optx.GaussNewton(1e-9, 1e-9)])
def test_a_start_on_a_bound_holds_nothing(solver):
    for start in [*AT_BOUNDS, lx.Positive(1e-9)][: None if solver is None else len(AT_BOUNDS)]:
        found = lx.fit(scaled, {"a": start}, (DATA,), optimiser=solver)
        assert found.ended == "converged"
        np.testing.assert_allclose(found.params["a"], EXACT, rtol=1e-6)
    places = np.array([float(start.value) for start in AT_BOUNDS])
    several = lx.fit(scaled, {"a": AT_BOUNDS[0]}, (DATA,), optimiser=solver, starts={"a": places}).starts
    np.testing.assert_allclose(several.params["a"], EXACT, rtol=1e-6)


@pytest.mark.parametrize("optimiser", [optax.adam(0.02), optax.lbfgs()])
def test_losses_from_bounds_and_to_them(optimiser):
    """By any optimiser; one whose best value lies beyond is named."""
    loss = lambda p, data: jnp.sum(scaled(p, data) ** 2)
    for start in AT_BOUNDS:
        found = lx.fit(loss, {"a": start}, (DATA,), optimiser=optimiser, patience=30)
        np.testing.assert_allclose(found.params["a"], EXACT, rtol=1e-2)
        assert not found.on_bound
    with pytest.warns(UserWarning, match=r"on a bound, or beyond it, of 'a' \(the upper one\)"):
        found = lx.fit(loss, {"a": lx.Bounded(0.5, 0.0, 1.5)}, (DATA,), optimiser=optimiser, patience=30)
    assert found.on_bound == {"a": "upper"}


@pytest.mark.parametrize(
    ("kind", "slope", "side"),
    [(lx.Positive(1.0), -0.02, "lower"), (lx.Positive(1.0), -2.0, "lower"), (lx.Bounded(0.5, 0.0, 1.0), 1.01, "upper")],
)
def test_what_lies_on_a_bound_is_named_and_has_no_error(kind, slope, side, tmp_path):
    """Others are as in a regression with the bound, and its interval is that of the likelihood, as the profile says."""
    data, sign = slope * X + 0.3 + NOISE, 1.0 if side == "lower" else -1.0
    with pytest.warns(UserWarning, match=rf"on a bound, or beyond it, of 'a' \(the {side} one\)"):
        found = lx.fit(lambda p, data: line(p) - data, {"a": kind, "b": 1.0}, (data,))
    bound = 0.0 if side == "lower" else 1.0
    assert found.on_bound == {"a": side}
    np.testing.assert_allclose(found.params["a"], bound, atol=1e-6)
    left = data - bound * X - np.mean(data - bound * X)
    variance = left @ left / (len(X) - 1)
    np.testing.assert_allclose(found.standard_errors["b"] ** 2, variance / len(X), rtol=1e-3)
    assert np.isnan(found.standard_errors["a"])
    # The loss with b at its best, of a at a distance d inside: rises by g d + S d² / 2.
    apart = X - np.mean(X)
    g, curvature = sign * (bound * apart - (data - np.mean(data))) @ apart, apart @ apart
    times = student.ppf(0.975, len(X) - 1)
    d = (np.sqrt(g**2 + curvature * times**2 * variance) - g) / curvature
    expected = sorted([bound, bound + sign * d])
    ends = [float(end["a"]) for end in found.interval(0.95)]
    np.testing.assert_allclose(ends, expected, rtol=1e-3, atol=1e-8)
    profile = lx.profile(lambda p, data: line(p) - data, found, "a", (data,))
    np.testing.assert_allclose(profile.interval(0.95), expected, rtol=1e-2, atol=1e-8)
    assert f"{bound:g} (bound)" in str(profile)
    draws = found.sample(jax.random.key(0), 200)
    np.testing.assert_allclose(draws["a"], bound, atol=1e-6)
    np.testing.assert_allclose(np.std(draws["b"]), found.standard_errors["b"], rtol=0.2)
    assert f"on its {side} bound" in str(found)
    assert f"on its {side} bound" in found.report(tmp_path / "fit.html").read_text()


@pytest.mark.parametrize("start", [0.0, lx.Bounded(0.0, 0.0, 1.0), lx.Bounded(1e-12, 0.0, 1.0), lx.Bounded(0.0, -1, 1)])
def test_a_start_without_slope_is_left(start):
    """A damping ratio enters by its square, so that zero is a saddle, which no step by slopes leaves."""
    data = np.asarray(resonance({"frequency": 0.6, "damping": 0.2})) + NOISE
    residual = lambda p, data: resonance(p) - data
    from_inside = lx.fit(residual, {"frequency": 0.5, "damping": 0.1}, (data,))
    for frequency in (0.3, 0.8, 1.2):
        found = lx.fit(residual, {"frequency": lx.Positive(frequency), "damping": start}, (data,))
        np.testing.assert_allclose(found.params["frequency"], from_inside.params["frequency"], rtol=1e-6)
        np.testing.assert_allclose(np.abs(found.params["damping"]), from_inside.params["damping"], rtol=1e-6)
    alone = lx.fit(lambda p: p["damping"] ** 2 - 0.04 + NOISE, {"damping": start})
    np.testing.assert_allclose(alone.params["damping"] ** 2, 0.04 - np.mean(NOISE), rtol=1e-6)


def test_without_damping_the_start_stays():
    """Where the loss rises along it, and where the parameter has no influence at all."""
    data = np.asarray(resonance({"frequency": 1.6, "damping": 0.0})) + 0.1 * NOISE
    with pytest.warns(UserWarning, match="do not determine 'damping', 'idle'"):
        found = lx.fit(
            lambda p, data: resonance(p) + 0.0 * p["idle"] - data,
            {"frequency": lx.Positive(1.8), "damping": lx.Bounded(0.0, 0.0, 1.0), "idle": 1.0},
            (data,),
        )
    assert (found.params["damping"], found.params["idle"]) == (0.0, 1.0)


def test_a_loss_without_slope_is_told():
    loss = lambda p: (p["x"] ** 2 - 1.0) ** 2 + (p["y"] - 2.0) ** 2 + (p["z"] - 1.0) ** 2
    with pytest.warns(UserWarning, match="do not determine 'x': a small change of it leaves the loss"):
        found = lx.fit(loss, {"x": 0.0, "y": 1.0, "z": 1.0}, patience=20)
    assert found.undetermined == ["x"]


def test_an_interval_ends_at_a_bound():
    """Of a best value inside, too, and so does its profile."""
    data = -0.003 * X + 0.3 + NOISE
    free, held = (
        lx.fit(lambda p, data: line(p) - data, {"a": a, "b": 1.0}, (data,)) for a in (0.5, lx.Bounded(0.5, 0.0, 1.0))
    )
    np.testing.assert_allclose(held.covariance, free.covariance, rtol=1e-5)
    low = held.interval()[0]["a"]
    assert free.interval()[0]["a"] < 0.0 == low
    np.testing.assert_allclose(held.interval()[1]["a"], free.interval()[1]["a"], rtol=1e-5)
    profile = lx.profile(lambda p, data: line(p) - data, held, "a", (data,))
    assert profile.interval()[0] == 0.0
    np.testing.assert_allclose(profile.interval()[1], free.interval()[1]["a"], rtol=1e-3)
    draws = held.sample(jax.random.key(0), 300)["a"]
    assert np.min(draws) > 0.0


def test_a_body_without_extent_is_named():
    """The moments that were measured are those of no body: the largest is more than the sum of the others."""
    measured = np.array([0.2, 0.3, 0.6])
    residual = lambda p: (p["body"].mass - 1.0, p["body"].center_of_mass, p["body"].inertia - jnp.diag(measured))
    with pytest.warns(UserWarning, match=r"'body' \(the lower one\)"):
        found = lx.fit(residual, {"body": lx.PhysicalInertia(1.0)})
    assert found.on_bound == {"body": "lower"}
    # The nearest moments, by least squares, of which one is the sum of the others.
    np.testing.assert_allclose(
        np.diagonal(found.params["body"].inertia), measured + np.array([1.0, 1.0, -1.0]) / 30.0, atol=1e-4
    )
