"""Derivatives of what joints miss, in few directions, against those along all speeds."""

import jax
import jax.numpy as jnp
import mechanisms
import numpy as np
import pytest

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, retract
from linkax.equations.system import system_of
from linkax.model.terms import Term
from linkax.scenes import SCENES
from linkax.simulation.start.closing import LoopClosure
from linkax.simulation.start.joint_slopes import joint_slopes
from linkax.simulation.start.validation import JointValues


def _row_of_four_bars(_seed):
    scene = SCENES["n-four-bar"]
    return scene.mechanism(scene.settings(None, {"N": 6}))


@pytest.mark.parametrize(
    "make", [_row_of_four_bars, mechanisms.floating, mechanisms.cut, mechanisms.driven, mechanisms.bending]
)
def test_slopes_of_joints_are_those_along_all_speeds(make):
    mechanism = make(0)
    topology, t = mechanism.topology, jnp.zeros(())
    system = system_of(mechanism, t.dtype)
    change = 0.3 * np.random.default_rng(0).normal(size=topology.num_speeds)
    q = retract(topology, jnp.asarray(neutral(topology, t.dtype)), jnp.asarray(change))
    moved = lambda change: configure(system, t, retract(topology, q, change))
    still = jnp.zeros(topology.num_speeds)

    @jax.jit
    def compared():
        terms = tuple(Term(name, None) for name in topology.joints)
        values = tuple(moved(still).joint_coordinates(name) for name in topology.joints)
        misses = lambda change: LoopClosure(system, t, JointValues(terms, values)).misses(moved(change))
        return joint_slopes(misses, topology, terms, t.dtype), jax.jacfwd(misses)(still)

    for name, found, expected in zip(topology.joints, *compared(), strict=True):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, atol=1e-13, err_msg=name)
