"""Derivatives of what a failed run has not reached are NaN, however it is read; zero would say "at an optimum"."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx

READINGS = {
    "joint": lambda run: run.joint("hinge")[-1],
    "position": lambda run: run.position("arm")[-1, 0],
    "energy": lambda run: run.energy()[-1],
    "reaction": lambda run: run.reaction("hinge").force[-1, 0],
    "work": lambda run: run.work()["damper"][-1],
    "end": lambda run: run.end.q[0],
}


def failed(length, **options):
    start = lx.State(jnp.zeros(1), jnp.zeros(1))
    arm = pendulum(length, forces=[lx.JointDamper("hinge", 0.1, name="damper")])
    return lx.simulate(arm, start, t1=5.0, max_steps=5, throw=False, **options)


@pytest.mark.parametrize("read", READINGS.values(), ids=READINGS)
def test_of_all_readings_in_both_modes(read):
    value = lambda length: read(failed(length))
    assert np.isnan(jax.grad(value)(1.0))
    assert np.isnan(jax.jvp(value, (1.0,), (1.0,))[1])


def test_of_times_between():
    at = lambda length, t: failed(length).at(t).joint("hinge")[0]
    assert failed(1.0).t_end < 4.0
    assert all(np.isnan(slope) for slope in jax.grad(at, (0, 1))(1.0, jnp.array([4.0])))


def test_of_an_implicit_solver():
    """Its linear solver sees none of the NaN, at which it would stop the program."""
    value = lambda length: failed(length, solver=diffrax.Kvaerno5()).joint("hinge")[-1]
    assert np.isnan(jax.grad(value)(1.0))
