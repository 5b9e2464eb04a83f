"""Experiments: optima of textbooks, limits that hold, failed runs left aside, and one on a mechanism."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum
from refusals import refused

import linkax as lx


def quadratic(params, design):
    x = design["x"]
    return params["a"] + params["b"] * x + params["c"] * x**2


def test_places_of_measurement_of_a_parabola():
    """The D-optimal design: both ends and the middle (Smith, 1918), where the covariance is known."""
    start = {"x": lx.Bounded([-0.5, 0.1, 0.7], -1.0, 1.0)}
    found = lx.design(quadratic, {"a": 1.0, "b": lx.Positive(1.0), "c": 1.0}, start, tolerance=1e-12)
    np.testing.assert_allclose(found.design["x"], [-1.0, 0.0, 1.0], atol=1e-5)
    rows = np.stack([np.ones(3), [-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]], axis=1)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(rows.T @ rows), atol=1e-4)
    np.testing.assert_allclose(found.standard_errors["a"], 1.0, rtol=1e-4)
    np.testing.assert_allclose(found.history["criterion"][-1], 4.0 ** (-1 / 6), rtol=1e-6)  # det Jᵀ J = 4
    assert found.history["criterion"][0] > 1.1 * found.history["criterion"][-1]
    assert found.active == ["x[0], lower bound", "x[2], upper bound"]
    assert found.ended == "converged"
    assert "x[0], lower bound" in str(found)
    assert "<table>" in found._repr_html_()


NOISES = np.array([1.0, 2.0, 4.0])
SHARES = {"D": np.ones(3), "A": NOISES, "E": NOISES**2}


@pytest.mark.parametrize("criterion", SHARES)
def test_how_often_to_measure_with_which_sensor(criterion):
    """Of one quantity each; the shares of the criteria are those of Lagrange's multipliers."""
    measured = lambda params, design: jnp.sqrt(design["share"]) * params["values"] / NOISES
    design = {"share": lx.Bounded([0.5, 0.2, 0.3], 1e-6, 1.0)}
    limits = lambda params, design: {"share": jnp.sum(design["share"]) - 1.0}
    options = {"criterion": criterion, "limits": limits, "tolerance": 1e-10}
    found = lx.design(measured, {"values": np.ones(3)}, design, **options)
    np.testing.assert_allclose(found.design["share"], SHARES[criterion] / np.sum(SHARES[criterion]), rtol=1e-2)
    assert found.active == ["share"]
    assert abs(found.limits["share"]) < 1e-9


def test_the_best_of_many_sensors_for_the_parameter_that_matters():
    """A slope, beside an unknown offset: the sensors at the ends count, and none between."""
    places = np.linspace(-1.0, 1.0, 5)
    measured = lambda params, design: jnp.sqrt(design) * (params["offset"] + params["slope"] * places)
    limits = lambda params, design: (jnp.sum(design) - 2.0) / 2.0
    start, params = lx.Bounded(0.4 * np.ones(5), 1e-6, 1.0), {"offset": 0.0, "slope": 1.0}
    found = lx.design(measured, params, start, of="slope", limits=limits, tolerance=1e-9)
    np.testing.assert_allclose(found.design, [1.0, 0.0, 0.0, 0.0, 1.0], atol=1e-4)
    np.testing.assert_allclose(found.standard_errors["slope"], np.sqrt(0.5), rtol=1e-4)
    np.testing.assert_allclose(found.history["criterion"][-1], found.standard_errors["slope"], rtol=1e-6)


def test_a_design_whose_run_fails_is_left_aside():
    """Louder is better, until nothing works."""
    measured = lambda params, design: (
        params["x"] * jnp.where(design["loudness"] < 3.0, design["loudness"], jnp.nan)[None]
    )
    with pytest.warns(UserWarning, match="'at an edge'.*where the run fails"):
        found = lx.design(measured, {"x": 1.0}, {"loudness": 1.0})
    assert 2.7 < found.design["loudness"] < 3.0
    assert found.failed > 0
    assert "failed" in str(found)
    np.testing.assert_allclose(found.standard_errors["x"], 1.0 / found.design["loudness"], rtol=1e-9)


