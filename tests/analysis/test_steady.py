"""Stable equilibria, and small motions about steady rotations, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from mechanisms import crank_slider
from scipy import optimize, special

import linkax as lx

G = 9.81
WEIGHT = lx.Gravity([0.0, -G, 0.0])


def _turned(rate, t):
    return rate * t


def _swept(rate, t):
    return rate * t + 0.1 * t**2


def turning(joint, rate, law=_turned):
    return lx.Drive("motor", joint, Partial(law, rate))


def hoop(rate, radius=0.5, law=_turned):
    """A bead on a hoop that turns about the vertical: joints `shaft`, driven, and `swing`, zero at the bottom."""
    ring = lx.RigidBody("ring", 1.0, inertia=[1.0, 1.0, 1.0])
    bead = lx.RigidBody("bead", 0.7, center_of_mass=[0.0, -radius, 0.0], inertia=[0.0, 0.0, 0.0])
    joints = [lx.Revolute("shaft", lx.GROUND, ring, axis="y"), lx.Revolute("swing", ring, bead, axis="z")]
    return lx.Mechanism([ring, bead], joints, [WEIGHT], [turning("shaft", rate, law)])


@pytest.mark.slow
def test_bead_on_a_rotating_hoop():
    """Its bottom is unstable where ω² > g / R; cos θ = g / (ω² R) is stable, of frequency ω sin θ."""
    rate, mechanism = 8.0, hoop(8.0)
    bottom = lx.assemble(mechanism)
    angle = np.arccos(G / (rate**2 * 0.5))
    there = lx.equilibrium(mechanism, bottom)
    np.testing.assert_allclose(np.abs(there.q), [0.0, angle], atol=1e-10)
    np.testing.assert_allclose(there.v, [rate, 0.0], atol=1e-12)
    frequencies = lambda state: lx.linearise(mechanism, state).natural_frequencies
    np.testing.assert_allclose(frequencies(there), [rate * np.sin(angle)], rtol=1e-10)
    np.testing.assert_allclose(frequencies(bottom), [-np.sqrt(rate**2 - G / 0.5)], rtol=1e-10)
    # What would not be steady, with the same programs.
    beside = lx.State(jnp.array([0.0, 0.3]), bottom.v)
    with pytest.raises(ValueError, match=r"off an equilibrium.*joint 'swing' accelerates.*linkax.equilibrium"):
        lx.linearise(mechanism, beside)
    slower = lx.State(bottom.q, 0.5 * bottom.v)
    with pytest.raises(ValueError, match=r"drive 'motor' asks for a rate.*miss by 0.5 .*linkax.assemble"):
        lx.linearise(mechanism, slower)
    with pytest.raises(lx.EquilibriumError, match=r"drive 'motor' asks for a rate.*miss by 0.5 .*speeds of zero"):
        lx.equilibrium(mechanism, slower)


def rotor(rate, stiffness=(200.0, 200.0), damping=0.0):
    """Jeffcott's: a disc on a shaft that bends, in axes that turn with it."""
    shaft, disc = lx.RigidBody("shaft", 1.0, inertia=[1.0, 1.0, 1.0]), lx.point_mass("disc", 2.0)
    joints = [
        lx.Revolute("bearing", lx.GROUND, shaft, axis="z"),
        lx.Prismatic("along", shaft, middle := lx.point_mass("middle", 0.0), axis="x"),
        lx.Prismatic("across", middle, disc, axis="y"),
    ]
    springs = [lx.JointSpring(name, entry) for name, entry in zip(("along", "across"), stiffness, strict=True)]
    damper = lx.Damper(disc, lx.GROUND.at([0.0, 0.0, 100.0]), damping)
    return lx.Mechanism([shaft, middle, disc], joints, [*springs, damper], [turning("bearing", rate)])


