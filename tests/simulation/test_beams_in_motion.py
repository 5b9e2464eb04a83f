"""Beams in motion: energy, waves, published motions."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx


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
