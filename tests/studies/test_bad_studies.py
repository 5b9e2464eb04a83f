"""Sweeps, fits and their like refuse what makes no sense, by an error that names it."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from mechanisms import pendulum
from refusals import Shown, refused

import linkax as lx


def squares(params):
    return {"square": params["x"] ** 2}


SWEEPS = {
    "function": [None, 3, "square", {}],
    "params": [None, {}, 3.0, {"x": 1.0}, {"x": "abc"}, {"x": []}, {"x": np.zeros(3), "y": np.zeros(2)}, {"x": [None]}],
    "chunk": [0, -1, 1.5, "all", True, np.nan],
    "memory": [0, -1.0, np.nan, "much", None, 1j],
    "devices": ["gpu", 3, [], ["cpu"], 2 * jax.local_devices()],
    "difficulty": ["hard", np.zeros(2), 3.0, {}, np.array(["a", "b", "c"]), [None, 1.0, 2.0]],
    "store": [3, 1.5],
}  # fmt: skip


@pytest.mark.parametrize("name", SWEEPS)
def test_bad_sweeps_are_named(name):
    for value in SWEEPS[name]:
        given = {"function": squares, "params": {"x": np.arange(3.0)}, "progress": False} | {name: value}
        refused(lambda given=given: lx.sweep(**given), name)


def test_a_store_that_is_a_file_is_named(tmp_path):
    (tmp_path / "file").write_text("kept")
    refused(lambda: lx.sweep(squares, {"x": np.arange(3.0)}, store=tmp_path / "file", progress=False), "store", "file")
    assert (tmp_path / "file").read_text() == "kept"


def residual(params, measured):
    return params["x"] * jnp.arange(1.0, 4.0) - measured


FITS = {
    "function": [None, 3, "residual"],
    "params": [None, {}, {"x": None}, {"x": "one"}, {"x": np.nan}, {"x": [1.0, np.inf]}, {"x": 1.0j}, {"x": True}],
    "args": [("measured",), 3.0, "measured", (object(),), {}],
    "optimiser": [3, "adam", optax.adam, lx.Positive],
    "steps": [-1, 1.5, "many", True],
    "tolerance": [-1e-6, np.nan, "fine", np.inf],
    "patience": [0, -1, 1.5, "long"],
    "mode": ["backward", 3, True],
    "checkpoint": [3, 1.5],
}


@pytest.mark.parametrize("name", FITS)
def test_bad_fits_are_named(name):
    for value in FITS[name]:
        given = {"function": residual, "params": {"x": 1.0}, "args": (np.ones(3),), "progress": False} | {name: value}
        refused(lambda given=given: lx.fit(**given), {"params": "param"}.get(name, name))


def test_a_checkpoint_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("kept")
    for path in (tmp_path, tmp_path / "file" / "fit.npz", tmp_path / "file"):
        refused(
            lambda path=path: lx.fit(residual, {"x": 1.0}, (np.ones(3),), checkpoint=path, progress=False),
            "checkpoint",
            str(path),
        )
    assert (tmp_path / "file").read_text() == "kept"


NO_NUMBER = [np.nan, np.inf, None, "one", 1.0j, True]
PARAMETERS = {
    "Positive": (lx.Positive, [0.0, -1.0, [1.0, -1.0], [1.0, np.nan], *NO_NUMBER]),
    "Bounded": (lambda value: lx.Bounded(value, 0.0, 1.0), [-1e-9, -1.0, 2.0, [0.5, 3.0], *NO_NUMBER]),
    "Bounded: ": (lambda bound: lx.Bounded(1.0, bound, 1.0), [1.0, 2.0, *NO_NUMBER]),
    "Normal": (lambda deviation: lx.Normal(0.0, deviation), [0.0, -1.0, *NO_NUMBER]),
    "LogNormal": (lambda median: lx.LogNormal(median, 2.0), [0.0, -1.0, *NO_NUMBER]),
    "factor": (lambda factor: lx.LogNormal(1.0, factor), [0.5, 1.0, *NO_NUMBER]),
    "PhysicalInertia": (lx.PhysicalInertia, [0.0, -1.0, *NO_NUMBER]),
    "PhysicalInertia: ": (
        lambda inertia: lx.PhysicalInertia(1.0, inertia=inertia),
        [[1.0, 1.0, 2.0], np.diag([1.0, 1.0, -1.0]), [1.0, 1.0], np.eye(2), "round", None, np.diag([1.0, 1.0, np.nan])],
    ),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_bad_parameters_are_named(name):
    make, values = PARAMETERS[name]
    for value in values:
        refused(lambda value=value: make(value), name.strip(), Shown(value))


def motion(params):
    return lx.simulate(pendulum(params["length"]), lx.State(jnp.zeros(1), jnp.ones(1)), t1=1.0)


def test_bad_shots_and_derivatives_are_named():
    run = lambda start, ts, t1: (start, ts)
    for ts in ("ten", [[0.0, 1.0]], [0.0], np.arange(3.0), [0.0, np.nan, 1.0, 2.0], [0.0, 2.0, 1.0, 3.0], [0.0, 1.0j]):
        refused(lambda ts=ts: lx.shoot(run, np.zeros(2), ts), "times")
    for starts in (None, 1.0, {"a": np.zeros(2), "b": np.zeros(3)}, {"a": "two"}, np.zeros(0)):
        refused(lambda starts=starts: lx.shoot(run, starts, np.arange(4.0)), "starts")
    refused(lambda: lx.shoot(None, np.zeros(2), np.arange(4.0)), "run", "None")
    refused(lambda: lx.differentiability(lambda params: 3.0, {"x": 1.0}), "float", "Solution")
    refused(lambda: lx.differentiability(None, {"x": 1.0}), "function", "None")
    refused(lambda: lx.differentiability(motion, {"length": "long"}), "'length'", "'long'")


def test_bad_comparisons_are_named():
    right = {
        "mechanism": pendulum(), "state": lx.State(jnp.zeros(1), jnp.ones(1)), "points": {"tip": ("arm", "tip")},
        "t1": 1.0, "steppings": [lx.Stepping(None, rtol=1e-6)], "formulations": ["tangent-space"],
    }  # fmt: skip
    bad = {
        "mechanism": [None], "state": [None], "points": [None, {}, {"tip": ("amr", "tip")}, {"tip": ("arm", "top")}],
        "t1": [-1.0, np.nan, "long"], "steppings": [[], None, [1e-6]], "bound": [0.0, -1.0, np.nan, "far"],
        "formulations": [["magic"], None, []], "repeats": [0, -1, 1.5],
    }  # fmt: skip
    for name, values in bad.items():
        for value in values:
            word = next((word for word in ("top", "amr", "magic") if word in repr(value)), name)
            refused(lambda given=right | {name: value}: lx.compare(**given), word)
