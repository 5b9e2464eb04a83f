"""Observed orders of convergence with fixed steps, positions and speeds."""

import diffrax
import numpy as np
import pytest

import linkax as lx
from linkax.scenes import SCENES

# Solver, its order, and numbers of steps where the error is above rounding and falls evenly.
SOLVERS = [
    (diffrax.Tsit5(), 5, {"crank-slider": (40, 80, 160), "pendulum": (40, 80, 160)}),
    (diffrax.Dopri5(), 5, {"crank-slider": (40, 80, 160), "pendulum": (40, 80, 160)}),
    (diffrax.Dopri8(), 8, {"crank-slider": (12, 16, 24), "pendulum": (12, 16, 24)}),
]
RUNS = {"crank-slider": ("regular", 0.5), "pendulum": ("A01", 2.0)}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize(("solver", "order", "counts"), SOLVERS, ids=["Tsit5", "Dopri5", "Dopri8"])
def test_order(name, solver, order, counts):
    variant, t1 = RUNS[name]
    scene = SCENES[name]
    settings = scene.settings(variant)
    mechanism = scene.mechanism(settings)
    state = scene.initial(mechanism, settings)
    exact = lx.simulate(mechanism, state, t1=t1, accuracy=lx.Accuracy(rtol=1e-13)).end

    def errors(count):
        end = lx.simulate(
            mechanism,
            state,
            t1=t1,
            dt0=t1 / count,
            solver=solver,
            stepsize_controller=diffrax.ConstantStepSize(),
            saveat=diffrax.SaveAt(t1=True),
        ).end
        return np.max(np.abs(end.q - exact.q)), np.max(np.abs(end.v - exact.v))

    steps = counts[name]
    falls = np.log(np.array([errors(count) for count in steps]))
    slopes = [np.polyfit(np.log(steps), level, 1)[0] for level in falls.T]
    for slope in slopes:
        assert -slope > order - 0.5, f"observed orders {[-slope for slope in slopes]}"
