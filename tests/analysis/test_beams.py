"""Beams at rest and vibrating, against beam theory."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize

import linkax as lx

PLANAR = {"bends": "z", "torsion": False, "stretch": False}


def cantilever(force=(0.0, 0.0, 0.0), moment=0.0, tip_mass=0.0, elements=8, inertia=0.0, **options):
    """Clamped at the origin along x, E I = length = 1, ρ A = 1; force and moment about z at its tip."""
    section = lx.Section(1.0, 1.0, 1e4, 1.0, 400.0, rotary_inertia=inertia)
    beam, load = lx.Beam("beam", 1.0, section, elements=elements, **PLANAR | options), lx.point_mass("load", tip_mass)
    joints = [lx.Fixed("clamp", lx.GROUND, beam), lx.Fixed("end", beam.at("tip"), load)]
    about_z = jnp.asarray(moment) * np.array([0.0, 0.0, 1.0])
    forces = [lx.PointForce(beam.at("tip"), jnp.asarray(force)), lx.PointMoment(beam.at("tip"), about_z)]
    return lx.Mechanism([beam, load], joints, forces)


def at_rest(mechanism):
    return lx.Solution.of_state(mechanism, lx.equilibrium(mechanism, lx.State.as_drawn(mechanism)))


def tip(mechanism):
    return np.asarray(at_rest(mechanism).position("beam", at="tip")[0])


def elastica(load):
    """Tip of a cantilever under a force F L² / E I across it: θ'' = −load cos θ, by shooting from the clamp."""

    def shot(curvature):
        rates = lambda s, y: [y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]
        return integrate.solve_ivp(rates, (0.0, 1.0), [0.0, curvature, 0.0, 0.0], rtol=1e-12, atol=1e-13).y[:, -1]

    curvature = optimize.brentq(lambda curvature: shot(curvature)[1], 0.0, load, xtol=1e-13)
    return shot(curvature)[2:]


def frequencies(mechanism, count):
    state = lx.assemble(mechanism)
    return np.asarray(lx.linearise(mechanism, state).natural_frequencies)[:count]


def roots(condition, guesses):
    return np.array([optimize.brentq(condition, guess - 0.6, guess + 0.6, xtol=1e-14) for guess in guesses])


@pytest.mark.slow
def test_a_small_deflection_with_shear():
    deflection = tip(cantilever((0.0, 1e-4, 0.0), inertia=None, stretch=True, shear=True))[1]
    np.testing.assert_allclose(deflection, 1e-4 * (1.0 / 3.0 + 1.0 / 400.0), rtol=1e-6)


@pytest.mark.parametrize("load", [1.0, 10.0])
def test_elastica(load):
    """The load of 10 is Mattiasson's last (International Journal for Numerical Methods in Engineering 17, 1981)."""
    exact = elastica(load)
    if load == 10.0:
        np.testing.assert_allclose(exact, [1.0 - 0.55500, 0.81061], atol=5e-6)
    np.testing.assert_allclose(tip(cantilever((0.0, load, 0.0)))[:2], exact, atol=3e-7)


