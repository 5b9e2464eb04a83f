"""What a run tells of singular configurations."""

import numpy as np
import pytest
from known_answers import reference, start

import linkax as lx


@pytest.mark.parametrize("variant", ["SC1", "SC2", "SC3", "SC4"])
def test_passages_are_told(variant):
    known = reference(f"crank_slider_{variant}")
    mechanism, state = start("crank-slider", variant)
    found = lx.simulate(mechanism, state, t1=5.0, accuracy=lx.PRECISE)
    passages = found.passages()
    # The angle crosses odd multiples of 90 degrees; where, by inverse interpolation of the table.
    quarter = np.floor(known["theta"] / np.pi - 0.5)
    before = np.flatnonzero(np.diff(quarter))
    assert len(passages.times) == len(before)
    assert np.all(known["t"][before] <= passages.times)
    assert np.all(passages.times <= known["t"][before + 1])
    crossed = np.pi * (np.maximum(quarter[before], quarter[before + 1]) + 0.5)
    speed = (known["theta"][before + 1] - known["theta"][before]) / np.diff(known["t"])[before]
    linear = known["t"][before] + (crossed - known["theta"][before]) / speed
    np.testing.assert_allclose(passages.times, linear, atol=2e-3)
    error = np.max(np.abs(found.position("slider")[:, 0] - known["x_slider"]))
    assert 2.0 <= passages.digits <= 4.0
    assert error <= 1e-11 + np.finfo(float).eps * 10.0**passages.digits * 1e3
    # Near at the times of passages alone.
    near = np.flatnonzero(found.singularity_distance() < 0.05)
    assert np.all(np.min(np.abs(np.subtract.outer(known["t"][near], passages.times)), axis=1) < 0.05)
    assert np.median(found.singularity_distance()) > 0.1


def test_a_motion_without_passages_tells_none():
    mechanism, state = start("crank-slider", "regular")
    found = lx.simulate(mechanism, state, t1=2.0)
    passages = found.passages()
    assert len(passages.times) == 0
    assert passages.digits < 1.0
