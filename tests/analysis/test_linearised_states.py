"""Equilibria and small motions of elements with internal states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.analysis.eigenpairs import eigh, spectrum, symmetric_spectrum
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


def test_zeros_are_zero_and_what_is_slow_is_not():
    """Nothing holds one place, and 1e-5 rad/s is beside 1e8: zeros are exact, and move no other eigenvalue."""
    turn = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    values = lambda stiffness: lx.Linearisation(*np.zeros((2, 3)), np.eye(3), stiffness, np.zeros((3, 3))).eigenvalues
    for squares, axes, most in (([0.0, 1e-10, 1e16], np.eye(3), 1e-13), ([0.0, 1e-4, 3.0], turn, 1e-10)):
        found = values(axes @ np.diag(squares) @ axes.T)
        assert np.sum(found == 0.0) == 2
        rates = np.sort(found.imag)[[-1, -2]]
        np.testing.assert_allclose(rates, np.sqrt(squares[:0:-1]), rtol=most)
        np.testing.assert_allclose(found.real, 0.0, atol=most * rates[0])


def test_eigenvectors_beside_zeros():
    """A v = λ v for all of them, also where one to three zeros follow from each other; one by itself is rounding."""
    random = np.random.default_rng(0)
    for chain in range(1, 4):
        jordan = np.zeros((6, 6))
        jordan[:chain, :chain] = np.eye(chain, k=1)
        jordan[chain:, chain:] = random.normal(size=(6 - chain, 6 - chain))
        other = random.normal(size=(6, 6))
        matrix = jnp.asarray(other @ jordan @ np.linalg.inv(other))
        found, vectors = map(np.asarray, spectrum(matrix))
        assert np.sum(found == 0.0) == (chain if chain > 1 else 0)
        np.testing.assert_allclose(matrix @ vectors, vectors * found, atol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1.0, rtol=1e-12)
        exact = np.append(np.linalg.eigvals(jordan[chain:, chain:]), np.zeros(chain))
        for value in exact:
            np.testing.assert_allclose(np.min(np.abs(found - value)), 0.0, atol=1e-11)


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.diag([1.0, 1.0, 2.0])])
def test_equal_frequencies_spoil_nothing_that_a_loss_leaves_out(matrix):
    """The trace of a symmetric matrix has a derivative by it, as has another matrix' times zero."""
    left_out = lambda matrix: symmetric_spectrum(matrix)[0][:2]
    np.testing.assert_array_equal(jax.jacrev(lambda matrix: jnp.sum(0.0 * left_out(matrix)))(matrix), np.zeros((3, 3)))
    np.testing.assert_array_equal(jax.jacrev(lambda matrix: jnp.sum(eigh(matrix)[0]))(matrix), np.eye(3))
    assert np.all(np.isfinite(jax.jacfwd(lambda matrix: eigh(matrix))(matrix)[1]))


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivative_of_a_decay_beside_two_carts_that_nothing_holds(derivative):
    """Their stiffness is zero twice, exactly; the damped one's λ = −c / m."""

    def decay(damping):
        carts = [lx.point_mass(name, 2.0) for name in "ab"]
        joints = [lx.Prismatic(f"along {cart.name}", lx.GROUND, cart, "x") for cart in carts]
        mechanism = lx.Mechanism(carts, joints, [lx.JointDamper("along a", damping)])
        values = lx.linearise(mechanism, lx.State(np.zeros(2), np.zeros(2)), degrees_of_freedom=2).eigenvalues.real
        return values[jnp.argmin(values)]

    np.testing.assert_allclose(derivative(jax.jit(decay))(0.5), -0.5, rtol=1e-12)


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
