"""Studies of a function read its globals as they are when the study is asked for, and compile nothing for the same."""

import threading

import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

import linkax as lx

FACTOR, LOCK, BETWEEN = 5.0, threading.Lock(), lx.Bounded(1.0, 0.5, 2.0)


def residual(params):
    return jnp.stack([FACTOR * params["x"] - 10.0, FACTOR * params["x"] - 10.0])


def beside_a_lock(params):
    with LOCK:
        return residual(params)


def output(params):
    return {"y": FACTOR * params["x"]}


def predictions(params, design):
    return FACTOR * design["u"] * jnp.stack([params["x"], params["x"] ** 2])


# What a study finds, for the factor.
STUDIES = {
    "fit": (lambda: lx.fit(residual, {"x": 1.0}, progress=False).params["x"], lambda factor: 10.0 / factor),
    "fit of what cannot be compared": (
        lambda: lx.fit(beside_a_lock, {"x": 1.0}, progress=False).params["x"],
        lambda factor: 10.0 / factor,
    ),
    "tolerance_analysis": (
        lambda: lx.tolerance_analysis(output, {"x": 1.0}, {"x": 0.1}, samples=0).first.standard_deviation["y"],
        lambda factor: 0.1 * factor,
    ),
    "design": (
        lambda: lx.design(predictions, {"x": 1.0}, {"u": BETWEEN}, steps=2, progress=False).covariance_before[0, 0],
        lambda factor: 1.0 / factor**2,
    ),
}


@pytest.mark.parametrize(("study", "found"), STUDIES.values(), ids=STUDIES)
def test_studies_read_what_is_there_now(study, found, monkeypatch):
    ratio = float(study()) / found(FACTOR)
    with compilations() as compiled:
        study()
    again = {each["fun_name"] for each in compiled}
    assert not again or study is STUDIES["fit of what cannot be compared"][0]
    monkeypatch.setitem(globals(), "FACTOR", 50.0)
    np.testing.assert_allclose(float(study()), ratio * found(50.0), rtol=1e-6)
