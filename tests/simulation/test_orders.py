"""Observed orders of convergence with fixed steps, positions and speeds."""

import diffrax
import numpy as np
import pytest
from known_answers import start

import linkax as lx

# Solver, its order, and numbers of steps between rounding and where the order sets in.
SLOW = pytest.mark.slow
SOLVERS = [
    pytest.param(diffrax.Tsit5(), 5, {"crank-slider": (24, 48, 96), "pendulum": (32, 48, 64)}, id="Tsit5"),
    pytest.param(
        diffrax.Dopri5(), 5, {"crank-slider": (48, 64, 96, 128), "pendulum": (48, 64, 96)}, marks=SLOW, id="Dopri5"
    ),
    pytest.param(diffrax.Dopri8(), 8, {"crank-slider": (20, 24, 32), "pendulum": (12, 16, 24)}, id="Dopri8"),
]
RUNS = {"crank-slider": ("regular", 0.4), "pendulum": ("A01", 2.0)}


@pytest.mark.parametrize("name", ["crank-slider", pytest.param("pendulum", marks=SLOW)])
@pytest.mark.parametrize(("solver", "order", "counts"), SOLVERS)
def test_order(name, solver, order, counts):
    variant, t1 = RUNS[name]
    mechanism, state = start(name, variant)
    # Saved at ends of steps, so that the interpolation between them has no part in it.
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, t1, 5))
    exact = lx.simulate(mechanism, state, t1=t1, accuracy=lx.Accuracy(rtol=1e-13))  # with the program of other tests
    q, v = exact.q[::50], exact.v[::50]

    def errors(count):
        fixed = diffrax.ConstantStepSize()
        found = lx.simulate(
            mechanism, state, t1=t1, dt0=t1 / count, solver=solver, stepsize_controller=fixed, saveat=saveat
        )
        return np.max(np.abs(found.q - q)), np.max(np.abs(found.v - v))

    steps = counts[name]
    falls = np.log(np.array([errors(count) for count in steps]))
    slopes = [np.polyfit(np.log(steps), level, 1)[0] for level in falls.T]
    for slope in slopes:
        assert -slope > order - 0.5, f"observed orders {[-slope for slope in slopes]}"
