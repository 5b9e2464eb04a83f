"""Contact of shapes and clearance at a pin: geometry, laws of force and friction, energy, derivatives."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.coordinates import rates
from linkax.equations.dynamics import along_speeds
from linkax.equations.motion import move
from linkax.equations.system import system_of

G = 9.81
FRICTION = lx.Friction(0.2, 0.3, transition_speed=0.01)
LAW = lx.ContactLaw(1e4, restitution=0.5, impact_speed=1.0, friction=FRICTION)


def test_friction_is_brown_and_mcphees():
    friction = lx.Friction(0.2, 0.35, transition_speed=0.02, viscous=3.0, viscous_force=50.0)
    speeds = np.array([1e-9, 1e-4, 5e-4, 1e-3, 1e-2, 0.02, 0.1, 3.0])
    x, normal = speeds / 0.02, 70.0
    exact = normal * (0.2 * np.tanh(4.0 * x) + 0.15 * x / (x**2 / 4.0 + 0.75) ** 2)
    exact += 3.0 * speeds * np.tanh(4.0 * normal / 50.0)
    direction = jnp.array([0.6, 0.0, -0.8])
    force = lambda v: friction.force(jnp.asarray(normal), v)
    found, slope = jax.jit(lambda v: (jax.vmap(force)(v), jax.jacfwd(force)(jnp.zeros(3))))(speeds[:, None] * direction)
    np.testing.assert_allclose(found, -exact[:, None] * direction, rtol=1e-11)
    np.testing.assert_allclose(slope, -exact[0] / 1e-9 * np.eye(3), rtol=1e-9, atol=1e-9)


UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # of a floor, whose z is the ground's y


def two_bodies(element):
    """Two free bodies, and an element between frames on them."""
    one = lx.RigidBody("one", 1.0, inertia=[0.1, 0.2, 0.25])
    other = lx.RigidBody("other", 2.0, inertia=[0.3, 0.2, 0.25])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    ends = [
        one.at([0.3, 0.1, -0.2], turn),
        one.at([-0.2, 0.4, 0.1]),
        other.at([0.1, 0.0, 0.1]),
        other.at([0.0, 0.5, 0.0]),
    ]
    joints = [lx.Free(f"{body.name}_joint", lx.GROUND, body) for body in (one, other)]
    return lx.Mechanism([one, other], joints, [element(*ends)])


PAIRS = {
    "sphere on plane": lambda a, b, c, d: lx.Contact(lx.Sphere(c, 0.2), lx.Plane(a), LAW),
    "capsule on plane": lambda a, b, c, d: lx.Contact(lx.Plane(a), lx.Capsule(c, d, 0.1), LAW),
    "spheres": lambda a, b, c, d: lx.Contact(lx.Sphere(a, 0.3), lx.Sphere(c, 0.1), LAW),
    "sphere and capsule": lambda a, b, c, d: lx.Contact(lx.Sphere(c, 0.2), lx.Capsule(a, b, 0.1), LAW),
    "capsules": lambda a, b, c, d: lx.Contact(lx.Capsule(a, b, 0.2), lx.Capsule(c, d, 0.1), LAW),
    "clearance": lambda a, b, c, d: lx.Clearance(a, c, clearance=0.05, radius=0.2, law=LAW),
}


@pytest.mark.parametrize("pair", PAIRS)
def test_gaps_and_forces(pair):
    """Rates of gaps are those of motion, forces do the work of their energy, and act equally on both bodies."""
    mechanism = two_bodies(PAIRS[pair])
    system, force = system_of(mechanism, float), mechanism.forces[0]
    random = np.random.default_rng(3)

    @jax.jit
    def read(q, v):
        configuration = configure(system, 0.0, q)
        motion = move(configuration, v)
        gaps = lambda q: jnp.stack([spot.gap for spot in force.spots(configure(system, 0.0, q))])
        gap, rate = jax.jvp(gaps, (q,), (rates(system.topology, q, v),))
        approach = [force._approach(motion, spot) for spot in force.spots(configuration)]
        load = force.load(0.0, motion, True)
        power = (load.joint_force + along_speeds(configuration, load.force, load.moment)) @ v
        energy, rise = jax.jvp(
            lambda q: force.potential_energy(configure(system, 0.0, q)), (q,), (rates(system.topology, q, v),)
        )
        lost = power + rise
        total = jnp.sum(load.force, axis=0)
        about = jnp.sum(load.moment + jnp.cross(configuration.world_center_of_mass(), load.force), axis=0)
        return gap, rate, jnp.stack([rate for _, rate in approach]), total, about, lost, energy

    touched = 0
    for _ in range(30):
        q = random.normal(size=14) * 0.15
        q[[0, 7]] += 1.0
        for begin in (0, 7):
            q[begin : begin + 4] /= np.linalg.norm(q[begin : begin + 4])
        v = random.normal(size=12) * 0.1
        gap, rate, approach, total, about, lost, energy = read(jnp.asarray(q), jnp.asarray(v))
        np.testing.assert_allclose(approach, -np.asarray(rate), atol=1e-12)
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
        np.testing.assert_allclose(about, 0.0, atol=1e-9)
        deep = np.maximum(-np.asarray(gap), 0.0)
        np.testing.assert_allclose(energy, np.sum(1e4 * deep**2.5 / 2.5), rtol=1e-12)
        if np.all(gap < 0.0):
            assert lost < 0.0
        touched += np.any(gap < 0.0)
    assert touched >= 3


def test_nearest_points_of_capsules():
    """Against a search over both segments, and where their lines cross."""
    mechanism = two_bodies(PAIRS["capsules"])
    system, force, random = system_of(mechanism, float), mechanism.forces[0], np.random.default_rng(5)

    @jax.jit
    def read(q):
        configuration = configure(system, 0.0, q)
        ends = [configuration.point_position(frame) for frame in force.frames]
        return (
            force.shapes.gap(configuration),
            jnp.stack(ends),
            jax.grad(lambda q: force.shapes.gap(configure(system, 0.0, q)))(q),
        )

    shares = np.linspace(0.0, 1.0, 401)[:, None]
    for _ in range(10):
        q = random.normal(size=14) * 0.5
        for begin in (0, 7):
            q[begin : begin + 4] /= np.linalg.norm(q[begin : begin + 4])
        gap, ends, slope = read(jnp.asarray(q))
        first, second = (start + shares * (end - start) for start, end in np.asarray(ends).reshape(2, 2, 3))
        nearest = np.min(np.linalg.norm(first[:, None] - second[None], axis=-1))
        assert nearest - 2e-3 < gap + 0.3 <= nearest + 1e-12
        assert np.all(np.isfinite(slope))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::linkax.StiffnessWarning")
def test_a_sphere_that_slides_begins_to_roll():
    """With 5/7 of its speed, whatever the friction; what is lost is accounted for."""
    ball = lx.RigidBody("ball", 1.0, inertia=[0.4 * 0.5**2] * 3)
    law = lx.ContactLaw(1e5, damping=1.0, friction=FRICTION)
    floor = lx.Contact(lx.Sphere(ball, 0.5), lx.Plane(lx.GROUND.at([0.0, 0.0, 0.0], UPRIGHT)), law, name="floor")
    joint = lx.Planar("plane", lx.GROUND, ball, "z")
    mechanism = lx.Mechanism([ball], [joint], [lx.Gravity([0.0, -G, 0.0]), floor])
    resting = 0.5 - (G / 1e5) ** (2.0 / 3.0)
    ts = np.linspace(0.0, 0.4, 401)
    state = lx.assemble(
        mechanism, {"ball": [0.0, resting, 0.0]}, {"ball": lx.Velocity([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])}
    )
    run = lx.simulate(mechanism, state, t1=0.4, saveat=diffrax.SaveAt(ts=ts), accuracy=lx.Accuracy(rtol=1e-8))
    np.testing.assert_allclose(run.velocity("ball")[-1, 0], 5.0 / 7.0, rtol=2e-3)
    np.testing.assert_allclose(run.force("floor"), G, rtol=1e-3)
    np.testing.assert_allclose(run.unaccounted_energy(), 0.0, atol=1e-6)
    np.testing.assert_allclose(run.work()["floor"][-1], -1.0 / 7.0, rtol=5e-3)


def loose_pendulum(numbers):
    """A rod in a bearing with clearance, whose tip falls on a floor, by (stiffness, clearance, friction, floor)."""
    stiffness, clearance, dynamic, floor = numbers
    rod = lx.rod("rod", 1.0, 1.0)
    friction = lx.Friction(dynamic, transition_speed=0.1)
    law = lx.ContactLaw(1e6 * stiffness, damping=0.5, friction=friction)
    ground = lx.Plane(lx.GROUND.at(jnp.stack([0.0, floor, 0.0]), UPRIGHT))
    forces = [
        lx.Gravity([0.0, -G, 0.0]),
        lx.Clearance(lx.GROUND, rod.at("base"), clearance=0.01 * clearance, radius=0.1, law=law, name="pin"),
        lx.Contact(lx.Sphere(rod.at("tip"), 0.05), ground, law, name="floor"),
    ]
    return lx.Mechanism([rod], [lx.Planar("loose", lx.GROUND, rod.at("base"), "z")], forces)


X = jnp.array([1.0, 1.0, 0.2, -0.4])


def final_state(numbers, ts=None, t1=0.45):
    saveat = diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts)
    start = lx.State.as_drawn(loose_pendulum(X))
    return lx.simulate(loose_pendulum(numbers), start, t1=t1, accuracy=lx.Accuracy(rtol=1e-11), saveat=saveat)


def test_a_loose_pendulum_hits_its_bearing_and_the_floor():
    @eqx.filter_jit
    def read(run):
        forces = jnp.stack([run.force("pin"), run.force("floor")])
        return forces, run.length("pin"), run.work(), run.unaccounted_energy(), run.kinetic_energy()

    forces, length, work, unaccounted, kinetic = read(final_state(X, np.linspace(0.0, 0.45, 6001)))
    assert np.all(np.max(forces, axis=1) > 0.0)
    deep = np.maximum(np.asarray(length) - 0.01, 0.0)
    assert 0.0 < np.max(deep) < 5e-3
    np.testing.assert_allclose(unaccounted, 0.0, atol=1e-5 * np.max(kinetic))
    assert work["pin"][-1] < 0.0
    assert work["floor"][-1] < 0.0


@pytest.mark.slow
def test_derivatives_through_contacts():
    """Of the end's state, forwards and backwards, against central differences of fourth order."""
    end = lambda numbers: final_state(numbers).end.q
    value, step = jax.jit(end), 1e-5
    found = jax.jit(jax.jacfwd(end))(X)
    rise = lambda e: value(X + e) - value(X - e)
    exact = np.stack([(8.0 * rise(e) - rise(2.0 * e)) / (12.0 * step) for e in step * np.eye(4)], axis=1)
    size = np.max(np.abs(exact))
    np.testing.assert_allclose(found, exact, atol=1e-6 * size)
    np.testing.assert_allclose(jax.jit(jax.jacrev(end))(X), found, atol=1e-9 * size)


