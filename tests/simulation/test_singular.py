"""Through singular configurations at any tolerance, with any step."""

import itertools

import diffrax
import numpy as np
import pytest
from known_answers import PASSING, n_four_bar, start

import linkax as lx

TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12, 1e-13)
ROUNDING = 1e-10  # what errors may differ between steps, where they do not fall
# Largest error over rtol: a factor for each family, from 1e-6 to 1e-13 alike. Its motions amplify
# rounding, a few 1e-13 at a passage, by as much.
GROWTH = {"crank-slider": 400.0, "n-four-bar": 2000.0}
PASSAGE = 2.5e-13


# All of Dopri8; benchmarks/singular_passages.py has the others in full.
MATRIX = [(diffrax.Dopri8(), name) for name in PASSING]
MATRIX += [(diffrax.Dopri5(), name) for name in PASSING if name.startswith("SC")]
MATRIX += [(diffrax.Tsit5(), name) for name in ("FL1", "FL2", "A02-1")]
FAST = ("SC1", "SC2", "SC3", "SC4", "A02-1")
mark = lambda s, name: [] if name in FAST and isinstance(s, diffrax.Dopri8) else [pytest.mark.slow]
MARKED = [pytest.param(s, name, marks=mark(s, name), id=f"{type(s).__name__}-{name}") for s, name in MATRIX]


@pytest.mark.parametrize(("solver", "name"), MARKED)
def test_tighter_tolerances_are_never_worse(solver, name):
    run = PASSING[name]
    errors, steps = [], []
    for rtol in TOLERANCES:
        found = run.simulate(accuracy=lx.Accuracy(rtol=rtol), solver=solver)
        errors.append(np.max(run.error(found)))
        steps.append(int(found.stats["num_steps"]))
    rounding = GROWTH[run.scene] * PASSAGE
    assert all(tighter <= looser + rounding for looser, tighter in itertools.pairwise(errors)), errors
    # On the branch, at every tolerance: a run that leaves it is wrong by the size of the mechanism.
    assert np.all(errors <= GROWTH[run.scene] * np.array(TOLERANCES) + rounding), errors
    if solver.order(None) == 8:
        assert steps[3] <= 3 * steps[2]


@pytest.mark.parametrize("count", [1, *(pytest.param(count, marks=pytest.mark.slow) for count in (2, 5))])
def test_row_of_four_bars_stays_on_its_branch(count):
    found = lx.simulate(*start("n-four-bar", "A02", {"N": count}), t1=10.0, accuracy=lx.PRECISE)
    error = found.position("link_0", at="tip")[-1, :2] - n_four_bar(10.0, count)
    assert np.linalg.norm(error) <= 1e-8
    angles = np.stack([found.joint(f"pivot_{i}") for i in range(count + 1)])
    assert np.max(np.abs(angles - angles[0])) <= 1e-9
    # The rank drops to count where the links lie in line, at no saved time here.
    assert np.all(found.rank() == 2 * count)


@pytest.mark.parametrize(
    ("solver", "name"),
    [
        pytest.param(lx.RungeKutta4(), "SC2", id="RK4"),
        pytest.param(diffrax.Dopri8(), "FL1", id="Dopri8", marks=pytest.mark.slow),
    ],
)
def test_smaller_fixed_steps_are_never_worse(solver, name):
    run = PASSING[name]._replace(t1=5.0)
    errors = []
    for step in (10e-3, 5e-3, 2e-3, 1e-3, 0.5e-3):
        found = run.simulate(dt0=step, solver=solver, stepsize_controller=diffrax.ConstantStepSize())
        errors.append(np.max(run.error(found)))
    assert all(finer <= coarser + ROUNDING for coarser, finer in itertools.pairwise(errors)), errors
    assert errors[-1] <= ROUNDING


def test_a_motion_far_from_singular_is_the_same_without_the_clearance():
    mechanism, state = start("crank-slider", "regular")
    with_it, without = (
        lx.simulate(mechanism, state, t1=2.0, accuracy=lx.Accuracy(clearance=clearance)) for clearance in (1e-2, 0.0)
    )
    assert with_it.stats["num_steps"] == without.stats["num_steps"]
    np.testing.assert_array_equal(with_it.q, without.q)


def test_a_long_run_stays_on_its_branch():
    """About a thousand passages; 10 000 s are in benchmarks/singular_passages.py."""
    mechanism, state = start("n-four-bar", "A02", {"N": 1})
    found = lx.simulate(mechanism, state, t1=1000.0)
    angles = np.stack([found.joint(f"pivot_{i}") for i in range(2)])
    assert np.max(np.abs(angles[0] - angles[1])) <= 1e-9
    position, velocity, acceleration = found.worst_violation()
    assert max(position, velocity, acceleration) <= 1e-12
