"""Wheels on rails: where they touch, forces of creep, wheelsets that hunt, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.constraint_rows import constraint_gamma, constraint_jacobian, constraint_residual
from linkax.equations.coordinates import rates
from linkax.equations.dynamics import along_speeds
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.model.forces.wheel_rail import WheelRailPair

G = 9.81
RADIUS, CONICITY, HALF, CROWN = 0.46, 0.05, 0.75, 0.02  # of wheelsets: radius, cone, half the gauge, radius of rails
GRAVITY = lx.Gravity([0.0, 0.0, -G])
LAW = lx.ContactLaw(1e11)
CREEP = lx.Creep(6e6, 5e6, 0.3, lateral_spin=1e4, spin=20.0, load=1e4)


def crowned(radius):
    return lambda y: jnp.sqrt(radius**2 - y**2) - radius


def free_wheel():
    """A wheel that nothing holds, and its system."""
    wheel = lx.RigidBody("wheel", 1000.0, inertia=3 * [100.0])
    return wheel, system_of(lx.Mechanism([wheel], [lx.Free("flight", lx.GROUND, wheel)]), float)


def turned(yaw, roll, spin):
    """Coordinates of a quaternion: yaw about z, then roll about x, then spin about y."""
    x, y, z, w = Rotation.from_euler("ZXY", [yaw, roll, spin]).as_quat()
    return np.array([w, x, y, z])


def test_a_cone_touches_an_arc():
    """A plane along the rail that touches the cone holds its apex; the arc is nearest to it below its centre."""
    wheel, system = free_wheel()
    cone = lambda y: RADIUS + CONICITY * y
    pair = WheelRailPair(wheel.reference, lx.GROUND, cone, crowned(0.3), [-0.07, 0.07], "pair")
    read = jax.jit(lambda q: (pair.spot(configure(system, 0.0, q)), configure(system, 0.0, q).orientation("wheel")))
    random = np.random.default_rng(0)
    for _ in range(8):
        yaw, roll, spin, y, z = random.normal(size=5) * np.array([0.05, 0.02, 3.0, 0.003, 1e-3])
        centre = np.array([3.0, y, RADIUS + z])
        (gap, normal, (_, on_rail)), axes = read(jnp.concatenate([turned(yaw, roll, spin), centre]))
        axle = np.asarray(axes)[:, 1]
        apex, half_angle = centre - axle * RADIUS / CONICITY, np.arctan(CONICITY)
        slope = np.arctan2(axle[2], axle[1]) - np.arcsin(np.sin(half_angle) / np.hypot(axle[1], axle[2]))
        below = np.array([0.0, np.sin(slope), -np.cos(slope)])
        arc = np.array([0.0, 0.0, -0.3])
        distance = (arc - apex) @ below - 0.3
        np.testing.assert_allclose(gap, distance, atol=1e-12)
        np.testing.assert_allclose(normal, -below, atol=1e-12)
        np.testing.assert_allclose(on_rail[1:], (arc - below * (0.3 + distance / 2.0))[1:], atol=1e-12)


def flanged(y):
    """A hollow tread that rises into a flange, on negative y."""
    return RADIUS - 0.03 * y + 1.5 * y**2 + 0.03 * (1.0 + jnp.tanh(-(y + 0.035) / 0.008)) / 2.0


def test_it_touches_the_tread_or_the_flange():
    """The nearest place of all, against a search among many, for a wheel that goes from one side to the other."""
    wheel, system = free_wheel()
    head = lambda y: -1.7 * y**2 - 3e3 * y**4
    pairs = [
        WheelRailPair(wheel.reference, lx.GROUND, flanged, head, span, "pair")
        for span in ([-0.06, 0.06], [-0.035, 0.06], [0.02, 0.06])
    ]
    read = jax.jit(jax.vmap(lambda q: [pair.spot(configure(system, 0.0, q)) for pair in pairs]))
    places = np.linspace(-0.02, 0.01, 7)
    q = np.stack([np.array([1.0, 0.0, 0.0, 0.0, 0.0, y, RADIUS + 1e-4]) for y in places])
    found, held, at_end = read(q)
    u, y = np.linspace(-0.06, 0.06, 4001), np.linspace(-0.06, 0.06, 2001)
    height, slope = head(y), -3.4 * y - 1.2e4 * y**3
    for k, place in enumerate(places):
        z = RADIUS + 1e-4 - np.asarray(flanged(u))
        # The distance from the rail, negative below it: along its normals at the nearest of its places.
        apart = [(u[i] + place - y, z[i] - height) for i in range(0, 4001, 4)]
        nearest = [np.argmin(dy**2 + dz**2) for dy, dz in apart]
        normals = np.sqrt(1.0 + slope**2)
        gaps = [((dz - slope * dy) / normals)[at] for (dy, dz), at in zip(apart, nearest, strict=True)]
        assert abs(found.gap[k] - np.min(gaps)) < 1e-6
        on_wheel = found.arms[0][k, 1] + found.gap[k] / 2.0 * found.normal[k, 1]
        flat = np.min(np.abs(on_wheel - u[::4][np.array(gaps) < np.min(gaps) + 1e-7]))
        assert flat < 1e-3
        assert held.gap[k] >= found.gap[k] - 1e-9
        assert at_end.arms[0][k, 1] + at_end.gap[k] / 2.0 * at_end.normal[k, 1] > 0.02 - 1e-9
    assert np.ptp(found.normal[:, 1]) > 0.3  # the flange was among them


def on_moving_rail(law=LAW, creep=CREEP):
    """A wheel with a crowned, conical profile on a rail, both free bodies."""
    wheel = lx.RigidBody("wheel", 1.0, [0.02, 0.0, 0.01], [0.1, 0.2, 0.25])
    rail = lx.RigidBody("rail", 2.0, [0.1, 0.1, 0.0], [0.3, 0.2, 0.25])
    joints = [lx.Free(f"{body.name}_joint", lx.GROUND, body) for body in (wheel, rail)]
    half_turn = np.diag([-1.0, -1.0, 1.0])
    contact = lx.WheelRailContact(
        wheel.at([0.05, 0.1, 0.0], half_turn),
        rail.at([0.0, 0.1, 0.02], half_turn),
        radius=lambda y: 0.3 + 0.08 * y - 0.5 * y**2 + 2.0 * y**3,
        height=crowned(0.25),
        span=[-0.08, 0.08],
        law=law,
        creep=creep,
    )
    return lx.Mechanism([wheel, rail], joints, [contact])


def states(count):
    random = np.random.default_rng(4)
    for _ in range(count):
        angles = random.normal(size=6) * np.array([0.05, 0.02, 2.0, 0.05, 0.02, 0.05])
        places = random.normal(size=6) * np.array([0.3, 3e-3, 3e-4, 0.3, 1e-3, 3e-4])
        places[2] += 0.3196
        q = np.concatenate([turned(*angles[:3]), places[:3], turned(*angles[3:]), places[3:]])
        yield jnp.asarray(q), jnp.asarray(random.normal(size=12) * 0.3)


def test_gaps_forces_and_power():
    """Rates of gaps are those of motion; forces act equally on both, keep their energy, and creep takes some."""
    softly = lx.ContactLaw(1e7)
    mechanism, free = on_moving_rail(softly), on_moving_rail(softly, None)
    system, contact = system_of(mechanism, float), mechanism.forces[0]

    @jax.jit
    def read(q, v):
        moved = rates(system.topology, q, v)
        configuration = configure(system, 0.0, q)
        motion = move(configuration, v)
        gap, rate = jax.jvp(lambda q: contact.spots(configure(system, 0.0, q))[0].gap, (q,), (moved,))
        approach = contact._approach(motion, contact.spots(configuration)[0])[1]
        load = contact.load(0.0, motion, gap < 0.0)
        without = free.forces[0].load(0.0, motion, gap < 0.0)
        power = lambda load: (load.joint_force + along_speeds(configuration, load.force, load.moment)) @ v
        energy = lambda q: contact.potential_energy(configure(system, 0.0, q))
        rise = jax.jvp(energy, (q,), (moved,))[1]
        total = jnp.sum(load.force, axis=0)
        about = jnp.sum(load.moment + jnp.cross(configuration.world_center_of_mass(), load.force), axis=0)
        return gap, rate, approach, total, about, power(load) + rise, power(without) + rise, power(without)

    touched = 0
    for q, v in states(20):
        gap, rate, approach, total, about, lost, kept, power = read(q, v)
        np.testing.assert_allclose(rate, -approach, atol=1e-12)
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
        np.testing.assert_allclose(about, 0.0, atol=1e-9)
        np.testing.assert_allclose(kept, 0.0, atol=1e-9 * (1.0 + abs(power)))
        assert (lost < 0.0) == (gap < 0.0)
        touched += gap < 0.0
    assert 5 < touched < 20


@pytest.mark.slow
def test_derivatives_of_gap_and_place():
    """To the third order in both modes, against differences of those of an order less."""
    mechanism = on_moving_rail()
    system, contact = system_of(mechanism, float), mechanism.forces[0]
    (q, v), *_ = states(1)
    moved = rates(system.topology, q, v)

    def along(s):
        gap, _, (_, on_rail) = contact.spots(configure(system, 0.0, q + s * moved))[0]
        return jnp.append(on_rail, gap)

    slope = lambda function: lambda s: jax.jvp(function, (s,), (1.0,))[1]
    orders = [along, slope(along), slope(slope(along)), slope(slope(slope(along)))]
    read = jax.jit(lambda s: [order(s) for order in orders])
    back = jax.jit(jax.jacrev(orders[2]))
    step = 1e-4
    before, here, after = read(-step), read(0.0), read(step)
    for k in range(3):
        central = (after[k] - before[k]) / (2.0 * step)
        np.testing.assert_allclose(here[k + 1], central, rtol=1e-6, atol=1e-6 * np.max(np.abs(central)))
    np.testing.assert_allclose(back(0.0), here[3], rtol=1e-9, atol=1e-9 * np.max(np.abs(here[3])))


def test_creep_is_kalkers_and_polachs():
    creep, speed, load = lx.Creep(6e6, 5e6, 0.3, lateral_spin=1e4, spin=20.0, load=1e4, least_speed=1e-6), 20.0, 1e4
    force = lambda normal, speed, *slip: np.asarray(
        creep.force(jnp.asarray(normal), jnp.asarray(speed), jnp.array(slip))
    )
    # Small creep, forwards and backwards, where lateral force and moment by spin change sign.
    linear = lambda sign: [-6e6 * 1e-8, -5e6 * 2e-8 - sign * 1e4 * 3e-6, sign * 1e4 * 2e-8 - 20.0 * 3e-6]
    slip = np.array([1e-8, 2e-8, 3e-6]) * speed
    np.testing.assert_allclose(force(load, speed, *slip), linear(1.0), rtol=1e-8)
    np.testing.assert_allclose(force(load, -speed, *slip), linear(-1.0), rtol=1e-8)
    # Hertz' ellipse grows with the load.
    grown = force(8.0 * load, speed, 1e-8 * speed, 0.0, 3e-6 * speed)
    np.testing.assert_allclose(grown, [-4.0 * 0.06, -8.0 * 0.03, -16.0 * 6e-5], rtol=1e-8)
    # Polach's formula, and what it goes to.
    found = force(load, speed, 1e-3 * speed, 0.0, 0.0)[0]
    epsilon = np.pi * 6e3 / (4.0 * 0.3 * load)
    exact = 2.0 * 0.3 * load / np.pi * (epsilon / (1.0 + epsilon**2) + np.arctan(epsilon))
    np.testing.assert_allclose(found, -exact, rtol=1e-9)
    np.testing.assert_allclose(force(load, speed, 0.0, -1e3 * speed, 0.0)[1], 0.3 * load, rtol=1e-6)
    assert not np.any(force(0.0, speed, 0.1, 0.1, 0.1))
    for v in np.random.default_rng(2).normal(size=(50, 5)) * np.array([1e4, 20.0, 0.1, 0.1, 1.0]):
        assert force(abs(v[0]), *v[1:]) @ v[2:] < 0.0


BAD = {
    "one body": (lambda wheel: {"rail": wheel.at([0.0, 0.0, -0.4])}, "on body 'wheel'; give frames of two"),
    "radius": (lambda wheel: {"radius": 0.46}, r"left.*radius.*give a function"),
    "height": (lambda wheel: {"height": lambda y: jnp.stack([y, y])}, r"height.*must return a single number"),
    "span": (lambda wheel: {"span": [0.1, -0.1]}, "span.*give the least y"),
    "span of three": (lambda wheel: {"span": [0.1, 0.2, 0.3]}, r"span.*shape \(3,\)"),
}
RUBS = lx.ContactLaw(1.0, friction=lx.Friction(0.1, transition_speed=1.0))
ONLY_FORCES = {
    "friction": (lambda wheel: {"law": RUBS}, "friction"),
    "law": (lambda wheel: {"law": 1e9}, "give a linkax.ContactLaw"),
    "creep": (lambda wheel: {"creep": 0.3}, "give a linkax.Creep, or None"),
}
ONLY_CONSTRAINTS = {
    "direction": (lambda wheel: {"no_slip": ("up",)}, "no_slip is 'up'; known: 'along', 'across'"),
    "directions": (lambda wheel: {"no_slip": "along"}, "give a tuple"),
}


@pytest.mark.parametrize("case", [*BAD, *ONLY_FORCES, *ONLY_CONSTRAINTS])
def test_mistakes_are_named(case):
    wheel = lx.RigidBody("wheel", 1.0)
    change, told = (BAD | ONLY_FORCES | ONLY_CONSTRAINTS)[case]
    given = {"wheel": wheel, "rail": lx.GROUND, "radius": lambda y: 0.4 + y, "height": jnp.cos, "span": [-0.1, 0.1]}
    changed = given | change(wheel)
    if case not in ONLY_FORCES:
        with pytest.raises(ValueError, match=f"WheelOnRail 'left'.*{told}" if case not in BAD else told):
            lx.WheelOnRail("left", **changed)
    if case not in ONLY_CONSTRAINTS:
        with pytest.raises(ValueError, match=told):
            lx.WheelRailContact(**({"law": LAW, "name": "left"} | changed))


def test_bad_creep_is_named():
    for bad in ({"longitudinal": -1.0}, {"friction": 0.0}, {"load": 0.0}, {"least_speed": 0.0}, {"spin": np.nan}):
        (name,) = bad
        with pytest.raises(ValueError, match=f"Creep: {name}"):
            lx.Creep(**({"longitudinal": 1.0, "lateral": 1.0, "friction": 0.3} | bad))


CONE = np.arctan(CONICITY)
AXLE, BOX = (1200.0, 700.0, 80.0), (200.0, 100.0)  # mass, moments about z and about the axle; mass, moment of inertia
SPRING, ARM, SPAN = 2e5, 1.0, [-0.015, 0.015]


def sides(axle):
    """What makes the left and the right wheel of a wheelset of cones on crowned rails."""
    for sign in (1.0, -1.0):
        place = [0.0, sign * HALF, 0.0]
        cone = lambda y, sign=sign: RADIUS - sign * CONICITY * y
        yield dict(wheel=axle.at(place), rail=lx.GROUND.at(place), radius=cone, height=crowned(CROWN), span=SPAN)


class Wheelset:
    """Of a stiffness of contact: where it runs, as what is linear about it."""

    def __init__(self, stiffness):
        self.mass, self.law = AXLE[0] + BOX[0], lx.ContactLaw(stiffness)
        self.normal = self.mass * G / (2.0 * np.cos(CONE))
        depth = (self.normal / stiffness) ** (2.0 / 3.0)
        self.height = RADIUS - CROWN + (CROWN - depth) / np.cos(CONE)  # of the axle
        self.rolling = self.height + CROWN - (CROWN - depth / 2.0) * np.cos(CONE)  # radius at which it rolls
        self.half = HALF - (CROWN - depth / 2.0) * np.sin(CONE)  # of the distance between contacts
        self.above = self.height + CROWN  # the centres of the arcs

    def running(self, speed, spring=SPRING):
        """It, held by springs [N/m] in a carriage that goes at a speed, and its state."""
        carriage, box = lx.RigidBody("carriage", 1.0), lx.RigidBody("box", BOX[0], inertia=3 * [BOX[1]])
        axle = lx.RigidBody("axle", AXLE[0], inertia=[AXLE[1], AXLE[2], AXLE[1]])
        joints = [
            lx.Prismatic("track", lx.GROUND.at([0.0, 0.0, self.height]), carriage, "x"),
            lx.Free("free", lx.GROUND, box),
            lx.Revolute("spin", box, axle, "y"),
        ]
        creep = lx.Creep(6e6, 5e6, 0.3, least_speed=1e-3)
        wheels = [
            lx.WheelRailContact(**side, law=self.law, creep=creep, name=name)
            for name, side in zip(("left", "right"), sides(axle), strict=True)
        ]
        springs = [
            lx.Spring(box.at([0.0, y, 0.0]), carriage.at([x, y, 0.0]), spring) for x in (-0.5, 0.5) for y in (-ARM, ARM)
        ]
        drive = lx.Drive("motor", "track", speed=speed)
        mechanism = lx.Mechanism([carriage, box, axle], joints, [GRAVITY, *wheels, *springs], [drive])
        turns = speed / self.rolling
        q = jnp.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.height, 0.0])
        return mechanism, lx.State(q, jnp.stack([speed, *3 * [0.0], speed, 0.0, 0.0, turns]))

    def textbook(self, speed):
        """Eigenvalues of lateral displacement y and yaw ψ of a wheelset on two rails, (4,).

        m ÿ + 2 f₂₂ (ẏ / V − ψ) + (k_y + W ...) y = 0 and I ψ̈ + 2 f₁₁ (b² ψ̇ / V + b λ y / r) + (k_ψ − W b λ) ψ = 0:
        Wickens, Fundamentals of Rail Vehicle Dynamics, Swets & Zeitlinger, 2003, ch. 3; here with all of the roll φ =
        κ y that goes with y, and the axle's gyroscopic moment. The wheelset's bottom is a V on two points, the centres
        of the arcs, and the V's apex moves on the circle of the inscribed angle through them.
        """
        from_circle = 2.0 * HALF / np.sin(2.0 * CONE)  # its diameter
        apex = self.above + HALF * CONICITY
        roll = 1.0 / (from_circle - apex)  # κ
        weight, moment = self.mass * G, AXLE[1] + BOX[1]
        sideways = 1.0 + self.rolling * roll  # of what touches, for each y
        f11, f22 = 6e6, 5e6 / np.cos(CONE) ** 2
        gyroscopic = AXLE[2] * speed / self.rolling * roll
        lifts = weight * (2.0 * from_circle - apex) * roll**2
        stiff, yaw_stiff = 4.0 * SPRING, 4.0 * SPRING * ARM**2
        tips = weight * (self.above * CONICITY**2 - HALF * CONICITY)
        steers = 2.0 * f11 * self.half * CONICITY * (1.0 + self.above * roll) / self.rolling
        mass = np.array([self.mass + moment * roll**2, moment])[:, None]
        damping = [[2.0 * f22 * sideways**2 / speed, -gyroscopic], [gyroscopic, 2.0 * f11 * self.half**2 / speed]]
        stiffness = [[stiff + yaw_stiff * roll**2 + lifts, -2.0 * f22 * sideways], [steers, yaw_stiff + tips]]
        lower = np.hstack([-np.array(stiffness) / mass, -np.array(damping) / mass])
        return np.linalg.eigvals(np.vstack([np.eye(4)[2:], lower]))


@jax.jit
def read(stiffness, speed, spring):
    """Eigenvalues, normal forces, accelerations, power of a wheelset, by numbers that are traced."""
    mechanism, state = Wheelset(stiffness).running(speed, spring)
    here = lx.Solution.of_state(mechanism, state)
    found = lx.linearise(mechanism, state, degrees_of_freedom=7)
    forces = jnp.stack([here.force("left"), here.force("right")])
    return found.eigenvalues, forces, here.joint_acceleration("free"), here.power().forces


def nearest(values, wanted):
    return np.array([values[np.argmin(np.abs(values - each))] for each in wanted])


@pytest.mark.slow
def test_a_wheelset_hunts():
    """Its weight, its motions against textbooks up to what the contact gives, its critical speed, Klingel's."""
    gives = []
    for stiffness in (1e11, 1e13):
        wheelset = Wheelset(stiffness)
        for speed in (20.0, 100.0):
            values, forces, acceleration, power = read(stiffness, speed, SPRING)
            np.testing.assert_allclose(forces, wheelset.normal, rtol=1e-10)
            np.testing.assert_allclose(acceleration, 0.0, atol=1e-9)
            np.testing.assert_allclose(power, 0.0, atol=1e-6)
            wanted = wheelset.textbook(speed)
            wanted = wanted[np.abs(wanted.imag) > 0.0]
            gives.append(np.max(np.abs(nearest(np.asarray(values), wanted) / wanted - 1.0)))
    # It gives in proportion to stiffness^(-2/3).
    assert max(gives[2:]) < 5e-4
    assert np.min(np.divide(gives[:2], gives[2:])) > 10.0
    grows = lambda speed: np.max(wheelset.textbook(speed).real)
    critical = brentq(grows, 40.0, 100.0)
    for share in (0.999, 1.001):
        values = np.asarray(read(1e13, share * critical, SPRING)[0])
        (hunting,) = nearest(values, [wheelset.textbook(share * critical)[0]])
        assert (hunting.real > 0.0) == (share > 1.0)
    # Klingel's wavelength 2 π √(r b / λ), up to λ times the arcs' radius over b.
    values = np.asarray(read(1e13, 0.5, 1e-2)[0])
    (hunting,) = nearest(values, [0.5j * np.sqrt(CONICITY / (wheelset.rolling * wheelset.half))])
    wavelength = 2.0 * np.pi * 0.5 / abs(hunting.imag)
    klingel = 2.0 * np.pi * np.sqrt(wheelset.rolling * wheelset.half / CONICITY)
    np.testing.assert_allclose(wavelength, klingel, rtol=CONICITY * CROWN / HALF)