@jax.jit
@jax.vmap
def _whirls(rate, soft):
    mechanism = rotor(rate, (soft, 200.0))
    state = lx.State(jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]) * rate)
    found = lx.linearise(mechanism, state, degrees_of_freedom=2)
    return found.natural_frequencies, found.modes


@pytest.mark.slow
def test_whirling_of_a_rotor():
    """Seen from the shaft at |ω₀ ± Ω|; of a shaft with two stiffnesses, unstable between its critical speeds."""
    frequencies, modes = _whirls(jnp.array([0.0, 4.0, 15.0, 9.5]), jnp.array([150.0, 200.0, 200.0, 162.0]))
    np.testing.assert_allclose(frequencies[0], [np.sqrt(75.0), 10.0], rtol=1e-9)
    np.testing.assert_allclose(np.abs(modes[0, 1:]), np.eye(2) / np.sqrt(2.0), atol=1e-9)
    np.testing.assert_allclose(frequencies[1:3], [[6.0, 14.0], [5.0, 25.0]], rtol=1e-9)
    assert np.all(np.isnan(modes[1:]))  # they have no phase
    squares = np.roots([1.0, 81.0 + 100.0 + 2.0 * 9.5**2, (81.0 - 9.5**2) * (100.0 - 9.5**2)])  # of eigenvalues
    exact = np.sort(np.sign(-squares) * np.sqrt(np.abs(squares)))
    assert exact[0] < 0.0
    np.testing.assert_allclose(frequencies[3], exact, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("stretched", [0.0, 1e-3, 100.0])
def test_whirling_of_a_rotor_on_a_free_joint(stretched):
    """Seen from the ground, on springs that are alike in all directions or not: M z̈ + K₁ z + K₂ u = 0 of its centre z
    and A ü + K₂ᵀ z + K₃ u = C Ω u × of the tilt u of its axis.
    """
    mass, across, axial, spin, stiffness, places = 2.0, 0.05, 0.08, 20.0, (300.0, 700.0), (0.3, -0.5)
    rotor = lx.RigidBody("rotor", mass, inertia=[across, across, axial])
    springs = [
        lx.Spring(lx.GROUND.at([0.0, 0.0, z]), rotor.at([0.0, 0.0, z]), k)
        for z, k in zip(places, stiffness, strict=True)
    ]
    # Far away along x, which holds the centre alone.
    far = lx.Spring(lx.GROUND.at([1e6, 0.0, 0.0]), rotor, stretched, free_length=1e6)
    mechanism = lx.Mechanism([rotor], [lx.Free("flight", lx.GROUND, rotor)], [*springs, far])
    at = lx.State(jnp.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, spin, 0.0, 0.0, 0.0]))
    found = lx.linearise(mechanism, at).eigenvalues.imag
    of_places, of_tilt = np.array(stiffness), np.array(places)
    k = np.array([[of_places.sum(), of_places @ of_tilt], [of_places @ of_tilt, of_places @ of_tilt**2]])
    # x, y, and the axis's components along them.
    full = np.kron(k, np.eye(2)) + np.diag([stretched, 0.0, 0.0, 0.0])
    turns = np.zeros((4, 4))
    turns[2, 3], turns[3, 2] = axial * spin, -axial * spin
    inverse = np.diag(1.0 / np.array([mass, mass, across, across]))
    whole = np.block([[np.zeros((4, 4)), np.eye(4)], [-inverse @ full, -inverse @ turns]])
    exact = np.linalg.eigvals(whole).imag
    np.testing.assert_allclose(np.min(np.abs(found[:, None] - exact), axis=0), 0.0, atol=1e-4)


def rotor_on_an_arm():
    """A rod that hangs, with a small balanced rotor on it."""
    arm, rotor = lx.rod("arm", 1.0, 1.0), lx.RigidBody("rotor", 0.1, inertia=[1e-4, 1e-4, 2e-4])
    joints = [
        lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z"),
        lx.Revolute("spindle", arm.at([0.5, 0.0, 0.0]), rotor, axis="z"),
    ]
    return lx.Mechanism([arm, rotor], joints, [lx.Gravity([0.0, -9.81, 0.0])])


