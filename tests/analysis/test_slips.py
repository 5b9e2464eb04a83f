"""Small motions about steady motions with slips, against closed forms: a sleigh, discs that roll, Whipple's bicycle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import rolling_disc, sleigh, steady_spin
from scipy import interpolate
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.equations.coordinates import retract
from linkax.equations.system import system_of
from linkax.spatial.quaternions import rotation_matrix

G = 9.81


def nearest(found, wanted):
    """By how much each wanted number is missed."""
    return np.min(np.abs(np.asarray(found)[..., :, None] - np.asarray(wanted)[..., None, :]), axis=-2)


@jax.jit
@jax.vmap
def _slides(speed):
    mechanism, _ = sleigh(jnp.array(0.2))
    return lx.linearise(mechanism, lx.State(jnp.zeros(3), jnp.array([0.0, 1.0, 0.0]) * speed), degrees_of_freedom=2)


@pytest.mark.slow
def test_a_sleigh_that_slides():
    """Its turning decays at m a v / (I + m a²), and grows backwards; to stand still is steady, too."""
    speeds = np.array([-3.0, -1.0, 0.0, 0.5, 2.0])
    found = _slides(speeds)
    exact = -2.0 * 0.2 * speeds / (0.3 + 2.0 * 0.2**2)
    assert found.eigenvalues.shape == (5, 5)  # 2 speeds, 3 displacements
    np.testing.assert_allclose(np.sum(found.eigenvalues, axis=1), exact, atol=1e-12)
    np.testing.assert_allclose(nearest(found.eigenvalues, exact[:, None])[:, 0], 0.0, atol=1e-12)
    slope = jax.grad(lambda speed: jnp.min(_slides(speed[None]).eigenvalues.real))(1.0)
    np.testing.assert_allclose(slope, -2.0 * 0.2 / (0.3 + 2.0 * 0.2**2), rtol=1e-9)


@pytest.mark.slow
def test_slips_that_others_imply():
    """A second skate in line with the first one changes nothing, but for a zero."""
    mechanism, state = sleigh(jnp.array(0.2))
    (plate,), edges = mechanism.bodies, [*mechanism.constraints, lx.Skate("again", mechanism.bodies[0], lx.GROUND)]
    again = lx.Mechanism([plate], mechanism.joints, constraints=edges)
    found = lx.linearise(again, lx.State(state.q, jnp.array([0.0, 1.0, 0.0])))
    assert found.eigenvalues.shape == (6,)
    np.testing.assert_allclose(np.min(found.eigenvalues.real), -2.0 * 0.2 / (0.3 + 2.0 * 0.2**2), rtol=1e-12)


def reduced(state, mass, radius):
    """Rates of tilt, its rate, the rates about the disc's upper radius and its axis, of a thin disc that rolls.

    Moments about the point that touches, in axes (along the track, up the disc, its axis) that follow the tilt.
    """
    tilt, fall, steer, spin = state
    axial, across = mass * radius**2 / 2.0, mass * radius**2 / 4.0
    inertia, up = jnp.array([across, across, axial]), jnp.array([0.0, 1.0, 0.0]) * radius
    turns = jnp.array([fall, steer, -steer * jnp.tan(tilt)])  # of the axes
    vertical = jnp.array([0.0, jnp.cos(tilt), -jnp.sin(tilt)])
    omega = jnp.array([fall, steer, spin])

    def moment(change):
        velocity = jnp.cross(change, up) + jnp.cross(turns, jnp.cross(omega, up))
        momentum = inertia * change + jnp.cross(turns, inertia * omega)
        return momentum + jnp.cross(up, mass * (velocity + G * vertical))

    still = jnp.zeros(3)
    return jnp.concatenate([jnp.array([fall]), -jnp.linalg.solve(jax.jacfwd(moment)(still), moment(still))])


@jax.jit
@jax.vmap
def _rolls(tilt, turning, spin):
    mechanism, state = rolling_disc(tilt, turning, spin)
    given = jax.tree.map(lambda array: array.astype(tilt.dtype), state)
    return lx.linearise(mechanism, given, degrees_of_freedom=3).eigenvalues


@pytest.mark.slow
def test_discs_that_roll_upright_and_in_circles():
    """Upright λ² = (4 g / r − 12 ω²) / 5 of a uniform thin disc, unstable below ω² = g / (3 r): Routh, Advanced
    Rigid Dynamics, art. 244; leaning as the reduced equations of motion say.
    """
    mass, radius, turning = 1.5, 0.4, 1.8
    tilts, rates = np.array([0.0, 0.0, 0.35, 0.7, 0.2]), np.array([0.0, 0.0, turning, turning, 0.3])
    critical = np.sqrt(G / (3.0 * radius))
    spins = np.array(
        [0.9 * critical, 1.1 * critical, *(steady_spin(*each) for each in zip(tilts[2:], rates[2:], strict=True))]
    )
    found = _rolls(tilts, rates, spins)
    squares = (4.0 * G / radius - 12.0 * spins[:2] ** 2) / 5.0
    upright = np.sqrt(squares.astype(complex))[:, None] * [1.0, -1.0]
    np.testing.assert_allclose(nearest(found[:2], upright), 0.0, atol=1e-8)
    for tilt, rate, spin, each in zip(tilts[2:], rates[2:], spins[2:], found[2:], strict=True):
        state = np.array([-tilt, 0.0, rate * np.cos(tilt), spin + rate * np.sin(tilt)])
        np.testing.assert_allclose(reduced(state, mass, radius), 0.0, atol=1e-10)
        values = np.linalg.eigvals(jax.jacfwd(reduced)(state, mass, radius))
        pair = values[np.argsort(np.abs(values))[2:]]
        np.testing.assert_allclose(nearest(each, pair), 0.0, atol=1e-8)
    single = _rolls(*(values.astype(np.float32) for values in (tilts, rates, spins)))
    steady = np.abs(found) > 0.1
    np.testing.assert_allclose(
        nearest(single, np.where(steady, found, 0.0))[steady], 0.0, atol=1e-3 * np.max(np.abs(spins))
    )


@pytest.mark.slow
def test_a_disc_on_slides_and_in_gimbals():
    """It rolls in a circle as one whose joint is free does."""
    tilt, turning = 0.35, 1.8
    spin = steady_spin(tilt, turning)
    free, state = rolling_disc(tilt, turning, spin)
    (disc,) = free.bodies
    kinds = [lx.Prismatic, lx.Prismatic, lx.Prismatic, lx.Revolute, lx.Revolute, lx.Revolute]
    rings = [lx.RigidBody(f"ring {index}", 0.0, inertia=[0.0, 0.0, 0.0]) for index in range(5)]
    pairs = zip(kinds, [lx.GROUND, *rings], [*rings, disc], "xyzzyz", strict=True)
    joints = [kind(f"to {child.name}", parent, child, axis) for kind, parent, child, axis in pairs]
    gimballed = lx.Mechanism([*rings, disc], joints, free.forces, free.constraints)
    place = np.array([*state.q[4:], 0.0, tilt - np.pi / 2.0, 0.0])
    found = lx.linearise(gimballed, lx.State(place, np.array([*state.v[3:], turning, 0.0, spin]))).eigenvalues
    exact = [*lx.linearise(free, state).eigenvalues]
    assert np.sum(np.abs(found) < 1e-4) == 4
    np.testing.assert_allclose(nearest(found, [each for each in exact if abs(each) > 1e-4]), 0.0, atol=1e-8)


@pytest.mark.slow
def test_what_does_not_roll_steadily_is_refused():
    tilt, turning = 0.35, 1.8
    mechanism, state = rolling_disc(tilt, turning, 1.1 * steady_spin(tilt, turning))
    with pytest.raises(ValueError, match="joint 'flight' accelerates"):
        lx.linearise(mechanism, state)


AXLE = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # of a wheel, z to the right


def bicycle():
    """Whipple's, with the numbers of Meijaard, Papadopoulos, Ruina and Schwab, Proc. R. Soc. A 463 (2007), table 1."""
    rear = lx.RigidBody("rear", 2.0, inertia=[0.0603, 0.12, 0.0603])
    front = lx.RigidBody("front", 3.0, inertia=[0.1405, 0.28, 0.1405])
    frame = lx.RigidBody("frame", 85.0, [0.3, 0, 0.9], [[9.2, 0, -2.4], [0, 11.0, 0], [-2.4, 0, 2.8]])
    fork = lx.RigidBody("fork", 4.0, [0.9, 0, 0.7], [[0.05892, 0, 0.00756], [0, 0.06, 0], [0.00756, 0, 0.00708]])
    tilt = np.pi / 10.0
    axis = np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    head = np.array([1.1, 0.0, 0.0]) + 0.9 * axis  # any point of it
    joints = [
        lx.Free("pose", lx.GROUND, frame),
        lx.Revolute("rear_axle", frame.at([0, 0, 0.3]), rear, axis="y"),
        lx.Revolute("steer", frame.at(head), fork.at(head), axis=axis),
        lx.Revolute("front_axle", fork.at([1.02, 0, 0.35]), front, axis="y"),
    ]
    rolls = [
        lx.RollingDisc("rear_rolls", rear.at([0, 0, 0], rotation=AXLE), lx.GROUND, 0.3),
        lx.RollingDisc("front_rolls", front.at([0, 0, 0], rotation=AXLE), lx.GROUND, 0.35),
    ]
    return lx.Mechanism([rear, front, frame, fork], joints, [lx.Gravity([0, 0, -G])], rolls)


