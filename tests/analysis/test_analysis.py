"""Mobility, inverse dynamics, equilibrium and vibration at a state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import start
from mechanisms import pendulum

import linkax as lx
from linkax.scenes import SCENES


def test_mobility_of_a_bricard_names_its_redundant_rows():
    found = lx.mobility(*start("bricard"))
    assert (found.rank, found.degrees_of_freedom, found.num_redundant) == (4, 1, 1)
    assert (found.spatial_count, found.planar_count) == (0, None)
    # Any one of the five may be left out, but not two.
    assert found.redundant == {"P4": ("α₂", "α₃", "s₁", "s₂", "s₃")}


def test_mobility_in_and_beside_a_singular_configuration():
    mechanism, state = start("spatial-four-link", "FL2")
    found = lx.mobility(mechanism, state)
    assert (found.rank, found.degrees_of_freedom, found.num_redundant) == (1, 2, 4)
    assert (found.spatial_count, found.planar_count) == (-2, 1)
    assert found.distance == 0.0
    assert "0 from a singular configuration (branches cross" in str(found)
    beside = lx.mobility(mechanism, lx.State(state.q + 0.1 * np.array([1.0, 1.0, -1.0]), state.v))
    assert (beside.rank, beside.degrees_of_freedom, beside.num_redundant) == (2, 1, 3)
    assert 0.01 < beside.distance < 0.2
    assert beside.redundant == {"C": ("α₂", "α₃", "s₁")}


@pytest.mark.slow
def test_derivative_of_the_distance_from_a_singular_configuration():
    scene = SCENES["crank-slider"]
    settings = scene.settings("regular", {"angle": 0.6})

    @jax.jit
    def distances(rod):
        mechanism = scene.mechanism(settings | {"rod": rod})
        state = scene.initial(mechanism, settings | {"rod": rod})
        here = lx.Solution.of_state(mechanism, state)
        return jnp.stack([lx.mobility(mechanism, state).distance, here.singularity_distance()[0]])

    found, step = jax.jit(jax.jacrev(distances))(0.3), 1e-5
    differences = (distances(0.3 + step) - distances(0.3 - step)) / (2 * step)
    assert np.all(np.abs(found) > 1e-3)
    np.testing.assert_allclose(found, differences, rtol=1e-6)


def test_a_pendulum_comes_to_rest_and_vibrates():
    mechanism = pendulum(length=0.8, mass=2.0, forces=[lx.JointDamper("hinge", 0.3)])
    rest = lx.equilibrium(mechanism, lx.State(jnp.array([0.3]), jnp.zeros(1)))
    np.testing.assert_allclose(rest.q, -np.pi / 2, atol=1e-12)
    found = lx.linearise(mechanism, rest)
    natural, rate = np.sqrt(1.5 * 9.81 / 0.8), 0.3 / (2.0 * 0.8**2 / 3.0)
    np.testing.assert_allclose(found.natural_frequencies, [natural], rtol=1e-12)
    np.testing.assert_allclose(found.damping, [[rate]], rtol=1e-12)
    damped = np.sqrt(natural**2 - rate**2 / 4.0)
    np.testing.assert_allclose(sorted(found.eigenvalues.imag), [-damped, damped], rtol=1e-10)
    # Upright it is at rest too, and falls at that rate: an equilibrium to go on from.
    upright = lx.State(jnp.array([np.pi / 2]), jnp.zeros(1))
    np.testing.assert_allclose(lx.linearise(mechanism, upright).natural_frequencies, [-natural], rtol=1e-12)
    np.testing.assert_allclose(np.sin(lx.equilibrium(mechanism, upright).q), -1.0, atol=1e-12)
    with pytest.raises(ValueError, match="state is in float32"):
        lx.equilibrium(mechanism, lx.State(rest.q.astype(np.float32), rest.v.astype(np.float32)))
    with pytest.raises(ValueError, match=r"off an equilibrium.*'hinge' accelerates by -18.39.*linkax.equilibrium"):
        lx.linearise(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)))


@pytest.mark.slow
def test_frequency_on_the_tangent_space_of_a_redundant_loop():
    """The parallelogram hangs down and swings with a'' = -1.2 g cos a."""
    mechanism, state = start("spatial-four-link", "FL3", {"angle": -1.2, "speed": 0.0})
    rest = lx.equilibrium(mechanism, state)
    np.testing.assert_allclose(rest.q[0], -np.pi / 2, atol=1e-10)
    found = lx.linearise(mechanism, rest)
    np.testing.assert_allclose(found.natural_frequencies, [np.sqrt(1.2 * 9.81)], rtol=1e-10)
    mode = found.modes[:, 0] / found.modes[0, 0]
    np.testing.assert_allclose(np.abs(mode), 1.0, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
def test_derivatives_of_modes_and_frequencies(order):
    """And they: of two bodies on one guide, the first between wall and spring, the second behind the spring."""

    def modes(masses):
        bodies = [lx.point_mass("first", masses[0]), lx.point_mass("second", masses[1])]
        joints = [lx.Prismatic("near", lx.GROUND, bodies[0], "x"), lx.Prismatic("far", bodies[0], bodies[1], "x")]
        springs = [lx.JointSpring("near", 3.0, 0.0), lx.JointSpring("far", 2.0, 0.0)]
        mechanism = lx.Mechanism(bodies, joints, springs)
        found = lx.linearise(mechanism, lx.State(jnp.zeros(2), jnp.zeros(2)), degrees_of_freedom=2)
        return found.natural_frequencies, jnp.abs(found.modes)

    def exact(masses):
        mass = jnp.array([[1.0, 0.0], [0.0, 0.0]]) * masses[0] + jnp.ones((2, 2)) * masses[1]
        root = jnp.linalg.cholesky(mass)
        flexible = jnp.linalg.solve(root, jnp.linalg.solve(root, jnp.diag(jnp.array([3.0, 2.0]))).T)
        values, vectors = jnp.linalg.eigh((flexible + flexible.T) / 2)
        return jnp.sqrt(values), jnp.abs(jnp.linalg.solve(root.T, vectors))

    def with_derivatives(function):
        return jax.jacfwd(lambda masses: 2 * (function(masses),), has_aux=True)

    for _ in range(order):
        modes, exact = with_derivatives(modes), with_derivatives(exact)
    at = jnp.array([1.3, 0.7])
    jax.tree.map(lambda *pair: np.testing.assert_allclose(*pair, atol=1e-9), jax.jit(modes)(at), jax.jit(exact)(at))


@pytest.mark.slow
def test_an_equilibrium_far_along_bent_loops():
    """Of Bricard's mechanism, whose loops open where a long step goes straight on: where its potential is least."""
    mechanism, state = start("bricard")
    still = lx.State(state.q, jnp.zeros_like(state.v))
    rest = lx.equilibrium(mechanism, still)
    potential = lx.Solution.of_state(mechanism, rest).potential_energy()[0]
    swings = lx.simulate(mechanism, still, t1=10.0).potential_energy()
    assert 0.0 <= np.min(swings) - potential <= 1e-4 * np.ptp(swings)
    assert lx.linearise(mechanism, rest).natural_frequencies[0] > 1.0


