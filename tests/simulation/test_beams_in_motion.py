"""Beams in motion: energy, waves, published motions."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.simulation.integrate.default_solver import default_solver


def released(damping=0.0):
    """A rubber bar clamped at one end, which falls with a weight off its axis: bent both ways, twisted, stretched."""
    rubber = lx.Material(2e7, 0.45, 1000.0)
    beam = lx.Beam("beam", 1.0, lx.rectangle(0.02, 0.03, rubber), elements=1, damping=damping)
    load = lx.point_mass("load", 0.1)
    joints = [lx.Fixed("clamp", lx.GROUND, beam), lx.Fixed("hook", beam.at([1.0, 0.1, 0.0]), load)]
    return lx.Mechanism([beam, load], joints, [lx.Gravity([0.0, 3.0, -9.81])])


@pytest.mark.slow
def test_energy_of_a_falling_bar():
    """Released from straight; with damping, what is lost is the power of the damping forces."""
    free = lx.simulate(released(), lx.assemble(released()), t1=0.1, solver=diffrax.Dopri8())
    kinetic = float(jnp.max(free.kinetic_energy()))
    np.testing.assert_allclose(free.energy(), free.energy()[0], atol=1e-6 * kinetic)
    assert float(jnp.max(jnp.abs(free.position("load")[:, 1:] - free.position("load")[0, 1:]))) > 0.05
    often = diffrax.SaveAt(ts=np.linspace(0.0, 0.1, 2001))
    damped = lx.simulate(released(1e-3), lx.assemble(released()), t1=0.1, saveat=often, solver=diffrax.Dopri8())
    lost = np.asarray(damped.energy()[0] - damped.energy())
    power = -np.asarray(damped.power().forces)
    step = float(damped.ts[1] - damped.ts[0])
    steps = (power[:-2:2] + 4.0 * power[1:-1:2] + power[2::2]) * step / 3.0
    np.testing.assert_allclose(np.cumsum(steps), lost[2::2], atol=1e-6 * kinetic)
    assert lost[-1] > 1e-3 * kinetic


@pytest.mark.slow
def test_single_precision():
    mechanism, state = released(), lx.assemble(released())
    options = {"t1": 0.02, "solver": diffrax.Dopri8(), "accuracy": lx.Accuracy(1e-5)}
    single = lx.simulate(mechanism, state, dtype=jnp.float32, **options)
    assert single.q.dtype == jnp.float32
    np.testing.assert_allclose(single.q, lx.simulate(mechanism, state, **options).q, atol=1e-3)


@pytest.mark.slow
def test_spin_up():
    """A rotating cantilever that is brought up to speed (Kane; Simo and Vu-Quoc, CMAME 66, 1988, figure 6).

    Figures read off their graphs, as in the verification manual of a commercial code (VM258): largest lag 0.575,
    largest shortening 0.019. In the end there is no lag.
    """
    section = lx.Section(1.4e4, 1.2, rotary_inertia=6e-4)
    beam = lx.Beam("beam", 10.0, section, elements=4, bends="z", torsion=False, stretch=False)

    def turned(t):
        rising = 0.4 * (t**2 / 2.0 + (7.5 / jnp.pi) ** 2 * (jnp.cos(2.0 * jnp.pi * t / 15.0) - 1.0))
        return jnp.where(t < 15.0, rising, 6.0 * t - 45.0)

    hub = lx.Revolute("hub", lx.GROUND, beam, axis="z")
    mechanism = lx.Mechanism([beam], [hub], [], [lx.Drive("motor", "hub", turned)])
    accuracy = lx.Accuracy(rtol=1e-5)
    found = lx.simulate(mechanism, lx.assemble(mechanism), t1=20.0, solver=diffrax.Kvaerno5(), accuracy=accuracy)
    place, angle = np.asarray(found.position("beam", at="tip")), np.asarray(found.joint("hub"))
    along = np.cos(angle) * place[:, 0] + np.sin(angle) * place[:, 1] - 10.0
    across = np.cos(angle) * place[:, 1] - np.sin(angle) * place[:, 0]
    np.testing.assert_allclose([across.min(), along.min()], [-0.575, -0.019], rtol=0.02)
    assert 6.6 < found.ts[across.argmin()] < 6.9
    after = np.asarray(found.ts) > 16.0
    np.testing.assert_allclose(across[after], 0.0, atol=0.02 * 0.575)


@pytest.mark.slow
def test_a_sleeve_that_slides_over_nodes():
    """At a node it moves like anywhere; falling off a bent beam, it loses no energy."""
    rubber = lx.Material(2e7, 0.45, 1000.0)
    beam = lx.Beam("beam", 2.0, lx.rectangle(0.05, 0.05, rubber), elements=2, bends="z", torsion=False)
    ring = lx.point_mass("ring", 0.05)
    joints = [lx.Fixed("clamp", lx.GROUND, beam), lx.Sliding("sleeve", beam, ring)]
    mechanism = lx.Mechanism([beam, ring], joints, [lx.Gravity([4.0, -9.81, 0.0])])
    at_node = lx.assemble(mechanism, {"sleeve": 1.0}, {"sleeve": 2.0})
    np.testing.assert_allclose(lx.Solution.of_state(mechanism, at_node).velocity("ring")[0], [2.0, 0.0, 0.0])
    begin = lx.assemble(mechanism, {"sleeve": 0.8}, {"sleeve": 2.0})
    found = lx.simulate(mechanism, begin, t1=0.2, solver=diffrax.Dopri8())
    assert found.joint("sleeve")[-1] > 1.2
    np.testing.assert_allclose(found.energy(), found.energy()[0], atol=1e-6 * float(jnp.max(found.kinetic_energy())))


STEEL = lx.rectangle(0.02, 0.02, lx.Material(2e11, 0.3, 7850.0))


def arm(elements=2, **options):
    beam = lx.Beam("arm", 1.0, STEEL, elements=elements, **{"bends": "y", "torsion": False, "stretch": False} | options)
    hinge = lx.Revolute("hinge", lx.GROUND, beam.at("base"), axis="y")
    return lx.Mechanism([beam], [hinge])


# Compiled, seconds of processor of Dopri8 and Kvaerno5, for 0.02 s of eight elements: undamped 1.3 and 1.3 at rtol 1e-4
# and 2.1 and 24 at 1e-8; with `damping` 1e-4 7.9 and 0.2, 7.9 and 1.2.
@pytest.mark.parametrize(
    ("options", "rtol", "duration", "expected"),
    [
        ({}, 1e-8, 0.2, diffrax.Dopri8),
        ({"stretch": True}, 1e-8, 0.2, diffrax.Dopri8),
        ({"damping": 1e-4}, 1e-8, 0.2, diffrax.Dopri8),
        ({"elements": 8, "damping": 1e-4}, 1e-8, 0.02, lx.Rodas5P),
        ({}, 1e-4, 0.2, lx.Rodas5P),
        ({}, 1e-8, 20.0, lx.Rodas5P),
        ({}, None, 0.2, lx.Rodas5P),
    ],
)
def test_the_default_solver_is_the_quicker_one(options, rtol, duration, expected):
    assert isinstance(default_solver(arm(**options), rtol, duration), expected)


def test_the_default_solver_where_numbers_are_traced():
    chosen = []
    run = lambda rtol: chosen.append(default_solver(arm(), rtol, 0.2)) or rtol
    jax.jit(run)(1e-8)
    assert isinstance(chosen[0], diffrax.Kvaerno5)


@pytest.mark.slow
@pytest.mark.parametrize("strain", ["bending", "stretch", "torsion", "shear"])
@pytest.mark.parametrize("elements", [2, 8])
def test_the_fastest_frequency_is_about_right(strain, elements):
    mechanism = arm(elements, **({} if strain == "bending" else {strain: True}))
    exact = lx.linearise(mechanism, lx.assemble(mechanism, {"hinge": 0.0})).natural_frequencies[-1]
    assert 0.6 < mechanism.beams[0].fastest_frequency / exact < 1.6
