"""The telescopic crane against beam theory, and its balance of energy."""

import diffrax
import numpy as np
import pytest
from cranes import SCENE, chain_of_beams, deflection

import linkax as lx


def crane(variant="release", **changes):
    """Parameters, mechanism and start."""
    parameters = SCENE.settings(variant, changes)
    mechanism = SCENE.mechanism(parameters)
    return parameters, mechanism, SCENE.initial(mechanism, parameters)


def test_deflection_against_a_chain_of_beams():
    """In so little gravity that deflections are small."""
    parameters, mechanism, state = crane(gravity=9.81e-3, payload=2000.0, dropped=0.0)
    np.testing.assert_allclose(deflection(mechanism, state, parameters), chain_of_beams(parameters), rtol=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "changes"), [("release", {}), ("luffing", {"duration": 0.5}), ("telescoping", {"duration": 0.5})]
)
def test_energy_and_loops(variant, changes):
    """What cylinders put in and damping takes out is the change of the energy; with loops closed to rounding.

    Saved times, as accurate as the explicit steps, crowd at the start, where fast modes are damped.
    """
    _, mechanism, state = crane(variant, **changes)
    parts = np.linspace(0.0, 1.0, 401)
    found = lx.simulate(mechanism, state, t1=0.2, saveat=diffrax.SaveAt(ts=0.2 * parts**3), solver=diffrax.Dopri8())
    power, energy = found.power(), np.asarray(found.energy())
    share = np.asarray(power.forces + power.drives) * 0.6 * parts**2 * parts[1]
    work = np.cumsum((share[:-2:2] + 4.0 * share[1:-1:2] + share[2::2]) / 3.0)
    np.testing.assert_allclose(energy[2::2] - energy[0], work, atol=1e-6 * np.ptp(energy))
    assert found.worst_violation().position <= 1e-12
