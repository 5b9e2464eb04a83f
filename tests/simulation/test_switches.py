"""Runs and their derivatives where force elements switch: ropes that go taut and slack, forces that jump."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx

G = 9.81
SAVE_END = diffrax.SaveAt(t1=True)
# Length that falls free [m], stiffness [N/m], damping [N s/m], mass [kg]; of the first and last forces jump.
BUNGEES = np.array([[0.5, 60.0, 1.0, 1.3], [0.3, 90.0, 0.0, 0.7], [0.8, 4e4, 50.0, 2.0]])
T1 = 1.0


def bungee(numbers):
    """A weight on an elastic rope; two bodies on rails, and a joint that closes the loop."""
    falls, stiffness, damping, mass = numbers
    one, other = lx.point_mass("one", 0.3 * mass), lx.point_mass("other", 0.7 * mass)
    rails = [
        lx.Prismatic("rail", lx.GROUND, one, "y"),
        lx.Prismatic("second", lx.GROUND.at([1.0, 0.0, 0.0]), other, "y"),
        lx.Fixed("bar", one.at([1.0, 0.0, 0.0]), other),
    ]
    rope = lx.ElasticRope([lx.GROUND.at([0.0, 1.0, 0.0]), one], stiffness, 1.0 + falls, damping)
    return lx.Mechanism([one, other], rails, [lx.Gravity([0.0, -G, 0.0]), rope])


def bungee_end(numbers, rtol, **options):
    """Height and speed at the end."""
    mechanism = bungee(numbers)
    accuracy = lx.Accuracy(rtol=rtol)
    start = lx.State(jnp.zeros(2), jnp.zeros(2))
    end = lx.simulate(mechanism, start, t1=T1, accuracy=accuracy, saveat=SAVE_END, **options).end
    return jnp.stack([end.q[0], end.v[0]])


def bungee_exact(numbers):
    """The same in closed form: falls free, swings, and flies up from where the rope goes slack."""
    falls, stiffness, damping, mass = numbers
    taut, decay, rest = np.sqrt(2.0 * falls / G), damping / (2.0 * mass), mass * G / stiffness
    rate = -decay + 1j * np.sqrt(stiffness / mass - decay**2)
    swing = -rest + 1j * (decay * rest - G * taut) / rate.imag
    # Stretch and pull are what they are at rest, and the real part of this.
    slack, turn = np.pi / rate.imag, lambda t: swing * np.exp(rate * t)
    for _ in range(20):
        pull = (stiffness + damping * rate) * turn(slack)
        slack = slack - (mass * G + pull.real) / (rate * pull).real
    stretch, speed = rest + turn(slack).real, (rate * turn(slack)).real
    flies = T1 - taut - slack
    assert 0.0 < flies < -1.9 * speed / G
    return -np.array([falls + stretch + speed * flies + G * flies**2 / 2.0, speed + G * flies])


def bungee_slopes(numbers):
    """Derivatives of the closed form, by differences of fourth order."""
    steps = 1e-3 * np.diag(np.maximum(numbers, 0.5))
    value = lambda step, factor: bungee_exact(numbers + factor * step)
    rise = lambda step, factor: value(step, factor) - value(step, -factor)
    return np.stack([(8.0 * rise(step, 1.0) - rise(step, 2.0)) / (12.0 * np.max(step)) for step in steps], axis=1)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def bungees(numbers, rtol):
    """Ends of bungees, and their derivatives forwards and backwards."""
    end, forwards = jax.linearize(lambda numbers: bungee_end(numbers, rtol), numbers)
    backwards = jax.vmap(lambda weights: jax.linear_transpose(forwards, numbers)(weights)[0])(jnp.eye(2))
    return end, jax.vmap(forwards, out_axes=1)(jnp.eye(4)), backwards


@pytest.mark.slow
@pytest.mark.parametrize("rtol", [1e-4, 1e-8, 1e-12])
def test_ropes_that_go_taut_and_slack(rtol):
    """Ends and derivatives in both modes, in a batch, within the tolerance of the closed form."""
    ends, forwards, backwards = map(np.asarray, bungees(BUNGEES, rtol))
    for numbers, end, forward, backward in zip(BUNGEES, ends, forwards, backwards, strict=True):
        exact, slopes = bungee_exact(numbers), bungee_slopes(numbers)
        scales = np.maximum(numbers, 0.5)  # of changes
        size = np.max(np.abs(slopes * scales))
        assert np.max(np.abs(end - exact)) <= 30.0 * rtol * np.max(np.abs(exact))
        assert np.max(np.abs(forward - slopes) * scales) <= max(100.0 * rtol, 1e-9) * size
        np.testing.assert_allclose(backward * scales, forward * scales, rtol=1e-9, atol=1e-11 * size)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Dopri8(), diffrax.Kvaerno5()], ids=["Dopri8", "Kvaerno5"])
def test_adjoints_of_diffrax(solver):
    options = {"solver": solver, "adjoint": diffrax.RecursiveCheckpointAdjoint()}
    found = jax.jacrev(lambda numbers: bungee_end(numbers, 1e-9, **options))(jnp.asarray(BUNGEES[0]))
    np.testing.assert_allclose(found, bungee_slopes(BUNGEES[0]), rtol=1e-5, atol=1e-6)


class Friction(lx.AbstractForce):
    """Dry friction on a slide that does not come to rest: it jumps."""

    force: jax.Array

    def switch(self, t, motion):
        return motion.joint_speed("slide")

    def load(self, t, motion, on):
        return lx.Load.none(motion.system)._replace(joint_force=jnp.where(on, -self.force, self.force)[None])


@jax.jit
def swing(numbers, rtol):
    """Where a weight ends that slides with friction between two ropes, and the derivative along the numbers."""

    def end(numbers):
        left, right, friction, start = numbers
        weight, ends = lx.point_mass("weight", 1.0), [lx.GROUND.at([x, 0.0, 0.0]) for x in (-3.0, 3.0)]
        ropes = [lx.ElasticRope([end, weight], k, 3.0) for end, k in zip(ends, (left, right), strict=True)]
        mechanism = lx.Mechanism(
            [weight], [lx.Prismatic("slide", lx.GROUND, weight, "x")], [*ropes, Friction(friction)]
        )
        accuracy, state = lx.Accuracy(rtol=rtol), lx.State(start[None], jnp.zeros(1))
        return lx.simulate(mechanism, state, t1=1.0, accuracy=accuracy, saveat=SAVE_END).end.q[0]

    return jax.jvp(end, (numbers,), (numbers,))


@pytest.mark.slow
def test_orders_and_derivatives_across_kinks_and_jumps():
    """Values and derivatives come nearer as fast as the tolerance falls."""
    numbers, step = jnp.array([100.0, 70.0, 3.0, 1.0]), 1e-3
    value = lambda factor: swing(factor * numbers, 1e-12)[0]
    rise = lambda step: value(1.0 + step) - value(1.0 - step)
    exact = value(1.0), (8.0 * rise(step) - rise(2.0 * step)) / (12.0 * step)
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10):
        np.testing.assert_allclose(swing(numbers, rtol), exact, atol=30.0 * rtol)


@pytest.mark.parametrize("falls", [0.0, 0.2])
def test_starts_at_a_switch_and_taut(falls):
    """From where its rope is just taut, or longer, a weight at rest swings about its equilibrium.

    A second rope, over the weight from far below to far above, is as long as the way: rounding alone makes it taut.
    """
    weight, stiffness, mass = lx.point_mass("weight", 1.3), 60.0, 1.3
    above, far = lx.GROUND.at([0.0, 1.0, 0.0]), [lx.GROUND.at([0.0, y, 0.0]) for y in (-4.7, 5.1)]
    ropes = [
        lx.ElasticRope([above, weight], stiffness, 1.0),
        lx.ElasticRope([far[0], weight, far[1]], stiffness, 9.8, 0.3),
    ]
    rail = lx.Prismatic("rail", lx.GROUND, weight, "y")
    mechanism = lx.Mechanism([weight], [rail], [lx.Gravity([0.0, -G, 0.0]), *ropes])
    found = lx.simulate(mechanism, lx.State(jnp.array([-falls]), jnp.zeros(1)), t1=0.8)
    rest = mass * G / stiffness
    exact = -rest + (rest - falls) * np.cos(np.sqrt(stiffness / mass) * np.asarray(found.ts))
    np.testing.assert_allclose(found.q[:, 0], exact, atol=1e-6)
    assert found.stats["num_steps"] < 40


@pytest.mark.parametrize("late", [0.0, 1e3, 1e6])
def test_switches_at_late_times(late):
    """Two periods in closed form, also where numbers of time are too far apart to meet a switch to its own rounding."""
    weight, soft, stiff = lx.point_mass("weight", 2.0), 1e3, 4e3
    forces = [lx.JointSpring("slide", soft), lx.ElasticRope([lx.GROUND.at([-1.0, 0.0, 0.0]), weight], stiff, 1.0)]
    mechanism = lx.Mechanism([weight], [lx.Prismatic("slide", lx.GROUND, weight, "x")], forces)
    period = np.pi * (np.sqrt(2.0 / soft) + np.sqrt(2.0 / (soft + stiff)))
    start = lx.State(jnp.array([0.5]), jnp.zeros(1))
    found = lx.simulate(mechanism, start, t0=late, t1=late + 2.0 * period, saveat=SAVE_END)
    rounding = 50.0 * np.finfo(float).eps * late  # times a speed of 25 m/s
    np.testing.assert_allclose(found.q, [[0.5]], atol=1e-6 + rounding)
    assert found.stats["num_steps"] < 200


@pytest.mark.parametrize("switch", [lambda: jnp.zeros(2), lambda: 1 / 0])
def test_switches_that_are_no_number(switch):
    class Bad(Friction):
        def switch(self, t, motion):
            return switch()

    mechanism = pendulum(forces=[Bad(jnp.array(1.0))])
    with pytest.raises(ValueError, match="Bad: its switch"):
        lx.simulate(mechanism, lx.assemble(mechanism), t1=1.0)


@pytest.mark.parametrize("told", [False, True])
def test_a_load_that_pushes_back_from_both_sides_is_named(told):
    """A weight comes to rest by dry friction, whose side a switch tells or nothing does."""
    weight = lx.point_mass("weight", 1.0)
    dry = lx.JointTorque("slide", lambda t, motion: -3.0 * jnp.sign(motion.joint_speed("slide")))
    forces = [Friction(jnp.array(3.0)) if told else dry]
    mechanism = lx.Mechanism([weight], [lx.Prismatic("slide", lx.GROUND, weight, "x")], forces)
    options = {"t1": 1.0, "saveat": SAVE_END, "max_steps": 1024}
    with pytest.raises(lx.SimulationError, match=r"load of .* jumps there, by 6; .* linkax.JointFriction") as error:
        lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.ones(1)), **options)
    np.testing.assert_allclose(error.value.solution.t_end, 1.0 / 3.0, rtol=1e-4)