# M q̈ + v C q̇ + (g K₀ + v² K₂) q = 0 of lean and steer, as the paper gives them.
MASS = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
BY_SPEED = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])
BY_WEIGHT = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
BY_SQUARE = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])


def lean_and_steer(speed):
    stiffness, damping = G * BY_WEIGHT + speed**2 * BY_SQUARE, speed * BY_SPEED
    lower = -np.linalg.solve(MASS, np.hstack([stiffness, damping]))
    return np.linalg.eigvals(np.vstack([np.eye(4)[2:], lower]))


@pytest.mark.slow
def test_a_bicycle_that_rolls():
    """At all speeds; where it gets stable, and falls over slowly, found by derivatives."""
    mechanism = bicycle()
    start = {"frame": lx.Pose([0.0, 0.0, 0.0], np.eye(3)), "steer": 0.0}
    state = lx.assemble(mechanism, start, {"frame": lx.Velocity([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]), "steer": 0.0})

    def values(speed):
        return lx.linearise(mechanism, lx.State(state.q, speed * state.v), degrees_of_freedom=3).eigenvalues

    with_slopes = jax.jit(jax.vmap(lambda speed: jax.jvp(values, (speed,), (jnp.ones(()),))))
    speeds = np.linspace(0.0, 10.0, 11)
    found, _ = map(np.asarray, with_slopes(speeds))
    assert found.shape == (11, 10)  # 3 speeds, 7 displacements
    # Where it stands, along the ground, and the angle of a wheel: zero, whatever rounding is.
    assert np.all(np.sum(found[1:] == 0.0, axis=1) == 6)
    np.testing.assert_allclose(nearest(found, [lean_and_steer(speed) for speed in speeds]), 0.0, atol=1e-10)
    known = [-14.07838969279822, -0.32286642900409, -0.77534188219585 + 4.46486771378823j]
    np.testing.assert_allclose(nearest(found[5], known), 0.0, atol=1e-8)

    def near(speeds, wanted):
        """The wanted eigenvalue at each speed, and its slope."""
        every = np.resize(speeds, 11)
        pairs = zip(every, *map(np.asarray, with_slopes(every)), strict=True)
        chosen = [
            (each[place := np.argmin(np.abs(each - wanted(speed)))], slopes[place]) for speed, each, slopes in pairs
        ]
        return np.array(chosen).real[: len(speeds)].T

    weave = lambda speed: max(lean_and_steer(speed), key=np.imag)
    speed = 4.5
    for _ in range(5):
        (value,), (slope,) = near(np.array([speed]), weave)
        speed -= value / slope
    np.testing.assert_allclose(speed, 4.29238253634111, atol=1e-8)
    # Where it falls over slowly, its eigenvalue meets those of its place, which have no derivatives: from beside it.
    capsize = lambda speed: max(lean_and_steer(speed)[np.abs(lean_and_steer(speed).imag) < 1e-9], key=np.real)
    beside = np.array([5.75, 5.8, 5.85, 5.9, 6.15, 6.2, 6.25, 6.3])
    value, slope = near(beside, capsize)
    inverse = interpolate.KroghInterpolator(np.repeat(value, 2), np.stack([beside, 1.0 / slope], axis=1).ravel())
    np.testing.assert_allclose(inverse(0.0), 6.02426201538837, atol=1e-8)