@pytest.mark.slow
def test_a_fast_rotor_does_not_hide_what_its_carrier_does():
    mechanism = rotor_on_an_arm()
    for spin in (1.0, 300.0, 1e4):
        hangs = lx.linearise(mechanism, lx.State(jnp.array([-np.pi / 2, 0.0]), jnp.array([0.0, spin])))
        assert np.max(hangs.natural_frequencies) > 3.0
        for angle, speed in ((-np.pi / 2 + 1e-2, 0.0), (0.0, 0.0), (-np.pi / 2, 2.0)):
            with pytest.raises(ValueError, match=r"off an equilibrium.*'hinge' accelerates|not steady"):
                lx.linearise(mechanism, lx.State(jnp.array([angle, 0.0]), jnp.array([speed, spin])))


@pytest.mark.slow
def test_a_cam_in_its_dwell_is_not_steady():
    """It lifts for 160° of a turn, and rests for the others."""
    disc, follower = lx.RigidBody("disc", 1.0, inertia=1e-3), lx.point_mass("follower", 0.5)
    profile = lambda angle: 0.04 + 0.01 * jnp.maximum(0.0, jnp.cos(angle - np.pi) - np.cos(1.4)) ** 3
    joints = [
        lx.Revolute("shaft", lx.GROUND, disc, axis="z"),
        lx.Prismatic("stem", lx.GROUND, follower, axis="x"),
        lx.Cam("contact", disc, follower, profile, roller_radius=0.01),
    ]
    drive = lx.Drive("motor", "shaft", speed=20.0)
    mechanism = lx.Mechanism([disc, follower], joints, [lx.JointSpring("stem", stiffness=500.0)], [drive])
    for angle in (1.65, 0.0, -1.65):
        guess, t = {"stem": 0.05, "shaft": angle, "contact": [-angle, 0.0]}, angle / 20.0
        state = lx.assemble(mechanism, guess=guess, t=t)
        with pytest.raises(lx.EquilibriumError, match="no equilibrium lasts while drive 'motor' goes on"):
            lx.equilibrium(mechanism, state, t=t)
        with pytest.raises(ValueError, match="is not steady"):
            lx.linearise(mechanism, state, t=t)


def column(load):
    """Ziegler's: two rods on springs, and a force along the second one, which follows it."""
    rods = [lx.rod("lower", 1.0, 1.0), lx.rod("upper", 1.0, 1.0)]
    joints = [
        lx.Revolute("foot", lx.GROUND, rods[0].at("base"), axis="z"),
        lx.Revolute("knee", rods[0].at("tip"), rods[1].at("base"), axis="z"),
    ]
    springs = [lx.JointSpring("foot", 1.0), lx.JointSpring("knee", 1.0)]
    follower = lx.PointForce(rods[1].at("tip"), jnp.array([-1.0, 0.0, 0.0]) * load, axes="frame")
    return lx.Mechanism(rods, joints, [*springs, follower])


