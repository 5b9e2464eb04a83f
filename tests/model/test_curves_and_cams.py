"""Curves, cams and homokinetic joints against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

GRAVITY = lx.Gravity([0.0, 0.0, -9.81])
ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
LOOP = np.stack([np.cos(ANGLES), 0.6 * np.sin(ANGLES), 0.2 * np.sin(2.0 * ANGLES)], axis=-1)


@pytest.mark.parametrize("closed", [True, False])
def test_a_curve_goes_through_its_points(closed):
    """Smoothly at each, and a closed one at its end; with derivatives by the points."""
    curve = lx.SplineCurve(LOOP, closed=closed)
    u = np.array(curve.parameters[:24])
    derivatives = [curve]
    for _ in range(4):
        derivatives.append(jax.jacfwd(derivatives[-1]))
    found = jax.jit(jax.vmap(lambda u: [derivative(u) for derivative in derivatives]))
    np.testing.assert_allclose(found(u)[0], LOOP, atol=1e-13)
    near = np.resize(u[6:-6] if not closed else u + curve.parameters[-1], 24)
    before, after = (found(near + step) for step in (-1e-9, 1e-9))
    for left, right in zip(before[1:], after[1:], strict=True):
        np.testing.assert_allclose(left, right, atol=1e-5)
    moved = jax.jit(lambda points: lx.SplineCurve(points, closed, curve.parameters)(0.3))
    place, slope = jax.jvp(moved, (LOOP,), (LOOP,))
    np.testing.assert_allclose(slope, place, atol=1e-13)  # it is linear in them


def test_a_bead_on_a_closed_spline():
    """Energy, and Frenet: the reaction across the curve is m (κ s'² n − g across it), along it none."""
    bead = lx.point_mass("bead", 2.0)
    curve = lx.SplineCurve(LOOP, closed=True)
    mechanism = lx.Mechanism([bead], [lx.CurveJoint("wire", lx.GROUND, bead, curve)], [GRAVITY])
    state = lx.assemble(mechanism, {"wire": 0.0}, {"wire": 3.0})
    found = lx.simulate(mechanism, state, t1=3.0, accuracy=lx.PRECISE)
    np.testing.assert_allclose(found.energy(), found.energy()[0], atol=1e-9 * found.energy()[0])
    u, rate = found.joint("wire"), np.asarray(found.joint_speed("wire"))
    assert u[-1] > curve.parameters[-1]  # once around
    slopes = jax.jacfwd(curve), jax.jacfwd(jax.jacfwd(curve))
    first, second = map(np.asarray, jax.jit(jax.vmap(lambda u: [slope(u) for slope in slopes]))(u))
    size = np.linalg.norm(first, axis=1)[:, None]
    tangent = first / size
    across = lambda vectors: vectors - tangent * np.sum(vectors * tangent, axis=1)[:, None]
    bent = across(second) / size**2  # κ n
    speed = size * rate[:, None]
    expected = 2.0 * (bent * speed**2 - across(np.broadcast_to([0.0, 0.0, -9.81], bent.shape)))
    np.testing.assert_allclose(found.reaction("wire").force, expected, atol=1e-7)


@pytest.mark.slow
def test_a_trolley_turns_with_its_rail():
    trolley = lx.RigidBody("trolley", 1.0, inertia=[0.01, 0.02, 0.03])
    joint = lx.CurveJoint("rail", lx.GROUND, trolley, lx.SplineCurve(LOOP, closed=True), follows="tangent")
    mechanism = lx.Mechanism([trolley], [joint], [GRAVITY])
    found = lx.simulate(mechanism, lx.assemble(mechanism, {"rail": 0.0}, {"rail": 2.0}), t1=1.0, accuracy=lx.PRECISE)
    np.testing.assert_allclose(found.energy(), found.energy()[0], atol=1e-8)
    velocity, axes = found.velocity("trolley"), found.orientation("trolley")
    along = velocity / np.linalg.norm(velocity, axis=1)[:, None]
    np.testing.assert_allclose(axes[:, :, 0], along, atol=1e-9)
    np.testing.assert_allclose(axes[:, 2, 2], 0.0, atol=1e-12)  # its z axis stays level, across `up`


def cam_and_follower(profile, speed=20.0, roller_radius=0.0):
    """A cam that turns at constant speed, and a follower on a slide through its axis, with a spring."""
    cam, follower = lx.RigidBody("cam", 1.0, inertia=1e-3), lx.point_mass("follower", 0.5)
    joints = [
        lx.Revolute("shaft", lx.GROUND, cam, "z"),
        lx.Prismatic("guide", lx.GROUND, follower, "x"),
        lx.Cam("contact", cam, follower, profile, roller_radius),
    ]
    motor = lx.Drive("motor", "shaft", speed=speed)
    forces = [lx.JointSpring("guide", 500.0)]
    return lx.Mechanism([cam, follower], joints, forces, [motor])


def cycloidal(angle):
    """A base circle of 40 mm, a cycloidal rise by 20 mm in the first half of a turn, and a return in the second."""
    share = jnp.mod(angle, 2.0 * jnp.pi) / jnp.pi
    rise = share - jnp.sin(2.0 * jnp.pi * share) / (2.0 * jnp.pi)
    return 0.04 + 0.02 * jnp.where(share < 1.0, rise, 2.0 - rise)


def check_lift_and_force(found, angles, speed=20.0):
    """The follower's lift is ρ(−θ), its force m s̈ + k s; the spline misses the law by less than asked."""
    lift = np.asarray(jax.jit(cycloidal)(angles))
    np.testing.assert_allclose(found.q[:, 1], lift, atol=1e-9 * 0.02)
    within = np.mod(angles, 2.0 * np.pi) / np.pi
    bend = 0.02 * 2.0 * np.pi / np.pi**2 * np.sin(2.0 * np.pi * within) * np.where(within < 1.0, 1.0, -1.0)
    force = 0.5 * speed**2 * bend + 500.0 * lift
    np.testing.assert_allclose(found.reaction("contact").force[:, 0], force, rtol=1e-7)


def test_a_cycloidal_cam_in_its_rise():
    mechanism = cam_and_follower(lambda angle: cycloidal(angle + 0.8))
    lift, slope = jax.value_and_grad(cycloidal)(0.8)
    state = lx.State(jnp.array([0.0, lift, 0.0, 0.0]), 20.0 * jnp.array([1.0, -slope, -1.0, -1.0]))
    check_lift_and_force(lx.Solution.of_state(mechanism, state), np.array([0.8]))


@pytest.mark.slow
def test_ten_turns_of_a_cycloidal_cam():
    mechanism = cam_and_follower(cycloidal)
    state = lx.assemble(mechanism, {"contact": [0.0, 0.0]}, guess={"guide": 0.04})
    ts = np.linspace(0.0, 10.0 * 2.0 * np.pi / 20.0, 401)
    found = lx.simulate(mechanism, state, t1=ts[-1], saveat=diffrax.SaveAt(ts=jnp.asarray(ts)))
    check_lift_and_force(found, -20.0 * ts)
    np.testing.assert_allclose(found.joint("contact")[:, 0], -20.0 * ts, atol=1e-9)  # it counts turns


@pytest.mark.slow
def test_a_roller_on_an_eccentric():
    """s = e cos θ + √((R + r)² − e² sin² θ), the profile given as a spline."""
    eccentric, radius, roller = 0.01, 0.04, 0.015
    angles = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)
    profile = eccentric * np.cos(angles) + np.sqrt(radius**2 - (eccentric * np.sin(angles)) ** 2)
    mechanism = cam_and_follower(lx.PeriodicSpline(profile), roller_radius=roller)
    state = lx.assemble(mechanism, {"shaft": 0.0}, guess={"guide": 0.065, "contact": [0.0, 0.0]})
    found = lx.simulate(mechanism, state, t1=0.4)
    theta = 20.0 * np.asarray(found.ts)
    lift = eccentric * np.cos(theta) + np.sqrt((radius + roller) ** 2 - (eccentric * np.sin(theta)) ** 2)
    np.testing.assert_allclose(found.joint("guide"), lift, atol=1e-11)


