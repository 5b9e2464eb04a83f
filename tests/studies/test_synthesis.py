"""Linkages are found again from what they do, under conditions."""

import numpy as np
import pytest

import linkax as lx

BARS, FIXED = {"crank": "OA", "coupler": "ABP", "rocker": "CB"}, "OC"
PINS = {"O": [0.0, 0.0], "A": [0.0, 0.4], "B": [1.0, 0.9], "C": [1.2, 0.0], "P": [0.4, 1.0]}
TURN = np.linspace(0.0, 2.0 * np.pi, 13)
LEAST = 0.85  # transmission angle [rad]


def turned(pins):
    mechanism = lx.linkage(pins, BARS, FIXED)
    return lx.trace(mechanism, lx.State.as_drawn(mechanism), {"O": TURN}, throw=False)


@pytest.fixture(scope="module")
def path():
    return np.asarray(turned(PINS).position("coupler", "P"))[:, :2]


@pytest.fixture(scope="module")
def found(path):
    """With the transmission angle that this four-bar does not have everywhere."""

    def four_bar(pins):
        trace = turned(pins)
        conditions = {"transmission angle": trace.transmission_angle("B", "C") - LEAST}
        return lx.Candidate(trace.position("coupler", "P")[:, :2] - path, conditions, trace)

    params = {pin: lx.Bounded(place, -2.0, 2.0) for pin, place in PINS.items()}
    return lx.synthesis(four_bar, params, starts=250, kept=20, seed=1, steps=40, progress=False)


@pytest.mark.slow
def test_conditions_hold_at_the_best(found):
    assert found.met[0]
    best = found.candidate(0)
    assert best.trace.result == lx.RESULTS.successful
    angles = np.asarray(best.trace.transmission_angle("B", "C"))
    assert np.min(angles) >= LEAST - 1e-6
    np.testing.assert_allclose(np.min(angles) - LEAST, found.conditions["transmission angle"][0], atol=1e-12)
    np.testing.assert_allclose(np.sum(np.asarray(best.error) ** 2), found.errors[0], rtol=1e-9)


@pytest.mark.slow
def test_the_condition_binds(found, path):
    """Without it, the four-bar that draws the path has no error; with it, some, on the edge of what is allowed."""
    angles = np.asarray(turned(PINS).transmission_angle("B", "C"))
    assert np.min(angles) < LEAST
    assert found.errors[0] > 1e-8
    assert abs(found.conditions["transmission angle"][0]) < 1e-6


@pytest.mark.slow
def test_linkages_are_sorted_and_differ(found):
    assert np.all(np.diff(found.errors[found.met]) >= 0.0)
    assert not np.any(np.diff(found.met.astype(int)) > 0)
    places = np.concatenate([found.params[pin] for pin in sorted(PINS)], axis=1) / 4.0
    apart = np.max(np.abs(places[:, None] - places[None]), axis=2) + np.eye(len(places))
    assert np.min(apart) > 1e-3
    assert 0 < found.possible <= 250
    assert "transmission angle" in str(found)


LINE = lambda params: lx.Candidate({"there": params["x"] - 0.3}, {"above": params["x"][0] - 0.5})


def test_a_condition_decides_what_a_square_leaves():
    """min (x − 0.3)² over two numbers, the first of which must be 0.5 or more."""
    found = lx.synthesis(LINE, {"x": lx.Bounded([0.9, 0.9], 0.0, 1.0)}, starts=20, kept=5, progress=False)
    np.testing.assert_allclose(found.params_of(0)["x"], [0.5, 0.3], atol=1e-5)
    np.testing.assert_allclose(found.errors[0], 0.04, rtol=1e-4)
    assert len(found.errors) == 1  # all led there
    with pytest.raises(ValueError, match=r"index is 99; .* linkages were found"):
        found.candidate(99)


FREE = {"x": lx.Bounded(0.5, 0.0, 1.0)}
BAD = {
    "bounds": (LINE, {"x": 1.0}, r"params .* between bounds"),
    "candidate": (lambda params: params["x"], FREE, "return linkax.Candidate"),
    "finite": (lambda params: lx.Candidate(params["x"] / 0.0), FREE, "finite at none of 20 starts"),
    "trace": (lambda params: lx.Candidate(params["x"], {}, params["x"]), FREE, "what linkax.trace returned"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_synthesis(case):
    function, params, message = BAD[case]
    with pytest.raises(ValueError, match=message):
        lx.synthesis(function, params, starts=20, kept=5, progress=False)


def test_a_linkage_is_closed_as_drawn():
    mechanism = lx.linkage(PINS, BARS, FIXED)
    assert [joint.name for joint in mechanism.joints] == ["O", "C", "A", "B"]
    assert lx.mobility(mechanism, lx.State.as_drawn(mechanism)).degrees_of_freedom == 1
    trace = lx.trace(mechanism, lx.State.as_drawn(mechanism), {"O": [0.0]})
    for pin, body in {"B": "rocker", "P": "coupler"}.items():
        np.testing.assert_allclose(trace.position(body, pin)[0], [*PINS[pin], 0.0], atol=1e-14)


def test_pins_of_three_bars_have_two_joints():
    mechanism = lx.linkage({"O": [0, 0], "A": [1, 0], "B": [2, 0]}, {"a": "OA", "b": "AB", "c": "AB"}, fixed="O")
    assert [joint.name for joint in mechanism.joints] == ["O", "A_b", "A_c", "B"]


@pytest.mark.parametrize(
    ("pins", "bars", "message"),
    [
        ({"O": [0.0, 0.0, 0.0]}, {"a": "OA"}, "pin 'O': place"),
        ({"O": [0.0, 0.0]}, {"a": "OA"}, "bar 'a' has pin 'A'; known: 'O'"),
        ({"O": [0.0, 0.0]}, {"a": "O"}, "bar 'a' has pins"),
    ],
    ids=["shape", "unknown", "one"],
)
def test_bad_linkages(pins, bars, message):
    with pytest.raises(ValueError, match=message):
        lx.linkage(pins, bars, fixed="O")