def test_forces_without_a_potential_may_be_unstable_unseen():
    straight = lx.State(jnp.zeros(2), jnp.zeros(2))
    lx.equilibrium(column(1.0), straight)
    with pytest.warns(lx.StabilityWarning, match=r"may be unstable.*no potential.*linkax.linearise"):
        found = lx.equilibrium(column(4.0), straight)
    np.testing.assert_allclose(found.q, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_compressed_strip_buckles():
    """At 1.3 times the load of Euler it bends as the elastica; straight it is unstable."""
    section = lx.Section(1.0, 1.0, 1e4, 1.0, 400.0, rotary_inertia=0.0)
    strip = lx.Beam("strip", 1.0, section, bends="z", torsion=False, stretch=False)
    load = 1.3 * np.pi**2 / 4.0
    push = lx.PointForce(strip.at("tip"), [-load, 0.0, 0.0])
    mechanism = lx.Mechanism([strip], [lx.Fixed("clamp", lx.GROUND, strip)], [push])
    straight = lx.assemble(mechanism)
    assert lx.linearise(mechanism, straight).natural_frequencies[0] < 0.0
    bent = lx.equilibrium(mechanism, straight)
    # The elastica: with tip angle α, √P = K(sin α/2), height 2 sin(α/2) / √P.
    k = optimize.brentq(lambda k: special.ellipk(k**2) - np.sqrt(load), 1e-6, 0.99)
    tip = lx.Solution.of_state(mechanism, bent).position("strip", at="tip")[0]
    np.testing.assert_allclose(np.abs(tip[1]), 2.0 * k / np.sqrt(load), rtol=1e-5)
    assert lx.linearise(mechanism, bent).natural_frequencies[0] > 0.0


@pytest.mark.slow
def test_an_upright_crank_slider_falls():
    drawn = crank_slider(crank=0.3, rod=1.0, masses=(1.0, 1.0, 1.0))
    joints = [drawn.joint(name) for name in ("bearing", "crank_pin", "wrist_pin")]
    joints.append(lx.Prismatic("guide", lx.GROUND, drawn.body("slider"), axis="y"))
    mechanism = lx.Mechanism(drawn.bodies, joints, [WEIGHT])
    upright = lx.assemble(mechanism, {"bearing": np.pi / 2}, guess={"guide": 1.3})
    assert lx.linearise(mechanism, upright).natural_frequencies[0] < 0.0
    rest = lx.equilibrium(mechanism, upright)
    np.testing.assert_allclose(np.sin(rest.q[0]), -1.0, atol=1e-10)
    assert lx.linearise(mechanism, rest).natural_frequencies[0] > 0.0
    # Driven it has no steady motion; held by its drive it is at rest.
    driven = lx.Mechanism(drawn.bodies, joints, [WEIGHT], [turning("bearing", 3.0)])
    state = lx.assemble(driven, guess={"bearing": 0.0, "guide": 0.95})
    with pytest.raises(lx.EquilibriumError, match=r"no equilibrium lasts while drive 'motor' goes on.*speeds of zero"):
        lx.equilibrium(driven, state)
    held = lx.equilibrium(driven, lx.State(state.q, jnp.zeros_like(state.v)))
    np.testing.assert_allclose(held.q, state.q, atol=1e-10)


@jax.jit
def _flapping(rate):
    section = lx.Section(1.0, 1.0, 1e4, 1.0, 400.0, rotary_inertia=0.0)
    blade = lx.Beam("blade", 1.0, section, bends="y", torsion=False, stretch=False)
    hub = lx.RigidBody("hub", 1.0, inertia=[1.0, 1.0, 1.0])
    joints = [lx.Revolute("shaft", lx.GROUND, hub, axis="z"), lx.Fixed("root", hub, blade)]
    mechanism = lx.Mechanism([hub, blade], joints, [], [turning("shaft", rate)])
    there = lx.equilibrium(mechanism, lx.assemble(mechanism))
    count = mechanism.topology.num_speeds - 1
    return lx.linearise(mechanism, there, degrees_of_freedom=count).natural_frequencies[0]


@pytest.mark.slow
def test_flapping_of_a_rotating_cantilever():
    """Wright, Smith, Thresher, Wang, Journal of Applied Mechanics 49 (1982), with no hub radius."""
    rates, known = (0.0, 2.0, 6.0, 12.0), (3.5160, 4.1373, 7.3604, 13.1702)
    np.testing.assert_allclose([_flapping(rate) for rate in rates], known, rtol=1e-4)


@pytest.mark.slow
def test_a_rotating_bar_stretches():
    """E A u'' + ρ A Ω² (x + u) = 0: u(L) = tan(κ L) / κ − L, κ² = ρ Ω² / E; of its waves the frequencies fall by Ω²."""
    section, rate = lx.Section(1.0, 1.0, 4.0, 1.0, 400.0, rotary_inertia=0.0), 0.5
    bar = lx.Beam("bar", 1.0, section, bends="", torsion=False, stretch=True)
    hub = lx.RigidBody("hub", 1.0, inertia=[1.0, 1.0, 1.0])
    joints = [lx.Revolute("shaft", lx.GROUND, hub, axis="z"), lx.Fixed("root", hub, bar)]
    mechanism = lx.Mechanism([hub, bar], joints, [], [turning("shaft", rate)])
    there = lx.equilibrium(mechanism, lx.assemble(mechanism))
    tip = np.linalg.norm(lx.Solution.of_state(mechanism, there).position("bar", at="tip")[0])
    wave = rate / 2.0  # E A = 4
    np.testing.assert_allclose(tip, np.tan(wave) / wave, rtol=1e-6)
    first = np.pi / 2.0 * rate / wave
    found = lx.linearise(mechanism, there).natural_frequencies[0]
    np.testing.assert_allclose(found, np.sqrt(first**2 - rate**2), rtol=1e-4)


@pytest.mark.slow
def test_watt_governor():
    """A ball at the knee of two links of length a, between a spindle and a sleeve that slides on it: a loop.

    a cos φ = g (m + 2 M) / (m Ω²), ω² = m Ω² sin² φ / (m + 4 M sin² φ).
    """
    length, ball, weight, rate = 0.5, 1.0, 0.6, 9.0
    spindle = lx.RigidBody("spindle", 1.0, inertia=[1.0, 1.0, 1.0])
    arm = lx.RigidBody("arm", ball, center_of_mass=[0.0, -length, 0.0], inertia=[0.0, 0.0, 0.0])
    link, sleeve = lx.RigidBody("link", 0.0, inertia=[0.0, 0.0, 0.0]), lx.point_mass("sleeve", weight)
    joints = [
        lx.Revolute("shaft", lx.GROUND, spindle, axis="y"),
        lx.Revolute("shoulder", spindle, arm, axis="z"),
        lx.Revolute("knee", arm.at([0.0, -length, 0.0]), link, axis="z"),
        lx.Revolute("foot", link.at([0.0, -length, 0.0]), sleeve, axis="z"),
        lx.Prismatic("slide", spindle, sleeve, axis="y"),
    ]
    mechanism = lx.Mechanism([spindle, arm, link, sleeve], joints, [WEIGHT], [turning("shaft", rate)])
    start = lx.assemble(mechanism, {"shoulder": 0.3}, guess={"knee": -0.6, "slide": -0.9})
    there = lx.equilibrium(mechanism, start)
    angle = np.arccos(G * (ball + 2.0 * weight) / (ball * rate**2 * length))
    place = lx.Solution.of_state(mechanism, there).position("sleeve")[0, 1]
    np.testing.assert_allclose(place, -2.0 * length * np.cos(angle), rtol=1e-9)
    square = np.sin(angle) ** 2
    exact = np.sqrt(ball * rate**2 * square / (ball + 4.0 * weight * square))
    np.testing.assert_allclose(lx.linearise(mechanism, there).natural_frequencies, [exact], rtol=1e-9)


@pytest.mark.slow
def test_steady_precession_on_a_quaternion():
    """A conical pendulum that turns as one with its cone, ω² = Ω² (1 + 3 cos² θ), and axes that turn with it."""
    rate, length = 8.0, 0.5
    bob = lx.RigidBody("bob", 1.0, center_of_mass=[0.0, -length, 0.0], inertia=[1e-6, 1e-6, 1e-6])
    mechanism = lx.Mechanism([bob], [lx.Spherical("ball", lx.GROUND, bob)], [WEIGHT])
    cosine = G / (rate**2 * length)
    half = np.arccos(cosine) / 2.0
    state = lx.State(jnp.array([np.cos(half), 0.0, 0.0, np.sin(half)]), jnp.array([0.0, rate, 0.0]))
    found = lx.linearise(mechanism, state)
    np.testing.assert_allclose(found.natural_frequencies[-1], rate * np.sqrt(1.0 + 3.0 * cosine**2), rtol=1e-5)
    assert np.max(np.abs(found.eigenvalues.real)) < 1e-4
    # A long body is not steady where it turns about no principal axis.
    tumbling = lx.RigidBody("bob", 1.0, inertia=[1.0, 2.0, 3.0])
    free = lx.Mechanism([tumbling], [lx.Spherical("ball", lx.GROUND, tumbling)])
    with pytest.raises(ValueError, match=r"joint 'ball' accelerates"):
        lx.linearise(free, lx.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 0.0])))
    about = lambda axis: lx.linearise(free, lx.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(3)[axis])).eigenvalues
    # Euler: about the middle axis it grows at √((I₃ − I₂)(I₂ − I₁) / (I₁ I₃)), about the others it nutates.
    np.testing.assert_allclose(np.max(about(1).real), np.sqrt(1.0 / 3.0), rtol=1e-6)
    np.testing.assert_allclose(np.max(about(2).real), 0.0, atol=1e-6)


