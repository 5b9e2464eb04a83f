"""What happens between steps is not passed over: thin obstacles, pulses of known times, switches of any unit."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.simulation.integrate import switches
from linkax.simulation.read import work

THROWS = 200
RADIUS = 0.05  # of a ball and of a post
LAW = lx.ContactLaw(stiffness=1e7, restitution=0.8, impact_speed=10.0)


def thrown(numbers, stop):
    """A ball thrown at 10 m/s, with a post of random width somewhere on its way, off its centre by at most half."""
    time, off, width = 0.1 + 0.8 * numbers[0], numbers[1] - 0.5, RADIUS * (0.02 + numbers[2])
    centre = jnp.stack([10.0 * time, 4.0 * time - 5.0 * time**2 + off * (RADIUS + width), 0.0 * time])
    ball = lx.RigidBody("ball", 1.0, inertia=[0.01, 0.01, 0.01])
    post = lx.Sphere(lx.GROUND.at(centre), width)
    gravity = lx.Gravity([0.0, -10.0, 0.0])
    return lx.Mechanism(
        [ball], [lx.Rectangular("free", lx.GROUND, ball, axis="z")], [gravity, stop(lx.Sphere(ball, RADIUS), post)]
    )


STOPS = {
    "impact": lambda *shapes: lx.Impact(*shapes, restitution=0.8),
    "contact": lambda *shapes: lx.Contact(*shapes, LAW),
}


@pytest.mark.parametrize("stop", STOPS.values(), ids=STOPS)
def test_no_thin_obstacle_is_passed_through(stop):
    """In free flight there is no error, and a step takes as much as the whole run."""

    def end(numbers):
        start = lx.State(jnp.zeros(2), jnp.array([10.0, 4.0]))
        return lx.simulate(thrown(numbers, stop), start, t1=1.0, saveat=diffrax.SaveAt(t1=True)).end.v

    speeds = jax.jit(jax.vmap(end))(np.random.default_rng(0).uniform(size=(THROWS, 3)))
    assert np.max(speeds[:, 0]) < 9.9


def turning_rod(numbers, angle, element):
    """A rod that turns freely at 7 to 300 rad/s from an angle, with a force element."""
    rod = lx.rod("rod", 1.0, 3.0)
    hinge = lx.Revolute("hinge", lx.GROUND, rod.at("base"), axis="z")
    speed = 7.0 + 293.0 * numbers[0]
    return lx.Mechanism([rod], [hinge], [element(rod)]), lx.State(angle[None], speed[None])


STIFF = lx.ContactLaw(stiffness=1e11, restitution=0.8, impact_speed=10.0)
STOPS_OF_A_BLADE = {**STOPS, "contact": lambda *shapes: lx.Contact(*shapes, STIFF)}


@pytest.mark.parametrize("stop", STOPS_OF_A_BLADE.values(), ids=STOPS_OF_A_BLADE)
def test_no_blade_turns_past_a_post(stop):
    """In steps without error, as long as many turns; it leaves the post at the speed that the law tells."""

    def end(numbers):
        angle = 0.5 + 5.0 * numbers[1]
        place = jnp.stack([0.8 * jnp.cos(angle), 0.8 * jnp.sin(angle), 0.0 * angle])
        post = lx.Sphere(lx.GROUND.at(place), 10.0 ** (-3.0 + 1.5 * numbers[2]))
        blade = lambda rod: lx.Capsule(rod.at("base"), rod.at("tip"), radius=0.002)
        mechanism, start = turning_rod(numbers, jnp.zeros(()), lambda rod: stop(blade(rod), post))
        times = jnp.stack([1.2 * angle, 20.0 + 0.0 * angle]) / start.v[0]
        run = lx.simulate(mechanism, start, t1=times[1], saveat=diffrax.SaveAt(ts=times))
        return start.v[0], run.v[0, 0]

    before, after = map(np.asarray, jax.jit(jax.vmap(end))(np.random.default_rng(0).uniform(size=(THROWS // 2, 3))))
    share = 0.8 * np.ones_like(before)
    if stop is not STOPS["impact"]:  # Marhefka and Orin (1999)
        hit = 0.8 * STIFF.damping * before
        for _ in range(200):
            share = 1.0 / hit - (1.0 + 1.0 / hit) * np.exp(-(1.0 + share) * hit)
    np.testing.assert_allclose(after, -share * before, rtol=5e-3)


UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
DAMPED = lx.ContactLaw(stiffness=1e6, damping=0.5)


def over_a_floor(depth, rod):
    floor = lx.Plane(lx.GROUND.at(jnp.stack([0.0, depth - 1.0, 0.0]), UPRIGHT))
    return lx.Contact(lx.Capsule(rod.at("base"), rod.at("tip"), 0.0), floor, DAMPED)


def on_a_rope(depth, rod):
    points = [lx.GROUND.at([0.0, 2.0, 0.0]), rod.at("tip")]
    return lx.ElasticRope(points, stiffness=1e3, free_length=3.0 - depth, damping=100.0)


@pytest.mark.parametrize("element", [over_a_floor, on_a_rope])
def test_what_acts_for_a_moment_of_a_turn_is_not_passed_over(element):
    """Laws with damping, which stop to act while things still touch, take from the speed of a rod that turns freely."""

    def change(numbers):
        depth = 10.0 ** (-4.0 + 2.0 * numbers[1])
        mechanism, start = turning_rod(numbers, 4.0 * numbers[2], lambda rod: element(depth, rod))
        run = lx.simulate(mechanism, start, t1=6.0 / start.v[0], saveat=diffrax.SaveAt(t1=True))
        return run.end.v[0] / start.v[0] - 1.0

    changes = jax.jit(jax.vmap(change))(np.random.default_rng(0).uniform(size=(THROWS, 3)))
    assert np.max(changes) < -1e-12


def test_each_dip_is_found():
    """Of a sine that goes below zero by 1e-5 to 1e-2 somewhere in a step, in few windows."""

    def find(numbers):
        begin, length, depth = numbers
        below = lambda share: 1e15 * jnp.atleast_1d(1.0 - depth + jnp.sin(begin + share * length))
        search = switches._searched(below, below(1.0), 4e-15)
        return search.finds, search.count

    begin, length, depth = np.random.default_rng(1).uniform([0.0, 2.0, 2.0], [3.0, 4.0, 5.0], (20_000, 3)).T
    dips = begin + length > 1.5 * np.pi + 0.2
    found, windows = jax.jit(jax.vmap(find))(np.stack([begin, length, 10.0**-depth], axis=1)[dips])
    assert np.all(found)
    assert np.mean(windows) < 3.0


class Holder:
    """An object of one's own that holds a law."""

    def __init__(self, pulse):
        self.pulse = pulse

    def __call__(self, t, motion):
        return self.pulse(t)

    def push(self, t):
        return self.pulse(t)