def towards_a_post(numbers):
    """A ball that flies at a post, and the share of its energy of what the law takes up over both radii."""
    stiffness, one, other, share = 10.0 ** (
        jnp.array([3.0, -3.0, -3.0, -1.0]) + jnp.array([5.0, 2.0, 2.0, 2.0]) * numbers
    )
    ball, law = lx.point_mass("ball", 2.0), lx.ContactLaw(stiffness)
    post = lx.Sphere(lx.GROUND.at([1.0, 0.0, 0.0]), other)
    contact = lx.Contact(lx.Sphere(ball, one), post, law, name="post")
    mechanism = lx.Mechanism([ball], [lx.Prismatic("rail", lx.GROUND, ball, axis="x")], [contact])
    speed = jnp.sqrt(share * law.energy(one + other))
    return mechanism, lx.State(jnp.zeros(1), speed[None]), share


def test_what_is_pressed_through_ends_the_run():
    """Where its energy is that at nine tenths of both radii, and nowhere below; else a ball bounces back."""

    def end(numbers):
        mechanism, start, share = towards_a_post(numbers)
        run = lx.simulate(mechanism, start, t1=2.0 / start.v[0], saveat=diffrax.SaveAt(t1=True))
        return share, run.result == lx.RESULTS.pressed_through, run.end.v[0] / start.v[0]

    numbers = np.random.default_rng(0).uniform(size=(100, 4))
    share, through, left = map(np.asarray, jax.jit(jax.vmap(end))(numbers))
    np.testing.assert_array_equal(through, share > 0.9**2.5)
    np.testing.assert_allclose(left[~through], -1.0, atol=1e-5)