@pytest.mark.parametrize("rod", [0.02, 0.3])
def test_an_equilibrium_of_loops_that_cannot_close_is_marked(rod):
    scene = SCENES["crank-slider"]
    settings = scene.settings("regular", {})

    @jax.jit
    def rests(rod):
        mechanism = scene.mechanism(settings | {"rod": rod})
        springs = [lx.JointSpring("bearing", 30.0, 0.4), lx.JointSpring("guide", 30.0, 1.0)]
        mechanism = lx.Mechanism(mechanism.bodies, mechanism.joints, springs)
        return lx.equilibrium(mechanism, lx.assemble(mechanism, {"bearing": 0.4}, guess={"guide": 0.4})).q

    assert np.all(np.isfinite(rests(rod))) == (rod == 0.3)


@pytest.mark.slow
def test_second_derivatives_of_an_equilibrium_of_a_closed_loop():
    """Of a crank-slider with a spring, weights along the guide, against the least potential of its one angle."""
    scene = SCENES["crank-slider"]
    settings = scene.settings("regular", {})

    def rests(numbers):
        rod, stiffness = numbers
        mechanism = scene.mechanism(settings | {"rod": rod})
        forces = [lx.Gravity([-9.81, 0.0, 0.0]), lx.JointSpring("bearing", stiffness, 0.4)]
        mechanism = lx.Mechanism(mechanism.bodies, mechanism.joints, forces)
        return lx.equilibrium(mechanism, lx.assemble(mechanism, {"bearing": 0.3}, guess={"guide": 1.0})).q[0]

    def potential(angle, numbers):
        (rod, stiffness), crank = numbers, settings["crank"]
        masses = [settings[name] for name in ("crank_mass", "rod_mass", "slider_mass")]
        tip = crank * jnp.cos(angle)
        slider = tip + jnp.sqrt(rod**2 - (crank * jnp.sin(angle)) ** 2)
        moment = masses[0] * tip / 2 + masses[1] * (tip + slider) / 2 + masses[2] * slider
        return 9.81 * moment + stiffness * (angle - 0.4) ** 2 / 2

    at = jnp.array([settings["rod"], 10.0])
    found = jax.jit(rests)(at)

    def exact(numbers):
        angle, slope = found, jax.grad(potential)
        for _ in range(3):
            angle = angle - slope(angle, numbers) / jax.grad(slope)(angle, numbers)
        return angle

    np.testing.assert_allclose(found, exact(at), rtol=1e-10)
    twice = jax.jit(jax.jacfwd(jax.jacfwd(rests)))(at)
    np.testing.assert_allclose(twice, jax.jacfwd(jax.jacfwd(exact))(at), rtol=1e-8)


