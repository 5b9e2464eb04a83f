"""Derivatives of what joints miss, in few directions, against those along all speeds."""

import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import pytest
from known_answers import mechanism_of

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, retract
from linkax.equations.system import system_of
from linkax.model.terms import Term
from linkax.simulation.start.joint_values import JointValues


def _row_of_four_bars(_seed):
    return mechanism_of("n-four-bar", changes={"N": 6})


@pytest.mark.parametrize(
    "make",
    [
        _row_of_four_bars,
        mechanisms.cut,
        *(
            pytest.param(make, marks=pytest.mark.slow)
            for make in (mechanisms.floating, mechanisms.driven, mechanisms.bending)
        ),
    ],
)
def test_slopes_of_joints_are_those_along_all_speeds(make):
    mechanism = make(0)
    topology, t = mechanism.topology, jnp.zeros(())
    system = system_of(mechanism, t.dtype)
    change = 0.3 * np.random.default_rng(0).normal(size=topology.num_speeds)
    q = retract(topology, jnp.asarray(neutral(topology, t.dtype)), jnp.asarray(change))
    moved = lambda change: configure(system, t, retract(topology, q, change))
    still = jnp.zeros(topology.num_speeds)

    values = [(Term(name, None), np.asarray(moved(still).joint_coordinates(name))) for name in topology.joints]
    held = JointValues.of(topology, values)

    @jax.jit
    def compared():
        apart = lambda change: held.apart(moved(change))
        slopes = held.slopes(apart, topology, t.dtype)
        return apart(still), slopes, jax.jacfwd(lambda change: apart(change).flat())(still)

    at_rest, found, expected = compared()
    np.testing.assert_allclose(found, expected, atol=1e-13)
    assert {along for along, _ in at_rest.by_term()} == {along for along, _ in values}
    for along, rows in at_rest.by_term():
        np.testing.assert_allclose(rows, 0.0, atol=1e-13, err_msg=along.joint)