def test_what_is_pressed_through_is_named():
    mechanism, start, _ = towards_a_post(np.array([0.5, 0.5, 0.5, 1.0]))
    with pytest.raises(lx.SimulationError, match=r"Contact 'post' is 0\.018 m deep, nine tenths of both radii"):
        lx.simulate(mechanism, start, t1=2.0 / start.v[0], saveat=diffrax.SaveAt(t1=True))


@pytest.mark.parametrize(
    ("words", "make"),
    [
        ("law is 1.0; give a linkax.ContactLaw", lambda a: lx.Contact(lx.Sphere(a, 1.0), lx.Plane(lx.GROUND), 1.0)),
        ("both shapes are planes", lambda a: lx.Contact(lx.Plane(a), lx.Plane(lx.GROUND), LAW)),
        ("start is on body 'a', end on 'ground'", lambda a: lx.Capsule(a, lx.GROUND, 1.0)),
        ("radius .* is -1.0", lambda a: lx.Sphere(a, -1.0)),
        ("sum of both radii .* is 0.0", lambda a: lx.Contact(lx.Sphere(a, 0.0), lx.Sphere(lx.GROUND, 0.0), LAW)),
        ("body 'a': both frames are on it", lambda a: lx.Clearance(a, a, clearance=0.1, radius=1.0, law=LAW)),
        ("clearance .* is 0.0", lambda a: lx.Clearance(lx.GROUND, a, clearance=0.0, radius=1.0, law=LAW)),
    ],
    ids=lambda entry: entry if isinstance(entry, str) else "",
)
def test_bad_contacts_are_refused(words, make):
    with pytest.raises(ValueError, match=words):
        make(lx.point_mass("a", 1.0))
