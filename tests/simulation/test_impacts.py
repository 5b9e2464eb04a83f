"""Impacts on rigid stops: closed forms, loops, energies and derivatives, and where bounces accumulate."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar, pendulum
from scipy.special import ellipk

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.system import system_of

G = 9.81
GRAVITY = lx.Gravity([0.0, -G, 0.0])
PRECISE = lx.Accuracy(rtol=1e-10)
STEP = 1e-4  # of central differences


def ball(restitution):
    """A ball that falls on a floor."""
    body = lx.point_mass("ball", 1.3)
    rail = lx.Prismatic("rail", lx.GROUND, body, "y")
    return lx.Mechanism([body], [rail], [GRAVITY, lx.Impact("rail", lower=0.0, restitution=restitution, name="floor")])


def height(t, restitution, start):
    """That of the ball in closed form, from rest at a height."""
    landing = np.sqrt(2.0 * start / G)
    if t < landing:
        return start - G * t**2 / 2.0
    speed = restitution * G * landing
    while t > landing + 2.0 * speed / G:
        landing, speed = landing + 2.0 * speed / G, restitution * speed
    return speed * (t - landing) - G * (t - landing) ** 2 / 2.0


TIMES = np.linspace(0.0, 5.5, 111)


@jax.jit
@jax.vmap
def bounces(numbers):
    """Heights of the ball, impacts so far and energies unaccounted for, by (restitution, height at the start)."""
    start = lx.State(numbers[1:], jnp.zeros(1))
    run = lx.simulate(ball(numbers[0]), start, t1=TIMES[-1], accuracy=PRECISE, saveat=diffrax.SaveAt(ts=TIMES))
    return run.q[:, 0], run.impacts("floor"), run.unaccounted_energy(), run.work()["floor"]


def final_height(numbers):
    start, saveat = lx.State(numbers[1:], jnp.zeros(1)), diffrax.SaveAt(t1=True)
    return lx.simulate(ball(numbers[0]), start, t1=TIMES[-1], accuracy=PRECISE, saveat=saveat).end.q[0]


NUMBERS = np.array([[0.95, 0.4], [0.8, 2.0], [1.0, 1.0]])


def test_a_ball_bounces_as_in_closed_form():
    """Ten bounces and more, members of a batch with impacts of their own."""
    heights, impacts, unaccounted, work = map(np.asarray, bounces(jnp.asarray(NUMBERS)))
    exact = np.array([[height(t, *numbers) for t in TIMES] for numbers in NUMBERS])
    np.testing.assert_allclose(heights, exact, atol=1e-9)
    assert impacts[0, -1] >= 10
    np.testing.assert_allclose(unaccounted, 0.0, atol=1e-9)
    fallen = (NUMBERS[:, 0] ** (2 * impacts[:, -1]) - 1.0) * 1.3 * G * NUMBERS[:, 1]
    np.testing.assert_allclose(work[:, -1], fallen, atol=1e-9)


def differences(function, x):
    """Derivatives by central differences of fourth order."""
    rise = lambda e: function(x + e) - function(x - e)
    return np.stack([(8.0 * rise(e) - rise(2.0 * e)) / (12.0 * STEP) for e in STEP * np.eye(len(x))], axis=-1)


@pytest.mark.slow
def test_derivatives_through_ten_impacts():
    """Forwards and backwards, against those of the closed form."""

    @jax.jit
    def both(numbers):
        along = jax.linearize(final_height, numbers)[1]
        return jax.vmap(along)(jnp.eye(2)), *jax.linear_transpose(along, numbers)(1.0)

    for numbers in NUMBERS[:2]:
        exact = differences(lambda x: np.array(height(TIMES[-1], *x)), numbers)
        for found in both(numbers):
            np.testing.assert_allclose(found, exact, rtol=1e-6)


@pytest.mark.slow
def test_a_pendulum_hit_at_the_bottom_ten_times():
    """Each hit leaves the square of the restitution of the energy; the time of a swing is an elliptic integral."""
    angle, restitution = 1.0, 0.9
    half = lambda top: 2.0 / np.sqrt(1.5 * G) * ellipk(np.sin(top / 2.0) ** 2)  # half a period at an amplitude
    tops = [angle]
    for _ in range(10):
        tops.append(2.0 * np.arcsin(restitution * np.sin(tops[-1] / 2.0)))
    ends = half(angle) / 2.0 + np.cumsum([half(top) for top in tops[1:]])
    ts = np.concatenate([[0.0], ends - np.array([half(top) for top in tops[1:]]) / 2.0])
    start = lx.State(jnp.array([angle - np.pi / 2.0]), jnp.zeros(1))
    stop, saveat = lx.Impact("hinge", lower=-np.pi / 2.0, restitution=restitution, name="stop"), diffrax.SaveAt(ts=ts)
    swinging = pendulum(mass=2.0, forces=[stop])
    run = lx.simulate(swinging, start, t1=ts[-1], accuracy=lx.Accuracy(rtol=1e-12), saveat=saveat)
    np.testing.assert_array_equal(run.impacts("stop"), np.arange(11))
    np.testing.assert_allclose(run.q[:, 0] + np.pi / 2.0, tops, atol=1e-9)
    np.testing.assert_allclose(run.v[:, 0], 0.0, atol=1e-9)
    energy = np.asarray(run.energy()) + G
    np.testing.assert_allclose(energy, energy[0] * restitution ** (2 * np.arange(11)), rtol=1e-9)


def hit(numbers):
    """A four-bar whose tip of the coupler meets a wall, and whose rocker has a stop, by (restitution, wall, stop)."""
    restitution, wall, stop = numbers
    facing_left = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    plane = lx.Plane(lx.GROUND.at(jnp.stack([wall, 0.0, 0.0]), facing_left))
    impacts = [
        lx.Impact(plane, lx.Sphere(lx.rod("coupler", 0.7, 1.0).at("tip"), 0.05), restitution=restitution, name="wall"),
        lx.Impact("rocker_bearing", upper=stop, restitution=restitution, name="stop"),
    ]
    return four_bar(crank=0.3, coupler=0.7, rocker=0.6, ground=0.8, cut="rocker_pin", forces=impacts)


FOUR_BAR = jnp.array([0.8, 0.8, 2.1])


# With the crank at 1.2 rad and -9 rad/s, as bearings of rocker and crank and the crank's pin; a run closes the loop to
# all digits.
START = lx.State(jnp.array([1.68269576, 1.2, -0.73061624]), jnp.array([-3.20563953, -9.0, 10.91118997]))


def simulated(numbers, saveat, start=START, **options):
    return lx.simulate(hit(numbers), start, t1=1.0, accuracy=PRECISE, saveat=saveat, **options)


@pytest.mark.parametrize("formulation", ["tangent-space", pytest.param("lagrange-multipliers", marks=pytest.mark.slow)])
def test_loops_stay_closed_and_gaps_open(formulation):
    """Energy is accounted for, and impacts agree with what kinetic energy and gaps say."""
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 401))
    run = simulated(FOUR_BAR, saveat, formulation=formulation)

    @eqx.filter_jit
    def read(run):
        system = system_of(run.mechanism, run.q.dtype)
        gaps = lambda q: jnp.stack([force.gap(configure(system, 0.0, q)) for force in system.forces[1:]])
        impacts = [run.impacts(name)[-1] for name in ("wall", "stop")]
        return impacts, run.worst_violation(), run.unaccounted_energy(), jax.vmap(gaps)(run.q)

    impacts, violation, unaccounted, gaps = read(run)
    assert min(impacts) >= 2
    assert max(violation.position, violation.velocity) < (1e-9 if formulation == "tangent-space" else 1e-6)
    np.testing.assert_allclose(unaccounted, 0.0, atol=1e-7 if formulation == "tangent-space" else 1e-4)
    assert -1e-9 < np.min(gaps) < 1e-3


@pytest.mark.slow
def test_derivatives_through_impacts_in_loops():
    """Of the end's state, forwards and backwards, by numbers of the mechanism and by the speed at the start."""
    direction = START.v / START.v[0]

    def end(x):
        state = lx.State(START.q, START.v + x[3] * direction)
        found = simulated(x[:3], diffrax.SaveAt(t1=True), state).end
        return jnp.stack([found.q[0], found.v[0] / 10.0])

    x = jnp.concatenate([FOUR_BAR, jnp.zeros(1)])
    found = jax.jit(jax.jacfwd(end))(x)
    size = np.max(np.abs(found))
    np.testing.assert_allclose(found, differences(jax.jit(end), x), atol=1e-6 * size)
    np.testing.assert_allclose(jax.jit(jax.jacrev(end))(x), found, atol=1e-9 * size)