class Pulsed(lx.AbstractForce):
    """A force element of one's own, whose method reads a law of the module."""

    @property
    def terms(self):
        return (lx.Term("hinge", None),)

    def load(self, t, motion):
        return motion.joint_load(self.terms[0], AREA_OF_A_HALF(t))


AREA_OF_A_HALF = lx.PiecewiseLinear([0.0, 0.7, 0.705, 0.71, 2.0], [0.0, 0.0, 100.0, 0.0, 0.0])


def by_a_list(pulse):
    held = [{"pulse": pulse}]
    return lambda t, motion: held[0]["pulse"](t)


def by_a_method(pulse):
    holder = Holder(pulse)
    return lambda t, motion: (lambda s: holder.push(s))(t)


READ = {
    "the law": lambda pulse: pulse,
    "a function": lambda pulse: lambda t, motion: pulse(t),
    "a default": lambda pulse: lambda t, motion, pulse=pulse: pulse(t),
    "a list": by_a_list,
    "an object": Holder,
    "a method": by_a_method,
}


def test_a_pulse_that_an_element_of_ones_own_reads_is_not_stepped_over():
    run = lx.simulate(pendulum(gravity=0.0, forces=[Pulsed()]), lx.State(jnp.zeros(1), jnp.zeros(1)), t1=2.0)
    np.testing.assert_allclose(run.end.v[0], 3.0 * 0.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("law", "read"), [*((lx.PiecewiseLinear, name) for name in READ), (lx.Spline, "the law"), (lx.Spline, "a function")]
)
@pytest.mark.parametrize("accuracy", [lx.DRAFT, lx.PRECISE])
def test_a_pulse_at_known_times_is_not_stepped_over(law, read, accuracy):
    """The end's speed is the area of the pulse over the inertia, at any tolerance."""
    pulse = law([0.0, 0.7, 0.705, 0.71, 2.0], [0.0, 0.0, 100.0, 0.0, 0.0])
    arm = pendulum(gravity=0.0, forces=[lx.JointTorque("hinge", READ[read](pulse))])
    run = lx.simulate(arm, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=2.0, accuracy=accuracy)
    ts = np.linspace(0.0, 2.0, 2_000_001)
    area = np.trapezoid(np.asarray(jax.vmap(pulse)(ts)), ts)
    np.testing.assert_allclose(run.end.v[0], 3.0 * area, rtol=1e-6)
    assert law is lx.Spline or run.stats["num_steps"] < 20


class Box(eqx.Module):
    """A torque of 5 N m from the first of its times to the last one, which jumps there."""

    times: jax.Array

    def __call__(self, t, motion):
        return jnp.where((t >= self.times[0]) & (t < self.times[-1]), 5.0, 0.0)


def triangle(times):
    return lx.PiecewiseLinear(times, [0.0, 5.0, 0.0])


def with_a_driven_wheel(arm):
    """The same beside a wheel that a drive turns."""
    wheel = lx.RigidBody("wheel", 1.0, inertia=[1.0, 1.0, 1.0])
    axle = lx.Revolute("axle", lx.GROUND, wheel, axis="x")
    return lx.Mechanism([*arm.bodies, wheel], [*arm.joints, axle], arm.forces, [lx.Drive("motor", "axle", speed=3.0)])