@pytest.mark.slow
def test_what_changes_as_it_turns_is_refused():
    """A shaft with two stiffnesses beside a spring on the ground, a drive that speeds up; inside of JAX marked."""
    uneven = rotor(4.0, (150.0, 200.0))
    aside = lx.Spring(uneven.bodies[2], lx.GROUND.at([0.0, 0.0, 1.0]), 30.0)
    beside = lx.Spring(uneven.bodies[2], lx.GROUND.at([5.0, 0.0, 0.0]), 30.0, 5.0)
    still = lx.State(jnp.zeros(3), jnp.array([4.0, 0.0, 0.0]))
    with_force = lambda *forces: lx.Mechanism(
        uneven.bodies, uneven.joints, [*uneven.forces, *forces], uneven.constraints
    )
    lx.linearise(with_force(aside), still)  # alike in all directions
    with pytest.raises(ValueError, match=r"motion of joints 'bearing'.* is not steady"):
        lx.linearise(with_force(beside), still)
    speeding = hoop(8.0, law=_swept)
    state = lx.State(jnp.zeros(2), jnp.array([8.0, 0.0]))
    with pytest.raises(lx.EquilibriumError, match="drive 'motor' goes on"):
        lx.equilibrium(speeding, state)
    assert np.all(np.isnan(jax.jit(lambda state: lx.equilibrium(speeding, state).q)(state)))
    found = jax.jit(lambda state: lx.linearise(speeding, state, degrees_of_freedom=1).natural_frequencies)(state)
    assert np.all(np.isnan(found))


@pytest.mark.slow
def test_derivatives_by_the_rate():
    """Of the bead's angle and frequency, and of whirling."""

    def bead(rate):
        mechanism = hoop(rate)
        there = lx.equilibrium(mechanism, lx.assemble(mechanism, {"swing": 1.0}))
        return jnp.stack([there.q[1], lx.linearise(mechanism, there, degrees_of_freedom=1).natural_frequencies[0]])

    def exact(rate):
        angle = jnp.arccos(G / (rate**2 * 0.5))
        return jnp.stack([angle, rate * jnp.sin(angle)])

    np.testing.assert_allclose(jax.jit(jax.jacfwd(bead))(8.0), jax.jacfwd(exact)(8.0), rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacrev(bead))(8.0), jax.jacfwd(exact)(8.0), rtol=1e-9)
    slopes = jax.jit(jax.jacfwd(lambda rate: _whirls(rate[None], jnp.array([200.0]))[0][0]))(jnp.asarray(4.0))
    np.testing.assert_allclose(slopes, [-1.0, 1.0], rtol=1e-8)
