"""Sensors tell what instruments would."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx

FALL = np.array([0.0, -9.81, 0.0])
MIDDLE = slice(5, -5)


@pytest.fixture(scope="module")
def solution():
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 201))
    return lx.simulate(pendulum(0.8, 1.3), lx.State(np.array([0.4]), np.array([3.0])), t1=1.0, saveat=saveat)


def test_angles_of_cut_joints_are_unwrapped():
    """Of a door on two hinges, which turns more than once."""
    door = lx.rod("door", 1.0, 1.0)
    hinge = lambda name, z, **options: lx.Revolute(
        name, lx.GROUND.at([0.0, 0.0, z]), door.at([0.0, 0.0, z]), "z", **options
    )
    mechanism = lx.Mechanism([door], [hinge("upper", 1.0), hinge("lower", 0.0, cut=True)])
    turns = np.linspace(3.0, -9.0, 60)
    still = lx.Solution.of_state(mechanism, lx.State(np.zeros(1), np.zeros(1)))
    speeds = np.full((60, 1), -12.0 / 59.0)
    solution = dataclasses.replace(still, ts=np.arange(60.0), q=turns[:, None], v=speeds)
    assert np.ptp(np.asarray(solution.joint("lower"))) < 2.0 * np.pi
    np.testing.assert_allclose(lx.Encoder("lower").reading(solution), turns, atol=1e-12)
    np.testing.assert_allclose(lx.Encoder("upper").reading(solution), turns, atol=1e-12)
    late = jnp.array([50.25, 37.5, 59.0, 12.0])  # a record that begins late, with more than half a turn between samples
    exact = 3.0 - 12.0 / 59.0 * late
    np.testing.assert_allclose(lx.Encoder("lower").predict(solution, late), exact, atol=1e-12)
    record = lx.Experiment(lambda params: solution, {"angle": (late[1:3], late[1:3])}, {"angle": lx.Encoder("lower")})
    np.testing.assert_allclose(record.predict({})["angle"], exact[1:3], atol=1e-12)
    slope = jax.grad(lambda t: lx.Encoder("lower").predict(solution, t[None])[0])(late[1])
    np.testing.assert_allclose(slope, -12.0 / 59.0, rtol=1e-9)


def test_gain_bias_delay_and_components(solution):
    ts, there = jnp.array([0.3, 0.5]), jnp.array([0.29, 0.49])
    exact = solution.at(there).position("arm")[:, 0]
    sensor = lx.Tracker("arm", gain=2.0, bias=0.3, delay=0.01, components=0)
    np.testing.assert_allclose(sensor.predict(solution, ts), 2.0 * exact + 0.3, rtol=1e-12)
    later = lambda delay: lx.Tracker("arm", delay=delay, components=0).predict(solution, ts)[0]
    speed = solution.at(there).velocity("arm")[0, 0]
    np.testing.assert_allclose(jax.grad(later)(0.01), -speed, rtol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(later)(0.01), -speed, rtol=1e-6)
    several = lx.Tracker("arm", components=(2, 0), gain=[1.0, 3.0]).predict(solution, there)
    np.testing.assert_allclose(several[:, 1], 3.0 * exact, rtol=1e-12)
    with pytest.raises(ValueError, match="components of Tracker are 3; its reading has 3 components, 0 to 2"):
        lx.Tracker("arm", components=3).predict(solution, ts)
    with pytest.raises(ValueError, match=r"components of Encoder are \(0,\); its reading has no components"):
        lx.Encoder("hinge", components=(0,)).predict(solution, ts)


def test_gain_bias_and_noise_are_one_number_or_one_for_each_component(solution):
    """Also where there are as many times as numbers, which would be taken for one for each time."""
    ts = np.linspace(0.2, 0.4, 3)
    for sensor, told in (
        (lx.Encoder("hinge", gain=np.ones(3)), r"gain of Encoder has shape \(3,\), and it tells one number"),
        (lx.Tracker("arm", bias=np.ones(2)), r"bias of Tracker has shape \(2,\), and it tells 3 numbers; give one"),
        (lx.Tracker("arm", noise=np.ones(3), components=0), r"noise of Tracker has shape \(3,\), and it tells one"),
    ):
        with pytest.raises(ValueError, match=told):
            sensor.predict(solution, ts)


def test_an_inertial_unit_feels_acceleration_less_free_fall(solution):
    told = np.asarray(lx.InertialUnit("arm", "tip").reading(solution))
    ts, axes = np.asarray(solution.ts), np.asarray(solution.orientation("arm"))
    acceleration = np.gradient(np.asarray(solution.velocity("arm", "tip")), ts, axis=0)
    felt = np.einsum("tij,ti->tj", axes, acceleration - FALL)
    np.testing.assert_allclose(told[MIDDLE, :3], felt[MIDDLE], atol=1e-2 * np.max(np.abs(felt)))
    turning = np.einsum("tji,tjk->tik", axes, np.gradient(axes, ts, axis=0))
    rates = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
    np.testing.assert_allclose(told[MIDDLE, 3:], rates[MIDDLE], atol=1e-2 * np.max(np.abs(rates)))


def test_an_inertial_unit_at_rest_tells_what_is_up():
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    body = lx.RigidBody("body", 1.0, inertia=1.0)
    mechanism = lx.Mechanism([body], [lx.Revolute("mount", lx.GROUND, body, axis="z")], [lx.Gravity(FALL)])
    solution = lx.Solution.of_state(mechanism, lx.State(np.zeros(1), np.zeros(1)))
    unit = lx.InertialUnit("body", [0.1, 0.0, 0.0], turned, components=(0, 1, 2))
    np.testing.assert_allclose(unit.told(solution)[0], turned.T @ -FALL, atol=1e-12)


def test_force_cells(solution):
    """The hinge gives the arm its acceleration, in axes of which h¹ is z."""
    found = np.asarray(lx.ForceCell("hinge").reading(solution))
    needed = 1.3 * (np.asarray(solution.acceleration("arm")) - FALL)
    np.testing.assert_allclose(found[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(found[:, 1:3], axis=1), np.linalg.norm(needed, axis=1), rtol=1e-9)
    np.testing.assert_array_equal(lx.Reading(lambda s: s.energy()).reading(solution), solution.energy())


@pytest.mark.slow
def test_a_strain_gauge_tells_how_a_fibre_stretches():
    steel = lx.Material(2e11, 0.3, 7800.0)
    beam = lx.Beam("beam", 1.0, lx.rectangle(0.02, 0.03, steel), elements=2)
    mechanism = lx.Mechanism([beam], [lx.Fixed("clamp", lx.GROUND, beam.at("base"))])
    size = mechanism.topology.num_speeds
    state = lx.State(1e-3 * np.random.default_rng(0).normal(size=size), np.zeros(size))
    bent = lx.Solution.of_state(mechanism, state)
    place = lambda x: np.asarray(bent.position("beam", [x, 0.01, -0.015]))[0]
    stretched = np.linalg.norm(place(2e-4) - place(0.0)) / 2e-4 - 1.0
    np.testing.assert_allclose(lx.StrainGauge("beam", 0, (0.01, -0.015)).reading(bent)[0], stretched, rtol=1e-2)
    with pytest.raises(ValueError, match="node is 3; beam 'beam' has nodes 0 to 2"):
        lx.StrainGauge("beam", 3).reading(bent)


BAD = {
    "gain": (lambda: lx.Encoder("a", gain="high"), "a sensor's gain is 'high'"),
    "bias": (lambda: lx.Encoder("a", bias=np.nan), "a sensor's bias is nan; it must be finite"),
    "delay": (lambda: lx.Encoder("a", delay=[0.1, 0.2]), r"a sensor's delay \[s\] has shape \(2,\)"),
    "noise": (lambda: lx.Encoder("a", noise=0.0), "a sensor's noise is 0.0; it must be positive; None where"),
    "loss": (lambda: lx.Encoder("a", loss="tukey"), "loss is 'tukey'; known: 'squares', 'huber', 'cauchy'"),
    "components": (lambda: lx.Tracker("a", components=(-1,)), "a sensor's component is -1"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_sensors_are_named(case):
    make, told = BAD[case]
    with pytest.raises(ValueError, match=told):
        make()
