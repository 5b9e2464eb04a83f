"""Multiple shooting: a long record whose residual has many minima is fitted in pieces that join."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

TIMES = np.linspace(0.0, 30.0, 300, endpoint=False)
FREQUENCY = 4.0
MEASURED = np.sin(FREQUENCY * TIMES) + 0.01 * np.random.default_rng(0).normal(size=TIMES.shape)


def oscillation(frequency, start, ts, t1):
    """An oscillator from position and speed at ts[0]: its state at t1, and positions at ts."""
    at = lambda t: jnp.cos(frequency * t) * start[0] + jnp.sin(frequency * t) / frequency * start[1]
    until = t1 - ts[0]
    return jnp.stack([at(until), jax.jvp(at, (until,), (1.0,))[1]]), at(ts - ts[0])


def in_pieces(params):
    shots = lx.shoot(lambda *motion: oscillation(params["frequency"], *motion), params["starts"], TIMES)
    return {"data": (shots.outputs - MEASURED) / 0.01, "gaps": 1e6 * shots.gaps}


def at_once(params):
    return (oscillation(params["frequency"], params["start"], TIMES, TIMES[-1])[1] - MEASURED) / 0.01


def test_pieces_find_what_one_motion_does_not():
    speeds = np.gradient(MEASURED, TIMES)
    single = lx.fit(at_once, {"frequency": 3.0, "start": np.array([0.0, FREQUENCY])})
    assert abs(single.params["frequency"] - FREQUENCY) > 0.05
    starts = np.stack([MEASURED, speeds], axis=1)[::10]
    found = lx.fit(in_pieces, {"frequency": 3.0, "starts": starts})
    assert found.ended == "converged"
    # To the same answer, with the same uncertainty, as one motion from next to the truth.
    best = lx.fit(at_once, {"frequency": FREQUENCY, "start": np.array([0.0, FREQUENCY])})
    np.testing.assert_allclose(found.params["frequency"], best.params["frequency"], rtol=1e-5)
    np.testing.assert_allclose(found.standard_errors["frequency"], best.standard_errors["frequency"], rtol=1e-2)
    np.testing.assert_allclose(found.noise, best.noise, rtol=1e-2)
    assert found.undetermined == []


def test_gaps_and_outputs_are_those_of_the_pieces():
    starts = jnp.array([[0.0, FREQUENCY], [1.0, 0.0]])
    shots = lx.shoot(lambda *motion: oscillation(FREQUENCY, *motion), starts, TIMES)
    end, first = oscillation(FREQUENCY, starts[0], TIMES[:150], TIMES[150])
    second = oscillation(FREQUENCY, starts[1], TIMES[150:], 30.0)[1]
    np.testing.assert_allclose(shots.outputs, np.concatenate([first, second]), atol=1e-12)
    np.testing.assert_allclose(shots.gaps, [end - starts[1]], atol=1e-12)


def test_bad_input():
    run = lambda *motion: oscillation(FREQUENCY, *motion)
    with pytest.raises(ValueError, match="7 starts for times of shape"):
        lx.shoot(run, jnp.zeros((7, 2)), TIMES)
    with pytest.raises(ValueError, match="same first axis"):
        lx.shoot(run, (jnp.zeros((2, 2)), jnp.zeros(3)), TIMES)