def test_limits_that_nothing_meets_are_told():
    with pytest.warns(UserWarning, match="'limits not met'"):
        found = lx.design(
            lambda params, design: params["x"] * design["d"][None],
            {"x": 1.0},
            {"d": lx.Bounded(0.5, 0.0, 1.0)},
            limits=lambda params, design: 2.0 - design["d"],
        )
    assert found.ended == "limits not met"


def test_experiments_are_their_predictions_over_the_noise():
    """As a function written by hand: without missing samples, and with 95 % of what is told through a robust loss."""
    still = lx.Solution.of_state(pendulum(gravity=0.0), lx.State(np.zeros(1), np.zeros(1)))
    motion = dataclasses.replace(  # that turns evenly
        still, ts=jnp.array([0.0, 9.0]), q=jnp.array([[0.3], [4.8]]), v=jnp.array([[0.5], [0.5]])
    )

    def sensors(params, design, own):
        shared = {"bias": params["bias"], "delay": -design["wait"], "noise": 0.1 + 0.1 * design["range"]}
        return {
            "plain": lx.Encoder("hinge", gain=params["gain"], **shared),
            "robust": lx.Encoder("hinge", gain=own * params["gain"], loss="huber", **shared),
        }

    ts, values = np.linspace(1.0, 4.0, 5), np.array([0.0, 0.0, np.nan, 0.0, 0.0])
    channels = {"plain": (ts, values), "robust": (ts[:3], np.zeros(3))}
    experiments = [lx.Experiment(lambda params, design, own: motion, channels, sensors, (own,)) for own in (1.0, 2.0)]

    def by_hand(params, design):
        angles = 0.3 + 0.5 * (ts + design["wait"])
        told = lambda gain, angles: (gain * params["gain"] * angles + params["bias"]) / (0.1 + 0.1 * design["range"])
        robust = [np.sqrt(0.95) * told(own, angles[:3]) for own in (1.0, 2.0)]
        return [told(1.0, angles[np.isfinite(values)])] * 2 + robust

    start = {"wait": lx.Bounded(2.0, 0.0, 4.0), "range": lx.Bounded(0.5, 0.0, 1.0)}
    given = {"params": {"gain": 1.0, "bias": 1.0}, "design": start, "criterion": "A"}
    found, expected = lx.design(experiments, **given), lx.design(by_hand, **given)
    assert found.ended == expected.ended == "converged"
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6)
    np.testing.assert_allclose(found.covariance_before, expected.covariance_before, rtol=1e-9)
    assert found.active == ["range, lower bound", "wait, lower bound"]
    silent = lambda params, design, own: {"plain": lx.Encoder("hinge", delay=-design["wait"])}
    with pytest.raises(ValueError, match="sensor of channel 'plain' has no noise, which a design needs; give it one"):
        lx.design(lx.Experiment(experiments[0].model, channels, silent, (1.0,)), **given)
    with pytest.raises(ValueError, match="an entry of the experiments is 1"):
        lx.design([1.0], **given)


TIMES = jnp.linspace(0.1, 1.0, 10)
KNOTS = np.linspace(0.0, 1.0, 4)


def swung(params, design):
    """A pendulum, swung by a torque; a point on it is seen."""
    arm = lx.rod("arm", length=1.0, mass=params["mass"])
    hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")
    torques = jnp.asarray(design["torque"])
    pushed = lx.JointTorque("hinge", lambda t, motion: jnp.sum(torques * jnp.exp(-(((t - KNOTS) / 0.3) ** 2))))
    forces = [lx.Gravity([9.81, 0.0, 0.0]), pushed, lx.JointDamper("hinge", params["damping"])]
    mechanism = lx.Mechanism([arm], [hinge], forces)
    state = lx.assemble(mechanism, {"hinge": design["angle"]})
    saveat = diffrax.SaveAt(ts=TIMES)
    motion = lx.simulate(mechanism, state, t1=1.0, accuracy=lx.Accuracy(1e-8), saveat=saveat)
    reach = jnp.asarray(design["place"])
    return motion.position("arm", at=[reach, 0.0, 0.0])[:, 1] / 0.01