@pytest.mark.parametrize("law", [triangle, Box])
@pytest.mark.parametrize(
    ("accuracy", "driven"),
    [(lx.DRAFT, False), (lx.PRECISE, False), pytest.param(lx.DRAFT, True, marks=pytest.mark.slow)],
    ids=["draft", "precise", "driven"],
)
def test_derivatives_by_the_times_of_a_pulse(law, accuracy, driven):
    """Forwards and backwards, with the pulse in the middle of the run, and at its end."""
    share = 0.5 if law is triangle else 1.0  # of the height that the mean of the pulse is

    def end(numbers, t1):
        begin, half = numbers
        arm = pendulum(
            length=1.0,
            mass=3.0,
            gravity=0.0,
            forces=[lx.JointTorque("hinge", law(begin + half * jnp.arange(3.0)))],
        )
        arm = with_a_driven_wheel(arm) if driven else arm
        start = lx.assemble(arm) if driven else lx.State(jnp.zeros(1), jnp.zeros(1))
        motion = lx.simulate(arm, start, t1=t1, accuracy=accuracy)
        return jnp.stack([motion.joint("hinge")[-1], motion.joint_speed("hinge")[-1], motion.joint("hinge")[100]])

    def exact(numbers, t1):
        begin, half = numbers
        speed = share * 5.0 * 2.0 * half
        return jnp.stack([speed * (t1 - begin - half), speed, jnp.maximum(speed * (t1 / 2.0 - begin - half), 0.0)])

    numbers = jnp.array([0.7, 0.1])
    for t1 in (2.0, 4.0):
        slopes = jax.jacfwd(exact)(numbers, t1)
        for mode in (jax.jacfwd, jax.jacrev):
            np.testing.assert_allclose(mode(end)(numbers, t1), slopes, rtol=1e-6, atol=1e-6)


class Push(lx.AbstractForce):
    """A constant push along a joint while it moves forwards; `unit`: what its switch counts in."""

    joint: str = eqx.field(static=True)
    unit: float

    @property
    def terms(self):
        return (lx.Term(self.joint, 0),)

    def switch(self, t, motion):
        return self.unit * motion.joint_speed(self.joint)

    def load(self, t, motion, on):
        return motion.joint_load(self.terms[0], jnp.where(on, 1000.0, 0.0))


def test_the_unit_of_a_switch_does_not_matter():
    """A piston that is pushed while it moves outwards, through many dead centres."""
    crank, rod, piston = lx.RigidBody("crank", 1.0, inertia=1.0), lx.rod("rod", 0.2, 0.5), lx.point_mass("piston", 1.0)
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank, axis="z"),
        lx.Revolute("big", crank.at([0.1, 0.0, 0.0]), rod.at("base"), axis="z"),
        lx.Revolute("small", rod.at("tip"), piston, axis="z"),
        lx.Prismatic("slide", lx.GROUND, piston, axis="x"),
    ]

    @jax.jit
    @jax.vmap
    def run(unit):
        engine = lx.Mechanism([crank, rod, piston], joints, [Push("slide", unit)])
        start = lx.assemble(engine, {"bearing": 0.3}, {"bearing": 10.0}, guess={"slide": 0.3})
        found = lx.simulate(engine, start, t1=3.0, saveat=diffrax.SaveAt(t1=True), throw=False)
        return found.joint("bearing")[-1], found.stats["num_steps"], found.result == lx.RESULTS.successful

    angle, steps, well = run(10.0 ** np.arange(-6.0, 7.0, 3.0))
    assert np.all(well)
    np.testing.assert_allclose(angle, np.full(5, angle[2]), rtol=1e-9)
    assert np.max(steps) < 30.0 * angle[2] / (2.0 * np.pi)


def test_work_between_saved_times_is_seen(monkeypatch):
    """A stiff stop takes all energy that is lost, in contacts that are shorter than the time between saved ones."""
    ball = lx.RigidBody("ball", mass=1.0, inertia=[0.01, 0.01, 0.01])
    slide = lx.Prismatic("slide", lx.GROUND, ball, axis="z")
    law = lx.ContactLaw(stiffness=1e8, restitution=0.5, impact_speed=5.0)
    stop = lx.Contact(lx.Sphere(ball, 0.1), lx.Plane(lx.GROUND), law, name="stop")
    mechanism = lx.Mechanism([ball], [slide], [lx.Gravity([0.0, 0.0, -10.0]), stop])
    simulated = lambda: lx.simulate(mechanism, lx.State(jnp.array([1.1]), jnp.zeros(1)), t1=1.0)
    run = simulated()
    energy = run.energy()
    np.testing.assert_allclose(run.work()["stop"][-1], energy[-1] - energy[0], rtol=1e-6)
    np.testing.assert_allclose(run.unaccounted_energy(), 0.0, atol=1e-5)
    monkeypatch.setattr(work, "MOST_PARTS", 0)
    with pytest.warns(lx.AccuracyWarning, match="work is known to 8.7 J only, .* save more of them"):
        simulated().work()
