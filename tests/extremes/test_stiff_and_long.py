"""Stiff springs with an implicit solver, and motions of many periods."""

import diffrax
import numpy as np
import pytest
from known_answers import n_four_bar, start, turning
from scipy.optimize import brentq

import linkax as lx
from linkax.scenes import SCENES
from linkax.scenes.closed_form import pendulum_angle
from linkax.simulation.simulate import fixed_steps

IMPLICIT = {"solver": diffrax.Kvaerno5()}
EPS = np.finfo(float).eps
GRAVITY = 9.81


def swinging(stiffness, duration):
    """A mass on a spring that is 1 m long where it is free, at rest aside, stretched as a rigid rod would be loaded."""
    carriage, bob = lx.RigidBody("carriage", 0.0), lx.point_mass("bob", 1.0)
    joints = [lx.Prismatic("x", lx.GROUND, carriage, axis="x"), lx.Prismatic("y", carriage, bob, axis="y")]
    forces = [lx.Gravity([0.0, -GRAVITY, 0.0]), lx.Spring(lx.GROUND, bob, stiffness, 1.0)]
    length = 1.0 + GRAVITY * np.cos(1.0) / stiffness
    state = lx.State(length * np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2))
    mechanism = lx.Mechanism([carriage, bob], joints, forces)
    assert list(mechanism.topology.coordinates) == ["x", "y"]
    return lx.simulate(mechanism, state, t1=duration, **IMPLICIT)


@pytest.mark.slow
@pytest.mark.parametrize(("stiffness", "duration"), [(1e4, 1.0), (1e6, 1.0), (1e8, 0.2), (1e10, 0.1), (1e12, 0.05)])
def test_a_stiff_spring_is_a_rod(stiffness, duration):
    """Up to its stretch, 2e1 N / stiffness, and to what rounding of its length does: stiffness × 1e-16 m of force."""
    found = swinging(stiffness, duration)
    place = found.position("bob")
    angle = np.arctan2(place[:, 0], -place[:, 1])
    stretch, noise = 3.0 * GRAVITY / stiffness, EPS * stiffness / GRAVITY
    np.testing.assert_allclose(angle, pendulum_angle(found.ts, GRAVITY, 1.0, 0.0), atol=stretch + noise + 1e-7)
    assert np.max(np.abs(np.linalg.norm(place, axis=1) - 1.0)) <= stretch


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", 10.0 ** np.arange(2, 13, 2))
def test_a_damped_stiff_spring_in_a_loop_settles_where_statics_say(stiffness):
    """On the guide of the crank-slider, overdamped, for a million times the time that the stiffest needs."""
    settings = SCENES["crank-slider"].settings(changes={"rod": 3.0, "angle": 1.0, "speed": 0.0})
    free = np.cos(1.0) + np.sqrt(9.0 - np.sin(1.0) ** 2)
    spring = lx.JointSpring("guide", stiffness, free)
    damper = lx.JointDamper("guide", 20.0 * np.sqrt(stiffness))
    mechanism, state = turning(settings, [lx.Gravity([0.0, -GRAVITY, 0.0]), spring, damper])
    found = lx.simulate(mechanism, state, t1=100.0, accuracy=lx.Accuracy(rtol=1e-10), **IMPLICIT)

    def torque(angle):
        inclination = -np.arcsin(np.sin(angle) / 3.0)
        turns = -np.cos(angle) / (3.0 * np.cos(inclination))
        place, slope = (
            np.cos(angle) + 3.0 * np.cos(inclination),
            -np.sin(angle) - 3.0 * np.sin(inclination) * turns,
        )
        # Crank and rod have masses of one, their centres at y = sin(angle) / 2 both.
        return stiffness * (place - free) * slope + GRAVITY * np.cos(angle)

    settled = brentq(torque, 0.3, 1.2, xtol=1e-15)
    # The spring's coordinate is read to 2e-16 of 3 m, and its tolerance is 1e-10 of that.
    np.testing.assert_allclose(found.joint("bearing")[-1], settled, atol=1e-9)


REGULAR = {"rod": 3.0, "angle": 0.3, "speed": 2.0}


def drift(step, duration):
    """Largest change of energy over fixed steps of Dopri8, relative; loops are closed to rounding at every time."""
    settings = SCENES["crank-slider"].settings(changes=REGULAR)
    found = lx.simulate(*turning(settings), t1=duration, **fixed_steps(step, duration))
    worst = found.worst_violation()
    assert max(worst.position, worst.velocity, worst.acceleration) <= 1e-14
    energy = found.energy()
    return np.max(np.abs(energy - energy[0])) / np.max(found.kinetic_energy())


def test_energy_drifts_no_faster_than_the_order_allows():
    """With the eighth power of the step, give or take a factor of two, and in proportion to time."""
    coarse, fine = drift(0.04, 10.0), drift(0.02, 10.0)
    assert fine <= coarse / 2.0**7
    assert drift(0.02, 30.0) <= 4.0 * fine


def four_bar(duration, accuracy):
    """The four-bar that passes singular configurations about twice a second, against its elliptic functions."""
    mechanism, state = start("n-four-bar", None, {"N": 1})
    found = lx.simulate(mechanism, state, t1=duration, accuracy=accuracy, max_steps=10**6)
    place = found.position("link_0", at="tip")[:, :2]
    error = np.linalg.norm(place - n_four_bar(found.ts, 1), axis=-1)
    energy, worst = found.energy(), found.worst_violation()
    return np.max(error), np.ptp(energy) / np.max(found.kinetic_energy()), worst


@pytest.mark.slow
def test_ten_thousand_seconds():
    """Some 7000 passages: loops stay closed to rounding, energy drifts in proportion, the phase with its square."""
    error, energy, _ = four_bar(100.0, lx.PRECISE)
    later_error, later_energy, worst = four_bar(1e4, lx.PRECISE)
    assert max(worst.position, worst.velocity) <= 1e-14
    # A hundred times as long, and a factor of two.
    assert later_energy <= 2.0 * 1e2 * energy
    assert later_error <= 2.0 * 1e4 * error