TRUE = {"mass": 1.0, "damping": 0.3}


def work(params, design):
    return {"squared torque": jnp.sum(jnp.asarray(design["torque"]) ** 2) / 4.0 - 1.0}


def errors_of(design):
    slopes = jax.jacfwd(lambda z: swung({"mass": z[0], "damping": z[1]}, design))(jnp.array([1.0, 0.3]))
    return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(slopes.T @ slopes)))


@pytest.mark.slow
def test_torque_start_and_sensor_of_a_pendulum():
    start = {
        "torque": np.array([0.2, -0.1, 0.3, 0.1]),
        "angle": lx.Bounded(0.1, -0.3, 0.3),
        "place": lx.Bounded(0.5, 0.2, 0.9),
    }
    found = lx.design(swung, TRUE, start, limits=work)
    assert found.ended == "converged"
    np.testing.assert_allclose(found.design["place"], 0.9, rtol=1e-6)  # what is seen is larger further out
    assert found.limits["squared torque"] <= 1e-6
    assert {"squared torque", "place, upper bound"} <= set(found.active)
    both = jax.tree.map(lambda *each: jnp.stack(each), found.design, {**start, "angle": 0.1, "place": 0.5})
    told = jax.tree.map(lambda *each: np.stack(each), found.standard_errors, found.standard_errors_before)
    exact = jax.jit(jax.vmap(errors_of))(both)
    np.testing.assert_allclose(exact, np.stack([told["mass"], told["damping"]], axis=1), rtol=1e-6)
    assert found.standard_errors["mass"] < 0.2 * found.standard_errors_before["mass"]


def linear(params, design):
    return params["a"] * design["x"] + params["b"] * jnp.ones(2)


GOOD = {"predictions": linear, "params": {"a": 1.0, "b": 2.0}, "design": {"x": np.array([0.0, 1.0])}, "progress": False}
BAD = {
    "predictions": [
        None, 3, "run", lambda p, d: None, lambda p, d: p["a"] * jnp.ones(1), lambda p, d: 1j * linear(p, d),
    ],
    "params": [None, {}, {"a": "one", "b": 1.0}, {"a": np.nan, "b": 1.0}],
    "design": [None, {}, {"x": "far"}, {"x": [0.0, np.inf]}],
    "limits": [3, "none", lambda p, d: "far", lambda p, d: jnp.nan * d["x"]],
    "criterion": ["F", None, 3],
    "of": ["c", ["a", "c"], []],
    "steps": [0, 1.5, True],
    "tolerance": [0.0, -1.0, "fine", np.nan],
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_designs_are_named(name):
    for value in BAD[name]:
        words = {"params": "param", "design": ""}.get(name, name)
        refused(lambda value=value: lx.design(**(GOOD | {name: value})), words)


def test_what_is_known_beforehand_is_no_design():
    for kind in (lx.Normal(0.0, 1.0), lx.LogNormal(1.0, 2.0)):
        with pytest.raises(ValueError, match="design holds what has a prior, 'y', and a design is free; give a number"):
            lx.design(**(GOOD | {"design": {"x": np.array([0.0, 1.0]), "y": kind}}))


def test_what_the_first_design_does_not_determine_is_named():
    with pytest.raises(ValueError, match="do not determine 'a', 'b' with the design where the search starts"):
        lx.design(**(GOOD | {"design": {"x": np.ones(2)}}))
    with pytest.raises(ValueError, match="not finite at the design"):
        lx.design(
            **(GOOD | {"design": {"x": -np.ones(2)}, "predictions": lambda p, d: p["a"] * p["b"] * jnp.log(d["x"])})
        )
