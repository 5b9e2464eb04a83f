"""Constraints on speeds, against closed forms: Chaplygin's sleigh, rolling discs, a ball on a turntable."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import rolling_disc, sleigh, steady_spin

import linkax as lx

GRAVITY = lx.Gravity([0.0, 0.0, -9.81])
TS = np.linspace(0.0, 2.0, 21)
SAVES = diffrax.SaveAt(ts=jnp.asarray(TS))


def run(mechanism, state, accuracy=lx.PRECISE):
    return lx.simulate(mechanism, state, t1=2.0, accuracy=accuracy, saveat=SAVES)


def test_chaplygins_sleigh():
    """A skate takes one degree of freedom from speeds alone; u along the edge goes as tanh, ω as sech."""
    apart, mass, inertia = 0.2, 2.0, 0.3
    mechanism, state = sleigh(jnp.array(apart))
    found = lx.mobility(mechanism, state)
    assert (found.degrees_of_freedom, found.rows) == (2, (("edge", "slip"),))
    solution = run(mechanism, state)
    about_edge = inertia + mass * apart**2
    # u̇ = a ω² and ω̇ = −(m a / I) u ω keep m u² + I ω²; so u = U tanh(k t + b), ω = U √(m / I) sech(k t + b).
    fastest = np.sqrt(0.25 + about_edge / mass * 4.0)
    begin, pace = np.arctanh(0.5 / fastest), mass * apart / about_edge * fastest
    u, omega = fastest * np.tanh(begin + pace * TS), fastest * np.sqrt(mass / about_edge) / np.cosh(begin + pace * TS)
    turn, (speed, x, y) = np.asarray(solution.q[:, 0]), np.asarray(solution.v).T
    np.testing.assert_allclose(speed, omega, atol=1e-9)
    np.testing.assert_allclose(x * np.cos(turn) + y * np.sin(turn), u, atol=1e-9)
    np.testing.assert_allclose(y * np.cos(turn) - x * np.sin(turn), 0.0, atol=1e-12)
    np.testing.assert_allclose(solution.energy(), solution.energy()[0], rtol=1e-10)
    # Across: m (u ω + a ω̇) of the centre of mass.
    across = mass * (u * omega - apart * mass * apart / about_edge * u * omega)
    np.testing.assert_allclose(solution.reaction("edge"), across, atol=1e-8)


@pytest.mark.slow
def test_a_disc_rolls_steadily():
    """The tilt stays, and the centre goes around in a circle."""
    tilt, turning = 0.35, 1.8
    mechanism, state = rolling_disc(tilt, turning, steady_spin(tilt, turning))
    assert lx.mobility(mechanism, state).degrees_of_freedom == 3
    solution = run(mechanism, state)
    np.testing.assert_allclose(solution.position("disc")[:, 2], 0.4 * np.cos(tilt), atol=1e-8)
    upwards = solution.angular_velocity("disc")[:, 2]
    np.testing.assert_allclose(upwards, upwards[0], atol=1e-8)
    np.testing.assert_allclose(solution.energy(), solution.energy()[0], rtol=1e-9)
    np.testing.assert_allclose(solution.reaction("rolling")[:, 0], 1.5 * 9.81, atol=1e-7)
    assert solution.worst_violation().position < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_disc_rolls_upright_from_a_speed_on(share):
    """Upright it is stable where ω² > A m g r / (C (C + m r²)), of a uniform thin disc g / (3 r)."""
    spin = share * np.sqrt(9.81 / (3.0 * 0.4))
    mechanism, state = rolling_disc(1e-5, 0.0, spin)
    found = lx.simulate(mechanism, state, t1=6.0)
    lean = np.abs(1.0 - 2.0 * np.sum(np.asarray(found.q)[:, 1:3] ** 2, axis=1))  # of a quaternion: what z has of z
    assert (np.max(lean) > 1e-3) == (share < 1.0)


def turntable(speed):
    """A ball on a table that turns: its path is a circle, run through at 2/7 of the table's rate."""
    table, ball = lx.RigidBody("table", 5.0, inertia=1.0), lx.RigidBody("ball", 0.5, inertia=3 * [0.4 * 0.5 * 0.01])
    joints = [lx.Revolute("pivot", lx.GROUND, table, "z"), lx.Free("flight", lx.GROUND, ball)]
    rolling = lx.RollingSphere("rolling", ball, table, 0.1)
    mechanism = lx.Mechanism([table, ball], joints, [GRAVITY], [rolling, lx.Drive("motor", "pivot", speed=speed)])
    speeds = {"ball": lx.Velocity([0.3, 0.1, 0.0]), ("flight", 2): 0.0}
    return mechanism, lx.assemble(mechanism, {"ball": lx.Pose([1.0, 0.0, 0.1], np.eye(3))}, speeds)


@pytest.mark.slow
def test_a_ball_on_a_turntable():
    mechanism, state = turntable(jnp.array(4.0))
    found = run(mechanism, state)
    rate = 2.0 / 7.0 * 4.0
    begin, velocity = np.array([1.0, 0.0]), np.array([0.3, 0.1])
    centre = begin - np.array([velocity[1], -velocity[0]]) / rate  # v = rate z × (r − centre)
    arm, c, s = begin - centre, np.cos(rate * TS), np.sin(rate * TS)
    path = centre + np.stack([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]], axis=-1)
    np.testing.assert_allclose(found.position("ball")[:, :2], path, atol=1e-8)


def glided(apart):
    mechanism, state = sleigh(apart)
    return run(mechanism, state).q[-1, 1]


@pytest.mark.slow
def test_derivatives():
    at, step = 0.2, 1e-5
    central = (glided(jnp.array(at + step)) - glided(jnp.array(at - step))) / (2.0 * step)
    np.testing.assert_allclose([jax.grad(glided)(at), jax.jacfwd(glided)(at)], central, rtol=1e-6)


def test_what_holds_speeds_alone_is_not_traced():
    mechanism, state = sleigh(jnp.array(0.2))
    with pytest.raises(ValueError, match="skate 'edge' holds speeds, and no places"):
        lx.trace(mechanism, state, along={("ice", 0): np.linspace(0.0, 1.0, 3)})