@pytest.mark.slow
def test_a_homokinetic_joint():
    """Two shafts at an angle turn alike, where a Cardan joint's second one would not."""
    tilt = np.array([[np.cos(0.5), 0.0, np.sin(0.5)], [0.0, 1.0, 0.0], [-np.sin(0.5), 0.0, np.cos(0.5)]])
    shafts = [lx.RigidBody(name, 1.0, inertia=[0.01, 0.01, 0.02]) for name in ("first", "second")]
    joints = [
        lx.Revolute("input", lx.GROUND, shafts[0], "z"),
        lx.Revolute("output", lx.GROUND.at([0.0, 0.0, 0.0], tilt), shafts[1], "z"),
        lx.ConstantVelocity("joint", *shafts, "z"),
    ]
    mechanism = lx.Mechanism(shafts, joints, [lx.JointTorque("input", 0.3)])
    state = lx.assemble(mechanism, {"input": 0.0}, {"input": 5.0}, guess={"joint": [0.0, 0.5]})
    assert lx.mobility(mechanism, state).degrees_of_freedom == 1
    found = lx.simulate(mechanism, state, t1=1.0)
    np.testing.assert_allclose(found.joint("output"), found.joint("input"), atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(found.joint("joint"), axis=1), 0.5, atol=1e-10)
    np.testing.assert_allclose(found.joint("input"), 5.0 * found.ts + 0.15 / 0.04 * found.ts**2, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: lx.SplineCurve(LOOP[:4]), r"points have shape \(4, 3\); give 6 or more"),
        (lambda: lx.SplineCurve(LOOP[[0, 0, 1, 2, 3, 4, 5]]), "must rise from zero, without equal points"),
        (lambda: lx.PeriodicSpline(LOOP), r"values have shape \(24, 3\)"),
        (lambda: jax.jit(lx.SplineCurve)(LOOP), "give their parameters too"),
        (lambda: lx.CurveJoint("wire", lx.GROUND, lx.point_mass("bead", 1.0), LOOP), "joint 'wire': curve is"),
        (lambda: lx.Cam("cam", lx.GROUND, lx.point_mass("bead", 1.0), jnp.sin, -1.0), r"roller_radius \[m\] is -1.0"),
    ],
)
def test_mistakes(make, told):
    with pytest.raises(ValueError, match=told):
        make()