@jax.jit
def moving_bicycle(q, v):
    """What turns about the vertical, shifts and the wheels' angles do not change, and its rates; slopes of both.

    That is the axle's slope, the steering angle, the rates of both, and that of the rear wheel. And accelerations.
    """
    mechanism = bicycle()
    method, system = lx.TangentSpace().prepared(float), system_of(mechanism, float)

    def at(change):
        place, speed = jnp.split(change, 2)
        on_ground = retract(mechanism.topology, q, place)
        moved, acceleration, on_ground, _ = method.derivative(system, jnp.zeros(()), on_ground, v + speed, True)
        axle = rotation_matrix(on_ground[:4])[:, 1]
        turns = jnp.cross(moved[:3], axle)
        tips = (jnp.cross(acceleration[:3], axle) + jnp.cross(moved[:3], turns))[2]
        rates = jnp.stack([turns[2], moved[7]]), jnp.stack([tips, *acceleration[jnp.array([7, 6])]])
        reduced = jnp.stack([axle[2], on_ground[8]]), rates[0], moved[6:7]
        return (jnp.concatenate(reduced), jnp.concatenate(rates)), (on_ground, moved, acceleration)

    still = jnp.zeros(2 * len(v))
    slopes, _ = jax.jacfwd(at, has_aux=True)(still)
    return *at(still), slopes