@pytest.mark.slow
def test_rolled_up_by_a_moment():
    found = at_rest(cantilever(moment=2.0 * np.pi))
    np.testing.assert_allclose(found.position("beam", at="tip")[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(found.position("beam", at=0.5)[0], [0.0, 1.0 / np.pi, 0.0], atol=1e-9)
    on_circle = np.array([np.sin(0.42 * np.pi), 1 - np.cos(0.42 * np.pi), 0.0]) / (2 * np.pi)
    np.testing.assert_allclose(found.position("beam", at=0.21)[0], on_circle, atol=1e-9)
    np.testing.assert_allclose(found.strain("beam")[0, :, 2], 2.0 * np.pi, rtol=1e-9)
    # The clamp, and any section, carries the moment alone.
    for joint in ("clamp", "beam", "beam[7]"):
        np.testing.assert_allclose(found.reaction(joint, on="parent").moment[0], [0.0, 0.0, 2.0 * np.pi], atol=1e-8)


@pytest.mark.slow
def test_frequencies_of_a_cantilever():
    exact = roots(lambda x: np.cos(x) * np.cosh(x) + 1.0, [1.9, 4.7, 7.9]) ** 2
    np.testing.assert_allclose(frequencies(cantilever(), 3), exact, rtol=1e-3)
    # With a tip mass as heavy as the beam.
    weighed = lambda x: 1 + np.cos(x) * np.cosh(x) + x * (np.cos(x) * np.sinh(x) - np.sin(x) * np.cosh(x))
    exact = roots(weighed, [1.2, 4.0, 7.1]) ** 2
    np.testing.assert_allclose(frequencies(cantilever(tip_mass=1.0), 3), exact, rtol=1e-3)


@pytest.mark.slow
def test_frequencies_of_a_free_beam():
    beam = lx.Beam("beam", 1.0, lx.Section(1.0, 1.0), **PLANAR)
    free = lx.Mechanism([beam], [lx.Planar("afloat", lx.GROUND, beam, axis="z")])
    found = frequencies(free, 6)
    exact = roots(lambda x: np.cos(x) * np.cosh(x) - 1.0, [4.7, 7.9, 11.0]) ** 2
    np.testing.assert_allclose(found[:3], 0.0, atol=1e-3)
    np.testing.assert_allclose(found[3:], exact, rtol=1e-3)


@pytest.mark.slow
def test_frequencies_of_a_pinned_beam():
    beam, shoe = lx.Beam("beam", 1.0, lx.Section(1.0, 1.0), **PLANAR), lx.point_mass("shoe", 0.0)
    joints = [
        lx.Revolute("left", lx.GROUND, beam, axis="z"),
        lx.Prismatic("rail", lx.GROUND, shoe, axis="x"),
        lx.Revolute("right", beam.at("tip"), shoe, axis="z"),
    ]
    pinned = lx.Mechanism([beam, shoe], joints)
    state = lx.assemble(pinned, guess={"rail": 1.0})
    found = lx.linearise(pinned, state).natural_frequencies[:3]
    np.testing.assert_allclose(found, (np.pi * np.arange(1, 4)) ** 2, rtol=1e-3)


@pytest.mark.slow
def test_published_cantilevers():
    """Figures of other codes: a large force across, and a torque with a moment (stiffnesses as they have them)."""
    # Nachbagauer, Pechstein, Irschik, Gerstmayr, Multibody System Dynamics 26 (2011), as in Exudyn's test models.
    section = lx.rectangle(0.5, 0.1, lx.Material(2.07e11, 0.3, 1.0))
    beam = lx.Beam("beam", 2.0, section, bends="z", torsion=False, shear=True)  # else it gives way sideways
    force = lx.PointForce(beam.at("tip"), [0.0, 62.5e6, 0.0])
    moved = tip(lx.Mechanism([beam], [lx.Fixed("clamp", lx.GROUND, beam)], [force])) - np.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(moved, [-0.15097103, 0.71056837, 0.0], atol=2e-6)
    # Nachbagauer, Gruber, Gerstmayr, Journal of Computational and Nonlinear Dynamics 8 (2013), table 4, likewise.
    width, height, shear = 0.2, 0.4, 2.07e11 / 2.6
    moments = np.array([width * height**3, height * width**3]) / 12.0
    section = lx.Section(
        2.07e11 * moments,
        7850.0 * 0.08,
        2.07e11 * 0.08,
        0.5768 * shear * moments.sum(),
        shear * 0.08 * np.array([0.8331, 0.7961]),
    )
    beam = lx.Beam("beam", 2.0, section, shear=True)
    moment = lx.PointMoment(beam.at("tip"), [0.5e6, 2e6, 0.0])
    moved = tip(lx.Mechanism([beam], [lx.Fixed("clamp", lx.GROUND, beam)], [moment])) - np.array([2.0, 0.0, 0.0])
    np.testing.assert_allclose(np.abs(moved), [1.09436e-4, 1.86452e-4, 1.8117402e-2], rtol=1e-4)


@pytest.mark.slow
def test_princeton_beam():
    """A bar clamped at an angle to its load: bending about both axes and twist, all of them large.

    Dowell and Traybar's experiment (Princeton, 1975). Displacements by a commercial code's beams, published in
    Obrezkov, Mikkola, Matikainen et al., Nonlinear Dynamics 109 (2022) and kept in Exudyn's test models; its solids
    differ by up to 3 %. Stiffnesses of Bauchau et al., Multibody System Dynamics 37 (2016), as in MBDyn's benchmark.
    """
    section = lx.Section([36.2794, 2.42873], 0.1, 2.84191e6, 3.10338, [6.40131e5, 9.03881e5])
    beam = lx.Beam("beam", 0.508, section, shear=True)
    along_height = {30: 0.01665873206, 45: 0.01518618440, 60: 0.01157837500, 90: 0.0}
    along_width = {30: 0.117735994, 45: 0.156467239, 60: 0.181861627, 90: 0.200677707}
    for degrees in along_height:
        angle = np.radians(degrees)
        force = lx.PointForce(beam.at("tip"), 13.345 * np.array([0.0, np.sin(angle), np.cos(angle)]))
        moved = tip(lx.Mechanism([beam], [lx.Fixed("clamp", lx.GROUND, beam)], [force]))
        np.testing.assert_allclose(moved[1:], [along_width[degrees], along_height[degrees]], rtol=0.015, atol=1e-6)


@pytest.mark.slow
def test_errors_fall_with_the_fourth_power_of_the_elements():
    exact, counts = elastica(4.0), [2, 4, 8]
    errors = [np.linalg.norm(tip(cantilever((0.0, 4.0, 0.0), elements=count))[:2] - exact) for count in counts]
    assert np.all(np.diff(np.log2(errors)) < -3.4)


@pytest.mark.slow
def test_derivatives_of_deflection_and_frequency():
    """Of a loaded cantilever, by the height of its profile, its modulus and its load."""

    def found(height, modulus, load):
        section = lx.rectangle(0.05, height, lx.Material(modulus, 0.3, 2700.0), 0.004)
        beam = lx.Beam("beam", 2.0, section, elements=2, bends="y", torsion=False)
        weight = lx.point_mass("weight", load)
        joints = [lx.Fixed("clamp", lx.GROUND, beam), lx.Fixed("hook", beam.at("tip"), weight)]
        mechanism = lx.Mechanism([beam, weight], joints, [lx.Gravity([0.0, 0.0, -9.81])])
        rest = lx.equilibrium(mechanism, lx.State(jnp.zeros(6), jnp.zeros(6)))
        deflection = lx.Solution.of_state(mechanism, rest).position("beam", at="tip")[0, 2]
        frequency = lx.linearise(mechanism, rest, degrees_of_freedom=6).natural_frequencies[0]
        return jnp.stack([deflection, frequency])

    at, found = np.array([0.06, 7e10, 30.0]), jax.jit(found)
    slopes = np.stack(jax.jit(jax.jacfwd(found, (0, 1, 2)))(*at), axis=1)
    for index, value in enumerate(at):
        step = np.eye(3)[index] * value * 1e-4
        differences = (found(*(at + step)) - found(*(at - step))) / (2e-4 * value)
        np.testing.assert_allclose(slopes[:, index], differences, rtol=1e-5)
