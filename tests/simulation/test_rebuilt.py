"""Mechanisms built again and again, with functions in them that are made anew each time."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from mechanisms import pendulum

import linkax as lx

HINGE = ("hinge", lx.GROUND)


def turned(numbers):
    """Angle of a rotor of inertia one after a second, by functions of these numbers."""
    rotor = lx.RigidBody("rotor", 1.0, [0.0, 0.0, 0.0], jnp.ones(3))
    torque, moment, force = numbers
    forces = [
        lx.JointTorque("hinge", lambda t, motion: torque * t),
        lx.PointMoment(rotor, lambda t, motion: jnp.array([0.0, 0.0, moment])),
        lx.PointForce(rotor.at([1.0, 0.0, 0.0]), lambda t, motion: jnp.array([0.0, force, 0.0]), axes="frame"),
    ]
    mechanism = lx.Mechanism([rotor], [lx.Revolute(*HINGE, rotor, "z")], forces)
    event = diffrax.Event(lambda t, state, mechanism: state.q[0] - 100.0 * torque)
    saveat = diffrax.SaveAt(t1=True, fn=lambda t, state, mechanism: state.q[0])
    start = lx.State(jnp.zeros(1), jnp.zeros(1))
    found = lx.simulate(mechanism, start, t1=1.0, saveat=saveat, event=event)
    return found.ys[-1]


def moved(numbers):
    """Coordinates and speeds of a driven arm and of a load on a winch, at 0.1 s, by functions of these numbers."""
    arm, load = lx.rod("arm", 1.0, 1.0), lx.point_mass("load", 1.0)
    joints = [lx.Revolute(*HINGE, arm.at("base"), "z"), lx.Prismatic("lift", lx.GROUND, load, "y")]
    constraints = [
        lx.Drive("motor", "hinge", lambda t: numbers[0] * jnp.sin(numbers[1] * t)),
        lx.Rope("winch", [lx.GROUND.at([0.0, 4.0, 0.0]), load], lambda t: 4.0 - numbers[2] * t**2),
    ]
    mechanism = lx.Mechanism([arm, load], joints, constraints=constraints)
    state = lx.assemble(mechanism, t=0.1)
    return jnp.concatenate([state.q, state.v])


NUMBERS, HALVES = jnp.array([0.7, 3.0, 2.0]), jnp.array([0.35, 1.5, 1.0])
EXACT = {
    turned: lambda numbers: numbers[0] / 6.0 + numbers[1] / 2.0 + numbers[2] / 2.0,
    moved: lambda numbers: jnp.stack(
        [
            numbers[0] * jnp.sin(0.1 * numbers[1]),
            0.01 * numbers[2],
            numbers[0] * numbers[1] * jnp.cos(0.1 * numbers[1]),
            0.2 * numbers[2],
        ]
    ),
}


@pytest.mark.parametrize("of", EXACT, ids=lambda of: of.__name__)
def test_functions_made_anew_compile_nothing(of):
    with compilations() as begun:
        first = of(NUMBERS)
    with compilations() as compiled:
        again, other = of(NUMBERS), of(HALVES)
    assert begun
    assert not compiled
    np.testing.assert_array_equal(again, first)
    for found, numbers in ((first, NUMBERS), (other, HALVES)):
        np.testing.assert_allclose(found, EXACT[of](numbers), rtol=1e-7)


@pytest.mark.slow
def test_derivatives_by_an_array_that_drives_close_over():
    found, step = jax.jit(jax.jacfwd(moved))(NUMBERS), 1e-5
    np.testing.assert_allclose(found, jax.jacfwd(EXACT[moved])(NUMBERS), atol=1e-12)
    differences = [(moved(NUMBERS + along) - moved(NUMBERS - along)) / (2.0 * step) for along in step * jnp.eye(3)]
    np.testing.assert_allclose(found, np.stack(differences, axis=1), atol=1e-8)


def cruised(speed, start):
    """Angle and speed after half a second of an arm that turns at constant speed."""
    mechanism = pendulum(gravity=0.0, constraints=[lx.Drive("motor", "hinge", speed=speed, start=start)])
    found = lx.simulate(mechanism, lx.assemble(mechanism), t1=0.5, saveat=diffrax.SaveAt(t1=True))
    return jnp.array([found.q[-1, 0], found.v[-1, 0]])


def test_another_constant_speed_compiles_nothing():
    first = cruised(6.0, 0.3)
    with compilations() as compiled:
        other = cruised(-2.0, 1.5)
    assert not compiled
    np.testing.assert_allclose(first, [3.3, 6.0], rtol=1e-13)
    np.testing.assert_allclose(other, [0.5, -2.0], rtol=1e-13)


@pytest.mark.slow
def test_derivatives_by_a_constant_speed():
    by_speed, by_start = jax.jit(jax.jacfwd(cruised, (0, 1)))(6.0, 0.3)
    np.testing.assert_allclose([by_speed, by_start], [[0.5, 1.0], [1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("moves", [True, False])
def test_a_drive_at_constant_speed_goes_on_or_is_held(moves):
    drive = lx.Drive("motor", "hinge", speed=6.0, start=0.3)
    held = drive.held(0.2, jnp.asarray(moves))
    at_zero = drive.attached({}, {"hinge": jnp.zeros(1)}, ())
    np.testing.assert_allclose(held.residual(1.0, at_zero), -6.3 if moves else -1.5, rtol=1e-15)
    np.testing.assert_allclose(drive.held(0.2).residual(1.0, at_zero), -1.5, rtol=1e-15)


def test_a_mechanism_whose_functions_have_changed_is_refused():
    speeds = {"motor": 2.0}
    build = lambda: pendulum(constraints=[lx.Drive("motor", "hinge", lambda t: speeds["motor"] * t)])
    mechanism, now = build(), lambda mechanism: mechanism.constraints[0].right_side(0.5)
    assert now(mechanism) == 1.0
    speeds["motor"] = 3.0
    run = lambda mechanism: lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0)
    for use in (now, lx.assemble, run):
        with pytest.raises(ValueError, match=r"drive 'motor': what its function reads \(speeds\) has changed .* anew"):
            use(mechanism)
    assert now(build()) == 1.5
