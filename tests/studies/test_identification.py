"""Parameters of mechanisms from noisy motion: their intervals hold the truth as often as they say."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar

import linkax as lx

SEEDS = 40
NOISE = 0.01  # of the range of each measurement
TIMES = jnp.linspace(0.03, 3.0, 100)
TRUTH = {
    "coupler_mass": 0.7,  # kg
    "rocker_mass": 1.2,  # kg
    "damping": 0.1,  # N m s
    "stiffness": 6.0,  # N m/rad
    "free": 2.4,  # rad
    "angle": 1.2,  # rad
}


def linkage(params):
    """A driven crank of known mass, a coupler, and a rocker on a spring; friction in the crank's bearing."""
    spring = lx.JointSpring("rocker_bearing", params["stiffness"], free=params["free"])
    torques = [lx.JointDamper("crank_bearing", params["damping"]), lx.JointTorque("crank_bearing", 0.5), spring]
    masses = 1.0, params["coupler_mass"], params["rocker_mass"]
    return four_bar(0.3, 0.8, 0.6, 0.9, masses, cut="rocker_pin", forces=torques)


def measured(params):
    """Angle of the crank and of the rocker, (n_t, 2)."""
    mechanism = linkage(params)
    guess = {"crank_pin": -1.0, "rocker_bearing": 2.0}
    state = lx.assemble(mechanism, {"crank_bearing": params["angle"]}, guess=guess)
    found = lx.simulate(mechanism, state, t1=TIMES[-1], accuracy=lx.Accuracy(1e-6), saveat=diffrax.SaveAt(ts=TIMES))
    return jnp.stack([found.joint("crank_bearing"), found.joint("rocker_bearing")], axis=1)


def residual(params, data, deviation):
    return (measured(params) - data) / deviation


@pytest.mark.slow
def test_intervals_of_a_four_bar_hold_the_truth():
    exact = np.asarray(measured(TRUTH))
    deviation = NOISE * np.ptp(exact, axis=0)
    start = {name: lx.Positive(1.1 * value) for name, value in TRUTH.items()}
    held, steps, noises = 0, [], []
    for seed in range(SEEDS):
        data = exact + deviation * np.random.default_rng(seed).normal(size=exact.shape)
        found = lx.fit(residual, start, (data, deviation))
        assert found.ended == "converged"
        lower, upper = found.interval(0.95)
        held += sum(lower[name] < value < upper[name] for name, value in TRUTH.items())
        steps.append(found.steps)
        noises.append(found.noise)
    assert 0.90 * SEEDS * len(TRUTH) <= held <= 0.99 * SEEDS * len(TRUTH)
    assert abs(np.sqrt(np.mean(np.square(noises))) - 1.0) <= 0.05
    assert max(steps) <= 15