def test_a_ball_that_comes_to_rest_ends_the_run():
    """Bounces accumulate at a time that the closed form knows; from there there are no derivatives."""
    restitution, start = 0.5, lx.State(jnp.ones(1), jnp.zeros(1))
    with pytest.raises(lx.SimulationError, match="comes to rest on the stop") as told:
        lx.simulate(ball(restitution), start, t1=3.0, accuracy=PRECISE)
    found = told.value.solution
    rest = np.sqrt(2.0 / G) * (1.0 + restitution) / (1.0 - restitution)
    np.testing.assert_allclose(found.t_end, rest, atol=1e-5)
    assert found.result == lx.RESULTS.rests_on_stop
    assert found.stats["num_steps"] < 200


@pytest.mark.parametrize("coordinate", [0.0, -0.5], ids=["on", "beyond"])
def test_runs_that_begin_on_a_stop_or_beyond_it(coordinate):
    start = lx.State(jnp.full(1, coordinate), jnp.zeros(1))
    run = lx.simulate(ball(0.5), start, t1=1.0, accuracy=PRECISE, throw=False)
    assert run.result == lx.RESULTS.rests_on_stop
    upwards = lx.State(jnp.zeros(1), jnp.ones(1))
    run = lx.simulate(ball(0.5), upwards, t1=0.1, accuracy=PRECISE)
    np.testing.assert_allclose(run.end.q, 0.1 - G * 0.1**2 / 2.0, rtol=1e-9)


