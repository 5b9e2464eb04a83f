"""Masses, lengths and speeds from very small to very large, alone and in one mechanism."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import crank_slider, turning

import linkax as lx
from linkax.scenes import SCENES
from linkax.simulation.explain.diagnosis import cause
from linkax.simulation.explain.remarks import in_words
from linkax.simulation.integrate.results import RESULTS

PLAIN = {"crank": 1.0, "rod": 3.0, "crank_mass": 1.0, "rod_mass": 1.0, "slider_mass": 1.0}
PLAIN |= {"gravity": 9.81, "torque": 0.0, "angle": 0.3, "speed": 2.0}
MASSES = ("crank_mass", "rod_mass", "slider_mass")
ACCURACY = lx.Accuracy(rtol=1e-10)
DURATION = 2.0
# Errors of some hundred steps add up, and each may be larger than the tolerance where the motion spreads errors.
MANY_STEPS = 100.0


def run(changes, duration=DURATION, accuracy=ACCURACY, **options):
    return lx.simulate(*turning(PLAIN | changes), t1=duration, accuracy=accuracy, **options)


def off(found, changes):
    """The largest error of the crank's angle [rad], and of its speed, relative."""
    exact = crank_slider(PLAIN | changes, np.linspace(0.0, found.ts[-1], len(found.ts)))
    names = list(found.mechanism.topology.coordinates)  # of one number each
    angle, speed = (part[:, names.index("bearing")] for part in (found.q, found.v))
    of_speed = np.abs(speed - exact[1]) / np.max(np.abs(exact[1]))
    return max(np.max(np.abs(angle - exact[0])), np.max(of_speed))


def assert_closed(found, most=1e-14):
    """Loops are closed to rounding: tens of ulps, as positions are sums of a few vectors."""
    worst = found.worst_violation()
    assert max(worst.position, worst.velocity, worst.acceleration) <= most


RATIOS = 10.0 ** np.array([-8, -4, 4, 8])


@pytest.mark.parametrize("ratio", RATIOS)
@pytest.mark.parametrize("heavy", MASSES)
def test_ratios_of_masses(heavy, ratio):
    found = run({heavy: ratio})
    assert off(found, {heavy: ratio}) <= MANY_STEPS * ACCURACY.rtol
    assert_closed(found)


def scaled(mass=1.0, length=1.0, time=1.0):
    """The same motion in other units: angles are the same, at times that are scaled."""
    changes = {name: mass * PLAIN[name] for name in MASSES} | {name: length * PLAIN[name] for name in ("crank", "rod")}
    return changes | {"gravity": length / time**2 * PLAIN["gravity"], "speed": PLAIN["speed"] / time}


UNITS = [("mass", 1e-20), ("mass", 1e-8), ("mass", 1e8), ("mass", 1e20), ("length", 1e-6), ("length", 1e6)]
UNITS += [("time", 1e-8), ("time", 1e8)]


@pytest.mark.parametrize(("of", "size"), UNITS)
def test_units_do_not_matter(of, size):
    duration = DURATION * (size if of == "time" else 1.0)
    found, plain = run(scaled(**{of: size}), duration), run({})
    # Rounding, which the choice of steps amplifies: their errors, 1e-10 each, differ by a few thousandths.
    np.testing.assert_allclose(found.joint("bearing"), plain.joint("bearing"), atol=1e-11)
    assert_closed(found)


@pytest.mark.parametrize(("of", "size"), [unit for unit in UNITS if unit[0] != "time"])
def test_units_do_not_matter_in_a_singular_configuration(of, size):
    """Where directions of motion in the metric of the masses are counted, they may have any length."""
    changes = scaled(**{of: size}) | {"gravity": 0.0, "angle": np.pi / 2}
    changes["rod"] = changes["crank"]
    found = run(changes)
    assert off(found, changes) <= MANY_STEPS * ACCURACY.rtol
    slider, angle = found.position("slider")[:, 0], found.joint("bearing")
    np.testing.assert_allclose(slider, 2.0 * changes["crank"] * np.cos(angle), atol=1e-12 * changes["crank"])


@pytest.mark.parametrize("speed", [1e-4, 1e2, 1e4])
def test_speeds(speed):
    """Gravity does little to fast ones, and nearly all to slow ones."""
    duration = DURATION * min(1.0, 10.0 / speed)
    found = run({"speed": speed}, duration)
    assert off(found, {"speed": speed}) <= MANY_STEPS * ACCURACY.rtol
    assert_closed(found)


