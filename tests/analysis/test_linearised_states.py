"""Equilibria and small motions of elements with internal states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.analysis.linearisation import StateSlopes

AREAS, DEAD, MODULUS, MASS = (2e-3, 1.2e-3), 1e-4, 1.4e9, 500.0
STIFFNESS = MODULUS * (AREAS[0] ** 2 / (DEAD + AREAS[0] * 0.3) + AREAS[1] ** 2 / (DEAD + AREAS[1] * 0.3))
FREQUENCY = np.sqrt(STIFFNESS / MASS)


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
    np.testing.assert_allclose(natural_frequency(MODULUS), FREQUENCY, rtol=1e-9)


@pytest.mark.slow
def test_its_derivative():
    slope = jax.grad(natural_frequency)(MODULUS)
    np.testing.assert_allclose(slope, FREQUENCY / (2.0 * MODULUS), rtol=1e-7)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivative_of_a_frequency_beside_what_nothing_holds(derivative):
    """Where two pressures push a load, A₁² K₁ + A₂² K₂ = m ω²: place and pressures at rest are a double zero."""

    def frequency(modulus):
        areas, stiffness = jnp.array(AREAS), jnp.full((1, 1), 1e-30)  # which rounding leaves
        by_speeds = modulus * jnp.array([[-AREAS[0]], [AREAS[1]]]) / (DEAD + areas[:, None] * 0.3)
        states = StateSlopes(areas * jnp.array([[1.0, -1.0]]) / MASS, jnp.zeros((2, 1)), by_speeds, jnp.zeros((2, 2)))
        found = lx.Linearisation(jnp.zeros(1), jnp.eye(1), jnp.eye(1), stiffness, jnp.zeros((1, 1)), states)
        # By index: forwards, JAX's rule of the maximum multiplies the NaN of the double zero by zero.
        return found.eigenvalues.imag[jnp.argmax(found.eigenvalues.imag)]

    np.testing.assert_allclose(frequency(MODULUS), FREQUENCY, rtol=1e-12)
    np.testing.assert_allclose(derivative(frequency)(MODULUS), FREQUENCY / (2.0 * MODULUS), rtol=1e-9)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_equal_eigenvalues_are_marked(derivative):
    """Of √(4 ± p), equal at p = 0, and of ones equal but for rounding; 3 √(1 + p) beside them has its own."""

    def frequencies(p, turn=0.0):
        c, s = jnp.cos(turn), jnp.sin(turn)
        axes = jnp.eye(3).at[:2, :2].set(jnp.array([[c, -s], [s, c]]))
        stiffness = axes @ jnp.diag(jnp.stack([4.0 + p, 4.0 - p, 9.0 * (1.0 + p)])) @ axes.T
        found = lx.Linearisation(jnp.zeros(3), jnp.eye(3), jnp.eye(3), stiffness, jnp.zeros((3, 3)))
        return jnp.sort(found.eigenvalues.imag)[3:]

    for turn in (0.0, 0.3):
        slopes = derivative(frequencies)(0.0, turn)
        np.testing.assert_allclose(slopes, [np.nan, np.nan, 1.5], rtol=1e-12)
    np.testing.assert_allclose(derivative(frequencies)(1e-3), [-0.25, 0.25, 1.5], rtol=1e-3)


@pytest.mark.slow
def test_derivatives_of_equal_frequencies_are_marked():
    """Of masses on springs of their own, two of them alike."""

    def frequencies(stiffness):
        bodies = [lx.point_mass(name, 1.0) for name in "abc"]
        joints = [lx.Prismatic(f"along {body.name}", lx.GROUND, body, "x") for body in bodies]
        springs = [lx.JointSpring(joint.name, stiffness[index], 0.0) for index, joint in enumerate(joints)]
        state = lx.State(np.zeros(3), np.zeros(3))
        found = lx.linearise(lx.Mechanism(bodies, joints, springs), state, degrees_of_freedom=3)
        return found.natural_frequencies

    slopes = jax.jit(jax.jacfwd(frequencies))(jnp.array([4.0, 4.0, 9.0]))
    np.testing.assert_allclose(slopes, [3 * [np.nan], 3 * [np.nan], [0.0, 0.0, 1.0 / 6.0]], atol=1e-12)


WEIGHT = 3.0 * 9.81 * 0.5  # of a pendulum of 3 kg and 1 m, as a torque


def held(voltage, current=2.0):
    numbers = {"resistance": 2.0, "inductance": 0.1, "constant": 1.5, "current": current}
    return pendulum(mass=3.0, forces=[lx.DCMotor("hinge", voltage, **numbers, name="motor")])


def test_a_motor_that_holds_a_pendulum():
    """Its current, and the angle at which weight and torque balance, at rest; the eigenvalues of a matrix by hand."""
    angle, inertia = -np.arccos(3.0 / WEIGHT), 1.0
    mechanism = held(4.0)
    state = lx.assemble(mechanism, {"hinge": angle})
    small = lx.linearise(mechanism, state)
    stiffness = -WEIGHT * np.sin(angle) / inertia
    by_hand = np.array([[0.0, 1.0, 0.0], [-stiffness, 0.0, 1.5 / inertia], [0.0, -15.0, -20.0]])
    expected = np.linalg.eigvals(by_hand)
    np.testing.assert_allclose(np.sort_complex(small.eigenvalues), np.sort_complex(expected), rtol=1e-9)
    np.testing.assert_allclose(small.natural_frequencies, np.sqrt(stiffness))  # at constant current
    assert small.eigenvectors.shape == (1, 3)
    with pytest.raises(ValueError, match="internal state 'current' of DCMotor 'motor' changes at t = 0 s"):
        lx.linearise(held(4.1), state)


def resting(voltage):
    mechanism = held(voltage, current=0.0)
    state = lx.equilibrium(mechanism, lx.assemble(mechanism, {"hinge": -1.0}))
    return jnp.stack([state.q[0], state.internal[0]])


def test_an_equilibrium_has_currents_that_stand_still():
    current = 4.0 / 2.0
    np.testing.assert_allclose(resting(4.0), [-np.arccos(1.5 * current / WEIGHT), current], rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_its_derivatives(mode):
    slope = 1.5 / 2.0 / WEIGHT / np.sqrt(1.0 - (3.0 / WEIGHT) ** 2)
    np.testing.assert_allclose(mode(resting)(4.0), [slope, 0.5], rtol=1e-9)


@pytest.mark.slow
def test_an_integrator_holds_its_target_in_equilibrium():
    controller = lx.PIDController("hinge", 0.5, proportional=60.0, integral=30.0, derivative=10.0, name="controller")
    mechanism = pendulum(mass=3.0, forces=[controller])
    state = lx.equilibrium(mechanism, lx.assemble(mechanism, {"hinge": 0.0}))
    np.testing.assert_allclose(state.q, 0.5, rtol=1e-10)
    np.testing.assert_allclose(state.internal, [WEIGHT * np.cos(0.5) / 30.0, 0.0], atol=1e-9)
    assert np.max(lx.linearise(mechanism, state).eigenvalues.real) < 0.0


class Counter(lx.AbstractForce):
    """A clock, which never stands still."""

    @property
    def states(self):
        return {"time": lx.InternalState(0.0, "s")}

    def rates(self, t, motion, states):
        return {"time": jnp.ones(())}

    def load(self, t, motion, states):
        return lx.Load.none(motion.system)


@pytest.mark.slow
def test_what_never_stands_still_has_no_equilibrium():
    mechanism = pendulum(forces=[Counter()])
    with pytest.raises(lx.EquilibriumError, match="no equilibrium near this state"):
        lx.equilibrium(mechanism, lx.assemble(mechanism, {"hinge": -1.5}))


def test_of_what_cannot_move():
    held = pendulum(constraints=[lx.Drive("motor", "hinge", speed=0.0)])
    found = lx.linearise(held, lx.State(jnp.zeros(1), jnp.zeros(1)))
    assert found.eigenvalues.shape == found.natural_frequencies.shape == (0,)