def test_a_wheelset_that_rolls_without_slip():
    """It steers as Klingel's does: by its displacement over the rails, and goes where it heads."""
    axle, crown = lx.RigidBody("axle", 1000.0, inertia=[600.0, 100.0, 600.0]), 1e-3
    on_rails = [
        lx.WheelOnRail(name, **(side | {"height": lambda y: -(y**2) / (2.0 * crown)}), no_slip=no_slip)
        for name, side, no_slip in zip(("left", "right"), sides(axle), (("along", "across"), ("along",)), strict=True)
    ]
    system = system_of(lx.Mechanism([axle], [lx.Free("flight", lx.GROUND, axle)], constraints=on_rails), float)

    @jax.jit
    def read(q, v):
        configuration = configure(system, 0.0, q)
        gamma = constraint_gamma(move(configuration, v), 1.0)
        return constraint_residual(configuration), constraint_jacobian(configuration), gamma

    sideways, yaw, still = 1e-4, 2e-4, jnp.zeros(6)
    free, at = [0, 5], np.array([0.0, RADIUS])  # the roll, and the height, are those that the rails leave
    place = lambda at: jnp.asarray([*turned(yaw, at[0], 0.0), 0.0, sideways, at[1]])
    scales = np.asarray(system.constraint_scales)[:, None]
    for _ in range(4):
        residual, rows, _ = read(place(at), still)
        at = at - np.linalg.solve(np.asarray(rows)[[0, 3]][:, free], np.asarray(residual)[[0, 3]])
    residual, rows, _ = read(place(at), still)
    np.testing.assert_allclose(residual, 0.0, atol=1e-14)
    motion = np.linalg.svd(np.asarray(rows) * scales)[2][-1]  # the only one that is left
    motion = motion / motion[3]
    over_rails = sideways + RADIUS * at[0]
    half = HALF - crown * CONICITY
    # The axle points along (−ψ, 1, φ), and its spin with it.
    rolls, steers = motion[0] + motion[1] * yaw, motion[2] - motion[1] * at[0]
    np.testing.assert_allclose(steers, -CONICITY * over_rails / (RADIUS * half), rtol=1e-3)
    np.testing.assert_allclose(motion[4] + RADIUS * rolls, yaw, rtol=1e-3)
    np.testing.assert_allclose(motion[1], 1.0 / RADIUS, rtol=1e-3)
    # Rows go on as along the motion: against differences of fourth order.
    q, v, step = place(at), jnp.asarray(5.0 * motion), 1e-4
    along = step * rates(system.topology, q, v)
    rise = lambda steps: (read(q + steps * along, v)[1] - read(q - steps * along, v)[1]) @ v
    fall = (8.0 * rise(1) - rise(2)) / (12.0 * step)
    np.testing.assert_allclose(fall + read(q, v)[2], 0.0, atol=1e-9)


