"""The telescopic crane against beam theory, rigid sections and its own linearisation, and its balance of energy."""

import diffrax
import numpy as np
import pytest
from cranes import REACH, at_rest, chain_of_beams, crane, deflection, main_frequency, rigid, slopes_and_differences

import linkax as lx


@pytest.mark.slow
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


@pytest.mark.slow
def test_main_frequency_is_that_of_the_linearised_crane():
    """After a fifth of the load drops; the first mode is the swinging of the load."""
    _, mechanism, state = crane(payload=1600.0, dropped=400.0)
    times = np.linspace(0.0, 6.0, 601)
    found = lx.simulate(mechanism, state, t1=6.0, saveat=diffrax.SaveAt(ts=times), accuracy=lx.Accuracy(rtol=1e-6))
    height = np.asarray(found.position("section_3", at="tip"))[:, 1]
    modes = lx.linearise(mechanism, lx.equilibrium(mechanism, state)).natural_frequencies / (2.0 * np.pi)
    np.testing.assert_allclose(main_frequency(times, height), modes[1], rtol=3e-3)


@pytest.mark.slow
def test_stiff_sections_move_like_rigid_ones():
    parameters, mechanism, state = crane("luffing", modulus=2.1e16, duration=1.0)
    guides = rigid(parameters)
    begin = at_rest(guides, parameters)
    options = {"t1": 1.0, "saveat": diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 21)), "accuracy": lx.Accuracy(rtol=1e-7)}
    found, expected = (lx.simulate(m, s, **options) for m, s in ((mechanism, state), (guides, begin)))
    for body, at in (("section_3", "tip"), ("payload", None)):
        places = found.position(body, at=at), expected.position(body, at=at)
        np.testing.assert_allclose(*places, atol=1e-6 * REACH)
    for name in ("luffing", "telescoping", "extension_rope"):
        np.testing.assert_allclose(found.reaction(name)[0], expected.reaction(name)[0], rtol=1e-6)


@pytest.mark.slow
def test_derivatives():
    """Of the deflection, and of the main frequency, by height, modulus and load; whatever the number of elements."""
    slopes, differences = slopes_and_differences(elements=1)
    np.testing.assert_allclose(slopes, differences, rtol=1e-5)