def test_nothing_holds_a_falling_body():
    body = lx.point_mass("body", 2.0)
    mechanism = lx.Mechanism([body], [lx.Prismatic("slide", lx.GROUND, body, "y")], [lx.Gravity([0.0, -9.81, 0.0])])
    with pytest.raises(lx.EquilibriumError, match=r"no equilibrium near this state.*add what holds"):
        lx.equilibrium(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)))
    # Where nothing can be raised it is marked.
    marked = jax.vmap(lambda q: lx.equilibrium(mechanism, lx.State(q, jnp.zeros(1))).q)(jnp.zeros((2, 1)))
    assert np.all(np.isnan(marked))


def test_inverse_dynamics_undoes_the_dynamics():
    mechanism, state = start("crank-slider", "SC3", {"angle": 0.4})
    found = lx.inverse_dynamics(mechanism, state, {"bearing": 3.0})
    torque = lx.JointTorque("bearing", found.forces["bearing"][0])
    driven = lx.Mechanism(mechanism.bodies, mechanism.joints, [*mechanism.forces, torque])
    here = lx.Solution.of_state(driven, state)
    slider = lx.Solution.of_state(mechanism, state).acceleration("slider")[0]
    acceleration = here.acceleration("crank", at="tip")[0]
    along = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    np.testing.assert_allclose(acceleration @ along, 3.0, rtol=1e-11)
    assert np.linalg.norm(here.acceleration("slider")[0] - slider) > 1.0
    with pytest.raises(ValueError, match=r"acceleration asked of joint '(bearing|guide)' is missed by"):
        lx.inverse_dynamics(mechanism, state, {"bearing": 3.0, "guide": 100.0})
    with pytest.raises(ValueError, match=r"joint 'bearing' is given twice, again by \('bearing', None\)"):
        lx.inverse_dynamics(mechanism, state, {"bearing": 3.0, ("bearing", None): 3.0})


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_inverse_dynamics_marks_what_the_loops_do_not_allow(unit):
    """In any unit of acceleration: a drive holds a weight, against which rounding is that of the weight alone."""
    hold = [lx.Drive("holder", "hinge", speed=0.0)]
    mechanism, state = pendulum(gravity=9.81 * unit, constraints=hold), lx.State(jnp.zeros(1), jnp.zeros(1))
    needed = lambda wanted: lx.inverse_dynamics(mechanism, state, {"hinge": wanted}).forces["hinge"][0]
    # Of the moment of the weight, m g l / 2, the drive bears half.
    np.testing.assert_allclose(needed(0.0), 9.81 / 4.0 * unit, rtol=1e-12)
    with pytest.raises(ValueError, match="acceleration asked of joint 'hinge' is missed by"):
        needed(3.0 * unit)
    members = jax.jit(jax.vmap(needed))(unit * jnp.array([0.0, 3.0]))
    np.testing.assert_array_equal(np.isnan(members), [False, True])
    assert np.isnan(jax.jit(jax.grad(needed))(3.0 * unit))


def test_inverse_dynamics_is_in_the_precision_of_the_state():
    mechanism, state = start("crank-slider", "SC3", {"angle": 0.4})
    single = jax.tree.map(lambda array: array.astype(jnp.float32), state)
    found, exact = (lx.inverse_dynamics(mechanism, given, {"bearing": 3.3}) for given in (single, state))
    assert found.acceleration.dtype == found.forces["bearing"].dtype == jnp.float32
    np.testing.assert_allclose(found.forces["bearing"], exact.forces["bearing"], rtol=1e-4)
    mixed = lx.State(state.q.astype(jnp.float32), state.v)
    assert lx.inverse_dynamics(mechanism, mixed, {"bearing": 3.3}).acceleration.dtype == jnp.float64
