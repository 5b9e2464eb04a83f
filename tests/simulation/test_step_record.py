"""Derivatives of runs that make more tries than are on record: earlier steps are made again, and change nothing."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, pendulum

import linkax as lx
from linkax.simulation.integrate.step_record import Size

FEW, MANY = 1001, 1000  # most steps of runs with few rows, and with all that they need
ROWS = 4
AT, ALONG = jnp.array([0.01, 0.02, 0.03]), jnp.array([0.3, -0.5, 0.7])
SAVED = np.linspace(0.1, 0.9, 5)


@pytest.fixture(autouse=True)
def few_rows(monkeypatch):
    size = Size.of
    monkeypatch.setattr(Size, "of", lambda most: Size(ROWS, -(-most // ROWS)) if most == FEW else size(most))


def loops(numbers):
    mechanism = crank_slider(rod=1.3 + numbers[0])
    return mechanism, lx.assemble(mechanism, {"bearing": 0.5}, {"bearing": 4.0 + numbers[1]})


def stops(numbers):
    """A pendulum falls on a stop, and bounces."""
    law = lx.ContactLaw(stiffness=1e5, restitution=0.8, impact_speed=1.0)
    mechanism = pendulum(1.0 + numbers[1], forces=[lx.JointLimit("hinge", law, lower=-1.0 + numbers[0])])
    return mechanism, lx.assemble(mechanism, {"hinge": 0.0})


def pulses(numbers):
    """A pendulum with a torque that begins and ends at times that may change."""
    times = jnp.array([0.2, 0.3, 0.6, 0.7]) + 0.1 * numbers[0]
    torque = lx.JointTorque("hinge", lx.PiecewiseLinear(times, jnp.array([0.0, 5.0, -5.0, 0.0])))
    mechanism = pendulum(1.0 + numbers[1], forces=[torque])
    return mechanism, lx.assemble(mechanism, {"hinge": 0.0})


def loss(case, numbers, most):
    mechanism, state = case(numbers)
    saveat = diffrax.SaveAt(ts=SAVED + 0.0 * numbers[2], t1=True)
    run = lx.simulate(mechanism, state, t1=1.0 + numbers[2], saveat=saveat, max_steps=most)
    return jnp.sum(jnp.sin(run.q + 2.0 * run.v)), run.stats["num_steps"]


def gradient(case, most):
    return jax.grad(lambda numbers: loss(case, numbers, most), has_aux=True)


def forwards(case, most):
    return jax.jacfwd(lambda numbers: loss(case, numbers, most), has_aux=True)


def hessian_times_vector(case, most):
    slope = lambda numbers: gradient(case, most)(numbers)[0]
    return lambda numbers: (jax.jvp(slope, (numbers,), (ALONG,))[1], loss(case, numbers, most)[1])


slowly = lambda *values: pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("derivative", "case"),
    [
        (gradient, stops),
        (forwards, pulses),
        *(slowly(derivative, loops) for derivative in (gradient, forwards, hessian_times_vector)),
        *(slowly(derivative, case) for derivative in (forwards, hessian_times_vector) for case in (stops, pulses)),
        slowly(gradient, pulses),
    ],
)
def test_derivatives_are_the_same(derivative, case):
    (few, steps), (many, as_many) = (jax.jit(derivative(case, most))(AT) for most in (FEW, MANY))
    assert steps == as_many > 3 * ROWS
    np.testing.assert_allclose(few, many, rtol=1e-12, atol=1e-12 * np.max(np.abs(many)))


@pytest.mark.slow
def test_each_member_of_a_batch_has_steps_of_its_own():
    numbers = AT * jnp.array([[1.0], [-20.0], [10.0]])
    few, steps = jax.jit(jax.vmap(gradient(stops, FEW)))(numbers)
    assert len(set(np.asarray(steps - 1) // ROWS)) == 3
    many = [jax.jit(gradient(stops, MANY))(each)[0] for each in numbers]
    np.testing.assert_allclose(few, many, rtol=1e-7)


@pytest.mark.parametrize(("max_steps", "size"), [(5, (5, 1)), (256, (256, 1)), (257, (256, 2)), (65536, (256, 256))])
def test_memory_grows_with_the_root_of_the_steps(max_steps, size):
    assert Size.of(max_steps) == size
    assert Size.of(10**8) == (10**4, 10**4)