def braked(conicity, longitudinal, crown):
    """A wheel that meets a rail faster than it rolls: how far it gets, and how fast it turns."""
    wheel = lx.RigidBody("wheel", 50.0, inertia=[1.0, 2.0, 1.0])
    plane = lx.Planar("plane", lx.GROUND, wheel, "y")
    contact = lx.WheelRailContact(
        wheel,
        lx.GROUND,
        radius=lambda y: 0.3 + conicity * y,
        height=lambda y: -(y**2) / (2.0 * crown),
        span=[-0.04, 0.04],
        law=lx.ContactLaw(1e7, damping=0.5),
        creep=lx.Creep(longitudinal, 1e4, 0.3, load=500.0),
        name="contact",
    )
    mechanism = lx.Mechanism([wheel], [plane], [GRAVITY, contact])
    placed = {"wheel": lx.Pose([0.0, 0.0, 0.2995], np.eye(3))}
    state = lx.assemble(mechanism, placed, {"wheel": lx.Velocity([3.0, 0.0, 0.0], [0.0, 5.0, 0.0])})
    saves = diffrax.SaveAt(ts=jnp.linspace(0.0, 0.2, 5))
    return lx.simulate(mechanism, state, t1=0.2, accuracy=lx.PRECISE, saveat=saves)


def ends(numbers):
    found = braked(*numbers)
    return jnp.stack([found.position("wheel")[-1, 0], found.angular_velocity("wheel")[-1, 1] / 10.0])


@pytest.mark.slow
def test_derivatives_of_a_motion():
    numbers = jnp.array([0.05, 2e4, 0.1])
    found = braked(*numbers)
    assert found.work()["contact"][-1] < -1.0
    steps = 1e-4 * np.diag(numbers)
    central = [(ends(numbers + step) - ends(numbers - step)) / (2.0 * np.sum(step)) for step in steps]
    central = np.stack(central, axis=1) * numbers
    forwards, backwards = (way(ends)(numbers) * numbers for way in (jax.jacfwd, jax.jacrev))
    scale = np.max(np.abs(central), axis=1, keepdims=True)
    np.testing.assert_allclose(forwards / scale, central / scale, atol=1e-6)
    np.testing.assert_allclose(backwards / scale, forwards / scale, atol=1e-9)