def test_spheres_swap_speeds():
    """Two equal spheres on a rail swap speeds."""
    one, other = lx.point_mass("one", 1.0), lx.point_mass("other", 1.0)
    rails = [lx.Prismatic(f"{body.name}_rail", lx.GROUND, body, "x") for body in (one, other)]
    impact = lx.Impact(lx.Sphere(one, 0.1), lx.Sphere(other, 0.2), restitution=1.0, name="hit")
    start, saveat = lx.State(jnp.array([0.0, 1.0]), jnp.array([1.0, 0.0])), diffrax.SaveAt(t1=True)
    run = lx.simulate(lx.Mechanism([one, other], rails, [impact]), start, t1=1.0, saveat=saveat)
    np.testing.assert_allclose(run.end.v, [0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(run.end.q, [0.7, 1.3], atol=1e-9)
    assert run.impacts("hit")[-1] == 1


def on_a_table(numbers):
    """A ball that bounces on a table that a drive moves up and down, from random numbers."""
    least, ranges = jnp.array([0.5, 0.75, 0.01, 1.0]), jnp.array([1.0, 0.25, 0.04, 7.0])
    start, restitution, amplitude, frequency = least + ranges * numbers
    bodies = one, table = lx.point_mass("ball", 1.0), lx.point_mass("table", 2.0)
    rails = [lx.Prismatic(f"{body.name}_rail", lx.GROUND, body, axis="y") for body in bodies]
    upwards = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    shapes = lx.Sphere(one, 0.1), lx.Plane(table.at([0.0, 0.0, 0.0], rotation=upwards))
    impact = lx.Impact(*shapes, restitution=restitution, name="hit")
    drive = lx.Drive("motor", "table_rail", lambda t: amplitude * jnp.sin(frequency * t))
    mechanism = lx.Mechanism(bodies, rails, [GRAVITY, impact], [drive])
    return mechanism, lx.State(jnp.stack([0.0, start]), jnp.stack([amplitude * frequency, 0.0])), 1.5


def in_a_loop(numbers):
    """A four-bar whose rocker swings into a stop, from random numbers."""
    restitution, stop, speed = numbers[:3] * jnp.array([0.4, 0.3, 0.6]) + jnp.array([0.6, 1.9, 0.7])
    stop = lx.Impact("rocker_bearing", upper=stop, restitution=restitution, name="hit")
    linkage = four_bar(crank=0.3, coupler=0.7, rocker=0.6, ground=0.8, cut="rocker_pin", forces=[stop])
    return linkage, lx.State(START.q, speed * START.v), 1.0


@pytest.mark.parametrize("made", [on_a_table, pytest.param(in_a_loop, marks=pytest.mark.slow)])
def test_hits_are_the_same_at_any_tolerance(made):
    """Of random mechanisms with drives and loops, which steps leave by the tolerance between their ends."""

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def ends(numbers, rtol):
        mechanism, start, t1 = made(numbers)
        saveat = diffrax.SaveAt(t1=True)
        run = lx.simulate(mechanism, start, t1=t1, accuracy=lx.Accuracy(rtol=rtol), saveat=saveat, max_steps=1000)
        return run.result == lx.RESULTS.successful, run.impacts("hit")[-1], run.end.q, run.stats["num_steps"]

    numbers = np.random.default_rng(1).uniform(size=(100, 4))
    (*_, counts, exact, _), *others = (ends(numbers, rtol) for rtol in (1e-12, 1e-8, 1e-4))
    assert np.sum(counts) > 150
    for (well, impacts, q, steps), rtol in zip(others, (1e-8, 1e-4), strict=True):
        assert np.all(well)
        np.testing.assert_array_equal(impacts, counts)
        np.testing.assert_allclose(q, exact, atol=1e3 * rtol)
        assert np.max(steps) < 200


@pytest.mark.parametrize(
    "law", [lambda t: 2.0 * t, lambda t: jnp.sin(1.8 * t), lambda t: 4.0 * t**2], ids=["steady", "slower", "faster"]
)
def test_a_drive_into_a_stop_is_named(law):
    """No impulse changes the speed of a joint that is driven; no hit is counted."""
    stop, motor = lx.Impact("hinge", upper=0.5, restitution=0.5, name="stop"), lx.Drive("motor", "hinge", law)
    arm = pendulum(forces=[stop], constraints=[motor])
    with pytest.raises(lx.SimulationError, match="drive 'motor' of joint 'hinge' leads into Impact 'stop'") as told:
        lx.simulate(arm, lx.assemble(arm), t1=1.0)
    found = told.value.solution
    assert found.result == lx.RESULTS.driven_into_stop
    np.testing.assert_allclose(law(found.t_end), 0.5, rtol=1e-12)
    assert found.impacts("stop")[np.isfinite(found.ts)][-1] == 0


BODY, FLOOR = lx.point_mass("a", 1.0), lx.Plane(lx.GROUND)


@pytest.mark.parametrize(
    ("words", "make"),
    [
        ("neither lower nor upper", lambda: lx.Impact("a", restitution=0.5)),
        ("restitution is 1.5", lambda: lx.Impact("a", lower=0.0, restitution=1.5)),
        ("slowest .* is 0.0", lambda: lx.Impact("a", lower=0.0, restitution=0.5, slowest=0.0)),
        ("shapes have neither", lambda: lx.Impact(FLOOR, lx.Sphere(BODY, 1.0), restitution=0.5, lower=0.0)),
        ("both shapes are on body 'ground'", lambda: lx.Impact(FLOOR, lx.Sphere(lx.GROUND, 1.0), restitution=0.5)),
        ("both shapes are planes", lambda: lx.Impact(FLOOR, lx.Plane(BODY), restitution=0.5)),
        ("a shape is 'a'", lambda: lx.Impact("a", "b", restitution=0.5)),
    ],
    ids=lambda entry: entry if isinstance(entry, str) else "",
)
def test_bad_impacts_are_refused(words, make):
    with pytest.raises(ValueError, match=words):
        make()


def test_what_impacts_cannot_do_is_said():
    start = lx.State(jnp.ones(1), jnp.zeros(1))
    with pytest.raises(ValueError, match="needs steps that end where an impact happens"):
        lx.simulate(ball(0.5), start, t1=1.0, stepsize_controller=diffrax.ConstantStepSize(), dt0=0.1)
    here = lx.Solution.of_state(ball(0.5), start)
    with pytest.raises(ValueError, match="has impulses, and no force"):
        here.force("floor")
    with pytest.raises(ValueError, match="without the run"):
        here.impacts("floor")
    with pytest.raises(ValueError, match="unknown impact 'wall'; known: 'floor'"):
        here.impacts("wall")
