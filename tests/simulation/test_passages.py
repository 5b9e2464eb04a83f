"""What a run tells of singular configurations."""

import diffrax
import numpy as np
import pytest
from known_answers import reference, start
from mechanisms import raised_exactly, sarrus

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


# Of the Sarrus linkage of tests/data/sarrus.csv: on the way down, back up, and down again.
DOWN = np.array([0.40917685462413299, 0.60608021715391262, 0.80298357968369226])
TURNS = 1.2121604343078252
SARRUS = np.concatenate([DOWN, 2.0 * TURNS - DOWN[::-1], [2.0 * TURNS + DOWN[0]]])
# The first two are as many as the times of the table, so that its program saves them.
SAVED = {
    "a few times": np.concatenate([np.linspace(0.0, 2.85, 20), np.linspace(2.86, 3.0, 41)]),
    "times on passages": np.sort([0.0, *np.linspace(0.1, 2.9, 52), *SARRUS, 3.0]),
    "many times": np.linspace(0.0, 3.0, 2001),
}


@pytest.mark.parametrize("saved", [*list(SAVED)[:2], pytest.param("many times", marks=pytest.mark.slow)])
def test_passages_are_found_once_however_the_run_was_saved(saved):
    """With redundant rows, and two rows lost at once in some."""
    mechanism = sarrus()
    state = raised_exactly(mechanism, np.pi / 3, 0.0)
    found = lx.simulate(mechanism, state, t1=3.0, accuracy=lx.PRECISE, saveat=diffrax.SaveAt(ts=SAVED[saved]))
    passages = found.passages()
    np.testing.assert_allclose(passages.times, SARRUS, atol=1e-7)
    assert passages.accuracy <= 1e-7
