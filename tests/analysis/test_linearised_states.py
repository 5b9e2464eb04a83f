"""Small motions of elements with internal states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

AREAS, DEAD, MODULUS, MASS = (2e-3, 1.2e-3), 1e-4, 1.4e9, 500.0
STIFFNESS = MODULUS * (AREAS[0] ** 2 / (DEAD + AREAS[0] * 0.3) + AREAS[1] ** 2 / (DEAD + AREAS[1] * 0.3))


def natural_frequency(modulus):
    """Of a load on a cylinder whose valve is closed."""
    load = lx.point_mass("load", MASS)
    numbers = {"areas": AREAS, "closed": 0.4, "stroke": 0.6, "valve": 1e-7, "supply": 2e7, "dead_volume": DEAD}
    cylinder = lx.HydraulicCylinder(
        lx.GROUND, load, 0.0, **numbers, bulk_modulus=modulus, pressures=(6e6, 1e7), name="cylinder"
    )
    mechanism = lx.Mechanism([load], [lx.Prismatic("slide", lx.GROUND, load, "x")], [cylinder])
    small = lx.linearise(mechanism, lx.assemble(mechanism, {"slide": 0.7}), degrees_of_freedom=1)
    return jnp.max(jnp.abs(small.eigenvalues.imag))


def test_the_frequency_of_a_load_on_locked_oil():
    np.testing.assert_allclose(natural_frequency(MODULUS), np.sqrt(STIFFNESS / MASS), rtol=1e-9)


@pytest.mark.slow
def test_its_derivative():
    slope = jax.grad(natural_frequency)(MODULUS)
    np.testing.assert_allclose(slope, np.sqrt(STIFFNESS / MASS) / (2.0 * MODULUS), rtol=1e-7)


def test_a_motor_that_holds_a_pendulum():
    """Its current, and the angle at which weight and torque balance, at rest; the eigenvalues of a matrix by hand."""
    rod = lx.rod("rod", 1.0, mass=3.0)
    pin = lx.Revolute("pin", lx.GROUND, rod, "z")

    def held(voltage):
        motor = lx.DCMotor("pin", voltage, resistance=2.0, inductance=0.1, constant=1.5, current=2.0, name="motor")
        return lx.Mechanism([rod], [pin], [lx.Gravity([0.0, -9.81, 0.0]), motor])

    mechanism = held(4.0)
    inertia, weight = 1.0, 3.0 * 9.81 * 0.5
    angle = -np.arccos(3.0 / weight)
    state = lx.assemble(mechanism, {"pin": angle})
    small = lx.linearise(mechanism, state)
    stiffness = -weight * np.sin(angle) / inertia
    by_hand = np.array([[0.0, 1.0, 0.0], [-stiffness, 0.0, 1.5 / inertia], [0.0, -15.0, -20.0]])
    expected = np.linalg.eigvals(by_hand)
    np.testing.assert_allclose(np.sort_complex(small.eigenvalues), np.sort_complex(expected), rtol=1e-9)
    np.testing.assert_allclose(small.natural_frequencies, np.sqrt(stiffness))  # at constant current
    assert small.eigenvectors.shape == (1, 3)
    with pytest.raises(ValueError, match="internal state 'current' of DCMotor 'motor' changes at t = 0 s"):
        lx.linearise(held(4.1), state)