@pytest.mark.slow
def test_accelerations_of_a_bicycle_anywhere():
    """Basu-Mandal, Chatterjee and Papadopoulos, Proc. R. Soc. A 463 (2007), table 1, by two sets of equations.

    The frame is turned by angles θ, ψ and φ about z, x and z, which is the axle; straight, it heads along −x.
    """
    psi, phi, steer, height = 0.9501292851472, 3.1257073014894, 0.2311385135743, 0.2440472102925
    velocity = np.array([-2.8069345714545, -0.1480982396001, 0.1058778746261])
    rates = np.array([0.7830033527065, 0.6068425835418, -0.0119185528069])
    of_joints = [8.9129896614890, 0.4859824687093, 8.0133620584155]  # rear wheel, steering, front wheel
    turned = Rotation.from_euler("ZXZ", [0.0, psi, phi]).as_matrix()
    frame = turned @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    lines = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], turned[:, 2]])  # the axes of the angles
    omega, down = rates @ lines, frame @ [0.0, 0.0, -0.3]
    turn = Rotation.from_matrix(frame).as_quat(scalar_first=True)
    q = np.array([*turn, *(down + np.array([0.0, 0.0, height])), 0.0, steer, 0.0])
    v = np.array([*omega, *(velocity + np.cross(omega, down)), *of_joints])
    _, (_, moved, found), _ = moving_bicycle(q, v)
    np.testing.assert_allclose(moved, v, atol=1e-11)
    np.testing.assert_allclose(found[6:], [1.8472554144217, -4.6198904039403, 2.4548072904550], atol=1e-10)
    second = np.array([0.8353281706379, -7.8555281128244, 0.1205543897884])
    carried = np.cross(rates[0] * lines[0], rates[1] * lines[1]) + np.cross(rates[:2] @ lines[:2], rates[2] * lines[2])
    np.testing.assert_allclose(found[:3], second @ lines + carried, atol=1e-10)
    of_axle = found[3:6] - np.cross(found[:3], down) - np.cross(omega, np.cross(omega, down))
    np.testing.assert_allclose(of_axle, [-0.5041626315047, -0.3449706619454, -1.4604528332980], atol=1e-10)


@pytest.mark.slow
def test_a_bicycle_that_turns():
    """Hands-free in circles, as its accelerations say, reduced along the symmetry; wherever it is, and heads to.

    Place and heading turn with it: a place has ±i Ω. Zeros are of the heading, the wheels, and another circle.
    """
    mechanism, speed = bicycle(), 5.9
    q, v = np.eye(10)[0], np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0, speed / 0.3, 0.0, speed / 0.35])
    for slope in (0.05, 0.2, 0.4):
        for _ in range(12):
            (reduced, rates), (q, v, _), slopes = moving_bicycle(q, v)
            off = np.array([reduced[0] - slope, *rates[:4]])
            step = np.linalg.lstsq(np.concatenate([slopes[0][:1], slopes[1][:4]]), -off, rcond=1e-10)[0]
            q, v = retract(mechanism.topology, q, step[:9]), v + step[9:]
        np.testing.assert_allclose(off, 0.0, atol=1e-11)
        matrix = slopes[1] @ np.linalg.pinv(slopes[0], rcond=1e-9)
        np.testing.assert_allclose(matrix @ slopes[0], slopes[1], atol=1e-9)  # nothing else matters
        exact = np.append(np.linalg.eigvals(matrix), [1j * v[2], -1j * v[2]])
        found = lx.linearise(mechanism, lx.State(q, v)).eigenvalues
        assert found.shape == (10,)
        assert np.sum(np.abs(found) < 1e-4) == 4
        np.testing.assert_allclose(nearest(found, exact), 0.0, atol=1e-7)
        heading = Rotation.from_euler("z", 2.0)
        turn = (heading * Rotation.from_quat(q[:4], scalar_first=True)).as_quat(scalar_first=True)
        place, *twist = heading.apply(np.array([q[4:7], v[:3], v[3:6]]))
        place = place + np.array([30.0, -20.0, 0.0])
        there = lx.State(np.concatenate([turn, place, q[7:]]), np.concatenate([*twist, v[6:]]))
        np.testing.assert_allclose(nearest(lx.linearise(mechanism, there).eigenvalues, exact), 0.0, atol=1e-7)
