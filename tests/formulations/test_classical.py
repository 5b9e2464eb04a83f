"""The classical formulations in simulations: orders, violations, and where they end."""

import dataclasses

import diffrax
import numpy as np
import pytest
from known_answers import reference, start

import linkax as lx
from linkax.formulations.named import BASES, formulation
from linkax.formulations.switch import in_one_program
from linkax.simulation.integrate.runge_kutta import RungeKutta4

FIXED = {"solver": RungeKutta4(), "stepsize_controller": diffrax.ConstantStepSize()}
NAMES = [
    *BASES,
    "lagrange-multipliers+baumgarte",
    "moore-penrose-svd+baumgarte",
    "moore-penrose-gram-schmidt+baumgarte",
    "lagrange-multipliers+partitioning",
    "augmented-lagrangian+partitioning",
    "moore-penrose-svd+partitioning",
    "moore-penrose-gram-schmidt+partitioning",
    "lagrange-multipliers+projection",
]


def _with_low_penalty(chosen):
    """The penalty's rounding, 1e-9 where it is 1e7, would hide the order."""
    if isinstance(chosen.acceleration, lx.AugmentedLagrangian):
        return dataclasses.replace(chosen, acceleration=lx.AugmentedLagrangian(1e4))
    return chosen


SHARED = dict(zip(NAMES, in_one_program([_with_low_penalty(formulation(name)) for name in NAMES]), strict=True))
COUNTS = {"crank-slider": (1000, 1600, 2400), "pendulum": (80, 160, 320)}


def _known(scene):
    """Mechanism, start, times, and the exact angle and rate of the first joint there."""
    if scene == "crank-slider":
        known = reference("crank_slider_torque")[:21]  # to 1 s
        return *start(scene, "regular"), known["t"], known["theta"], known["theta_dot"]
    known = reference("A01_pendulum")[:3]
    rate = known["x"] * known["vy"] - known["y"] * known["vx"]
    return *start(scene), known["t"], np.arctan2(known["y"], known["x"]), rate


@pytest.mark.parametrize("scene", [pytest.param("crank-slider", marks=pytest.mark.slow), "pendulum"])
@pytest.mark.parametrize("name", NAMES)
def test_order(name, scene):
    """That of the paper's formulation: tests/simulation/test_orders.py."""
    mechanism, state, ts, angle, rate = _known(scene)
    joint = next(iter(mechanism.topology.coordinates))

    def errors(count):
        options = {"dt0": 1.0 / count, "saveat": diffrax.SaveAt(ts=ts), "formulation": SHARED[name], **FIXED}
        found = lx.simulate(mechanism, state, t1=1.0, **options)
        return np.max(np.abs(found.joint(joint) - angle)), np.max(np.abs(found.joint_speed(joint) - rate))

    falls = np.log(np.array([errors(count) for count in COUNTS[scene]]))
    slopes = [np.polyfit(np.log(COUNTS[scene]), level, 1)[0] for level in falls.T]
    assert max(slopes) < -3.5, f"observed orders {[-slope for slope in slopes]}"


def _first_second(variant, chosen, all_rows=False):
    mechanism, state = start("crank-slider", variant)
    if all_rows:
        mechanism = mechanism.with_all_rows()
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 0.8, 21))
    return lx.simulate(mechanism, state, t1=0.8, dt0=0.02, saveat=saveat, formulation=chosen, **FIXED)


@pytest.mark.slow
def test_violations_are_millions_of_times_larger_than_with_the_papers_formulation():
    """SC1 up to its first singular passage; with the usual parameters."""
    ours = _first_second("SC1", None).worst_violation()
    for name in ("lagrange-multipliers", "lagrange-multipliers+baumgarte", "augmented-lagrangian"):
        theirs = _first_second("SC1", SHARED[name]).worst_violation()
        assert theirs.position > 1e6 * max(ours.position, 1e-18)
        assert theirs.velocity > 1e6 * max(ours.velocity, 1e-18)
    closed = _first_second("SC1", SHARED["lagrange-multipliers+partitioning"]).worst_violation()
    assert max(closed.position, closed.velocity) < 1e-13


def test_dependent_rows_stop_multipliers_with_an_error_that_says_so():
    with pytest.raises(lx.SimulationError) as raised:
        _first_second("SC1", formulation("lagrange-multipliers"), all_rows=True)
    message = str(raised.value)
    assert "stopped at t = 0 s" in message
    assert "finds no finite acceleration there: 2 of the 5 loop rows are independent" in message
    assert raised.value.solution.result == lx.RESULTS.diverged
    assert np.all(np.isfinite(raised.value.solution.end.q))


def test_what_is_no_formulation():
    with pytest.raises(ValueError, match=r"formulation is 3; give a name, linkax.TangentSpace\(\) or a"):
        lx.simulate(*start("pendulum"), t1=1.0, formulation=3)
