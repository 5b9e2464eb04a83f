"""Derivatives of what a failed run has not reached are NaN, however it is read; zero would say "at an optimum"."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar, pendulum

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


def out_of_reach(length):
    """A four-bar whose coupler is too short for its bearings."""
    return lx.assemble(four_bar(coupler=length, rocker=0.2), {"crank_bearing": 2.5}).q


def falls(gravity):
    """Nothing holds it."""
    mass = lx.point_mass("mass", 1.0)
    slide = lx.Prismatic("slide", lx.GROUND, mass, axis="y")
    mechanism = lx.Mechanism([mass], [slide], [lx.Gravity(jnp.array([0.0, -1.0, 0.0]) * gravity)])
    return lx.equilibrium(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1))).q


def is_level(gravity):
    """A pendulum that is not at rest."""
    state = lx.State(jnp.zeros(1), jnp.zeros(1))
    return lx.linearise(pendulum(gravity=gravity), state, degrees_of_freedom=1).natural_frequencies


@pytest.mark.slow
@pytest.mark.parametrize("failing", [out_of_reach, falls, is_level])
def test_derivatives_of_what_is_not_found_are_undefined(failing):
    at = jnp.asarray(0.3)
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.all(np.isnan(mode(failing)(at)))
    both = jax.jit(jax.vmap(jax.grad(lambda number: jnp.sum(failing(number)))))(jnp.array([0.3, 0.31]))
    assert np.all(np.isnan(both))


def test_a_batch_with_loops_that_do_not_close_keeps_the_derivatives_of_others():
    """Where a loss leaves those out."""
    lengths = jnp.array([0.3, 1.0])

    def loss(lengths):
        q = jax.vmap(lambda length: lx.assemble(four_bar(coupler=length), {"crank_bearing": 0.9}).q)(lengths)
        return jnp.sum(q[1])

    slopes = jax.jit(jax.grad(loss))(lengths)
    assert slopes[0] == 0.0
    alone = jax.grad(lambda length: jnp.sum(lx.assemble(four_bar(coupler=length), {"crank_bearing": 0.9}).q))(1.0)
    np.testing.assert_allclose(slopes[1], alone, rtol=1e-9)
