"""Starts at distances of 1e-2 to 1e-14 from a singular configuration, and in it."""

from contextlib import nullcontext

import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import crank_slider, turning

import linkax as lx
from linkax.scenes import SCENES

SMALL = "does not leave a singular configuration.* rounding may move it"
DURATION = 2.0
TIMES = np.linspace(0.0, DURATION, 201)
DISTANCES = [sign * 10.0**-digits for digits in (2, 3, 4, 5, 6, 7, 8, 10, 12, 14) for sign in (1.0, -1.0)]


def equal_lengths(angle, speed, gravity):
    changes = {"angle": angle, "speed": speed, "gravity": gravity}
    return SCENES["crank-slider"].settings(changes=changes)


@pytest.mark.parametrize("gravity", [pytest.param(0.0, marks=pytest.mark.slow), 9.81])
def test_starts_in_motion(gravity):
    """Towards it and away from it the motion is as accurate as from anywhere else, on the branch it began on."""
    for distance in (*DISTANCES, 0.0):
        settings = equal_lengths(np.pi / 2 + distance, 1.0, gravity)
        found = lx.simulate(*turning(settings), t1=DURATION, accuracy=lx.PRECISE)
        assert found.rank_nearby.tolist() == [2]
        exact = crank_slider(settings, TIMES)[0]
        np.testing.assert_allclose(found.joint("bearing"), exact, atol=1e-10)
        slider = found.position("slider")[:, 0]
        # Across the branch, rounding is amplified by 1/d where a saved time is close to a passage.
        np.testing.assert_allclose(slider, 2.0 * np.cos(found.joint("bearing")), atol=1e-12)


def hanging(distance):
    """At rest beside the hanging singular configuration."""
    settings = equal_lengths(-np.pi / 2 + distance, 0.0, 9.81)
    return settings, *turning(settings)


@pytest.mark.parametrize("distance", [distance for distance in DISTANCES if abs(distance) >= 1e-5])
def test_starts_at_rest(distance):
    """They swing about the singular configuration by that distance, and stay on their branch."""
    settings, mechanism, state = hanging(distance)
    told = pytest.warns(lx.AccuracyWarning, match=SMALL) if abs(distance) < 3e-5 else nullcontext()
    with told:
        found = lx.simulate(mechanism, state, t1=DURATION, accuracy=lx.PRECISE)
    exact = crank_slider(settings, TIMES)[0]
    # Rounding of the motion across the branch, 1e-16, is amplified by 1/d.
    np.testing.assert_allclose(found.joint("bearing"), exact, atol=1e-10 + 1e-13 / abs(distance))


@pytest.mark.parametrize("distance", [*(d for d in DISTANCES if abs(d) <= 1e-7), 0.0])
def test_starts_at_rest_below_the_rank_tolerance(distance):
    """Nearer than 1e-6 it is the singular configuration, from which forces drive along both branches."""
    _, mechanism, state = hanging(distance)
    with pytest.raises(lx.SimulationError, match=r"at rest in a singular.*not unique.*'bearing'"):
        lx.simulate(mechanism, state, t1=DURATION, accuracy=lx.PRECISE)


@pytest.mark.parametrize("distance", [3e-6, -2e-6])
def test_motion_too_small_for_its_branch_is_told(distance):
    """Whether it ends or not."""
    _, mechanism, state = hanging(distance)
    with pytest.warns(lx.AccuracyWarning, match=SMALL):
        lx.simulate(mechanism, state, t1=DURATION)
    with pytest.raises(lx.SimulationError, match=SMALL):
        lx.simulate(mechanism, state, t1=2.0 * DURATION, accuracy=lx.Accuracy(rtol=1e-13))


def test_passages_in_single_precision_are_told():
    settings = equal_lengths(0.3, 8.0, 0.0)
    with pytest.warns(lx.AccuracyWarning, match="single precision"):
        found = lx.simulate(*turning(settings), t1=DURATION, dtype=jnp.float32, accuracy=lx.Accuracy(rtol=1e-4))
    exact = crank_slider(settings, TIMES)[0]
    np.testing.assert_allclose(found.joint("bearing"), exact, atol=1e-2)