@pytest.mark.parametrize("length", 10.0 ** np.arange(1, 7))
def test_lengths_mixed_in_one_mechanism(length):
    """A crank of 1 m and a rod of 10 to 1e6 m."""
    found = run({"rod": length})
    assert off(found, {"rod": length}) <= MANY_STEPS * ACCURACY.rtol
    assert_closed(found)


def test_a_long_rod_that_a_short_crank_carries_is_named():
    """In the tree's own choice: what joints of the crank move has the inertia of the rod, in which its own is lost."""
    settings = SCENES["crank-slider"].settings(changes=PLAIN | {"rod": 1e9})
    mechanism = SCENES["crank-slider"].mechanism(settings)
    inclination = -np.arcsin(np.sin(settings["angle"]) / 1e9)
    start = {"bearing": settings["angle"], "guide": 1e9, "crank_pin": inclination - settings["angle"]}
    q = np.array([start[name] for name in mechanism.topology.coordinates])
    with pytest.raises(lx.SimulationError, match=r"leaves 0 digits .* 'crank' next to that of 'rod'.*cut=True"):
        lx.simulate(mechanism, lx.State(q, 0.0 * q), t1=DURATION)


def test_digits_lost_to_a_long_rod_are_told():
    """In the tree's own choice, as above; `turning` cuts the joint that the warning names."""
    settings = SCENES["crank-slider"].settings(changes=PLAIN | {"rod": 1e4})
    mechanism = SCENES["crank-slider"].mechanism(settings)
    state, accuracy = SCENES["crank-slider"].initial(mechanism, settings), lx.Accuracy(rtol=1e-9)
    with pytest.warns(lx.AccuracyWarning, match=r"rtol is 1e-09.*'crank' next to.*'rod'.*cut=True .*'crank_pin'"):
        found = lx.simulate(mechanism, state, t1=DURATION, accuracy=accuracy)
    # Rounding, and so by chance: well above the tolerance, which is what the warning says.
    assert off(found, {"rod": 1e4}) > 10.0 * accuracy.rtol
    assert np.max(found.error_estimate(lambda it: it.joint("bearing"))) > 10.0 * accuracy.rtol


def test_digits_lost_to_many_bodies_are_told():
    found = dataclasses.replace(run({}), definiteness=jnp.asarray(1e-7))
    assert "very many" in in_words(found, "rounding")
    assert found.remark() == lx.REMARKS.rounding
    assert dataclasses.replace(found, definiteness=jnp.asarray(1e-5)).remark() == lx.REMARKS.none


@pytest.mark.slow
def test_beams_lose_no_inertia_to_their_nodes():
    """These have none, and beams bend away from them: what stops a run is not that."""
    beam = lx.Beam("beam", 2.0, lx.rectangle(0.1, 0.1, lx.Material(2.1e11, 0.3, 7850.0)))
    mechanism = lx.Mechanism([beam], [lx.Revolute("foot", lx.GROUND, beam, axis="z")])
    stopped = lx.Solution.of_state(mechanism, lx.assemble(mechanism))
    stopped = eqx.tree_at(lambda solution: solution.result, stopped, RESULTS.max_steps_reached)
    assert "inertia" not in cause(stopped)


# In single precision tolerances are 1e-5.
SINGLE = {"dtype": jnp.float32, "accuracy": lx.Accuracy(rtol=1e-5)}


@pytest.mark.parametrize(
    "changes",
    [{}, scaled(mass=1e-8), scaled(mass=1e8), scaled(length=1e-6), scaled(length=1e6), scaled(time=1e-4)]
    + [{name: ratio} for name in MASSES for ratio in RATIOS],
    ids=str,
)
def test_single_precision(changes):
    duration = DURATION * min(1.0, PLAIN["speed"] / changes.get("speed", 1.0))
    found = run(changes, duration, **SINGLE)
    read = (found.q, found.v, found.ts, found.joint("bearing"), found.position("slider"))
    assert {part.dtype for part in read} == {jnp.dtype(jnp.float32)}
    assert off(found, changes) <= MANY_STEPS * SINGLE["accuracy"].rtol
    assert_closed(found, 1e-5)
