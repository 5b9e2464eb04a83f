"""The telescopic crane against beam theory, rigid sections and its own linearisation; its energy, oil and courses."""

import diffrax
import jax
import numpy as np
import pytest
from cranes import REACH, SCENE, chain_of_beams, crane, deflection, main_frequency, rigid, slopes_and_differences

import linkax as lx
from linkax.scenes.telescopic_crane import STROKES, Course, Reach


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
    options = {"t1": 1.0, "saveat": diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 21)), "accuracy": lx.Accuracy(rtol=1e-7)}
    found, expected = (lx.simulate(m, s, **options) for m, s in ((mechanism, state), rigid(parameters)))
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


def lifted(**changes):
    """The hydraulic crane while it lifts and extends, and by how much its cylinders are behind their courses [m]."""
    parameters, mechanism, state = crane("hydraulic", elements=1, **changes)
    times = np.linspace(0.0, 4.0, 801)
    found = lx.simulate(mechanism, state, t1=4.0, saveat=diffrax.SaveAt(ts=times), accuracy=lx.Accuracy(rtol=1e-7))
    course = lambda name: Course(
        *map(np.float64, (parameters[name], parameters[name] + parameters[f"{name}_change"], parameters["duration"]))
    )
    courses = {"luffing": Reach(course("angle")), "telescoping": course("extension")}
    behind = {name: jax.vmap(course)(times) - found.length(name) for name, course in courses.items()}
    return parameters, found, courses, behind


@pytest.mark.slow
def test_hydraulic_cylinders_carry_the_crane_at_rest():
    """With the reactions of prescribed lengths; where oil leaks, pressures add up to that of the pump."""
    parameters, mechanism, state = crane("hydraulic", elements=1)
    for name in STROKES:
        pressures = lx.Solution.of_state(mechanism, state).states(name)
        np.testing.assert_allclose(pressures["a"] + pressures["b"], parameters["supply"], rtol=1e-9)
    # Without leakage cylinders have the prescribed lengths at rest; else they are behind by what opens the valves.
    parameters, mechanism, state = crane("hydraulic", elements=1, leakage=0.0)
    found = lx.Solution.of_state(mechanism, state)
    prescribed = SCENE.mechanism(parameters | {"cylinders": 1})
    held = lx.Solution.of_state(prescribed, lx.State(state.q, state.v))
    for name in STROKES:
        np.testing.assert_allclose(found.force(name), held.reaction(name), rtol=1e-6)


@pytest.mark.slow
def test_hydraulic_cylinders_follow_their_courses():
    """The less behind, the higher the gain; their oil is compressed, displaced or leaks."""
    peaks = []
    for gain in (0.5, 1.0):
        parameters, found, courses, behind = lifted(gain=gain, bulk_modulus=1.4e10)
        peaks.append([np.max(np.abs(behind[name])) for name in STROKES])
    assert np.all(np.array(peaks[1]) < 0.75 * np.array(peaks[0]))
    assert np.all(np.array(peaks[0]) < 0.1)
    for name, (closed, _) in STROKES.items():
        area, bulk = np.pi / 4.0 * parameters[f"{name}_bore"] ** 2, parameters["bulk_modulus"]
        pressure, other = (np.asarray(found.states(name)[chamber]) for chamber in ("a", "b"))
        speed = jax.vmap(jax.grad(courses[name]))(found.ts)
        opened = (speed + gain * behind[name]) * area / np.sqrt(parameters["supply"] / 2.0)
        flow = opened * np.sqrt(parameters["supply"] - pressure) - parameters["leakage"] * (pressure - other)
        density = np.exp(pressure / bulk)
        oil = density * (parameters["dead_volume"] + area * (np.asarray(found.length(name)) - closed))
        rate = density * flow
        gained = np.cumsum(rate[:-2:2] + 4.0 * rate[1:-1:2] + rate[2::2]) * (found.ts[2] - found.ts[0]) / 6.0
        np.testing.assert_allclose(oil[2::2] - oil[0], gained, atol=1e-4 * np.ptp(oil))
