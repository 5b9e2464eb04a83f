"""Ropes over sheaves, winches and elastic ropes, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

GRAVITY = lx.Gravity([0.0, -9.81, 0.0])


def on_rail(name, x, mass):
    """A mass on a vertical rail."""
    body = lx.point_mass(name, mass)
    return body, lx.Prismatic(f"{name}_rail", lx.GROUND.at([x, 0.0, 0.0]), body, "y")


def test_two_masses_on_a_rope_over_two_sheaves():
    """Atwood's machine."""
    (heavy, left), (light, right) = on_rail("heavy", 0.0, 3.0), on_rail("light", 2.0, 1.0)
    rope = lx.Rope("rope", [heavy, lx.GROUND.at([0.0, 5.0, 0.0]), lx.GROUND.at([2.0, 5.0, 0.0]), light], 10.0)
    mechanism = lx.Mechanism([heavy, light], [left, right], [GRAVITY], [rope])
    state = lx.assemble(mechanism, {"heavy_rail": 1.0}, {"heavy_rail": -2.0})
    here, light = lx.Solution.of_state(mechanism, state), mechanism.topology.coordinates["light_rail"]
    np.testing.assert_allclose(state.q[light], [1.0], atol=1e-12)
    np.testing.assert_allclose(state.v[light], [2.0], atol=1e-12)
    np.testing.assert_allclose(here.acceleration("heavy")[0], [0.0, -9.81 / 2.0, 0.0], atol=1e-10)
    np.testing.assert_allclose(here.reaction("rope"), 2.0 * 3.0 * 1.0 / 4.0 * 9.81, rtol=1e-10)


def test_a_winch_lifts_a_load():
    load, rail = on_rail("load", 0.0, 2.0)
    rope = lx.Rope("winch", [lx.GROUND.at([0.0, 4.0, 0.0]), load], lambda t: 3.0 - t**3)
    mechanism = lx.Mechanism([load], [rail], [GRAVITY], [rope])
    t = 0.5
    state = lx.assemble(mechanism, t=t)
    here = lx.Solution.of_state(mechanism, state, t=t)
    np.testing.assert_allclose([*state.q, *state.v], [1.0 + t**3, 3.0 * t**2], atol=1e-12)
    np.testing.assert_allclose(here.reaction("winch"), 2.0 * (9.81 + 6.0 * t), rtol=1e-10)


def test_an_elastic_rope_pulls_and_does_not_push():
    load, rail = on_rail("load", 0.0, 2.0)
    rope = lx.ElasticRope([lx.GROUND.at([0.0, 4.0, 0.0]), load], stiffness=1000.0, free_length=3.0)
    mechanism = lx.Mechanism([load], [rail], [GRAVITY, rope])
    rest = lx.equilibrium(mechanism, lx.State(jnp.array([0.9]), jnp.zeros(1)))
    np.testing.assert_allclose(rest.q, 1.0 - 2.0 * 9.81 / 1000.0, rtol=1e-12)
    slack = lx.Solution.of_state(mechanism, lx.State(jnp.array([1.5]), jnp.zeros(1)))
    np.testing.assert_allclose(slack.acceleration("load")[0, 1], -9.81, rtol=1e-12)


def test_bad_ropes():
    load, _ = on_rail("load", 0.0, 2.0)
    for points, length, words in (
        ([load], 1.0, "1 points"),
        ([load, load.at([1.0, 0.0, 0.0])], 1.0, "all on body 'load'"),
        ([load, lx.GROUND], 0.0, "must be positive"),
        ([load, "hook"], 1.0, "'hook'"),
    ):
        with pytest.raises(ValueError, match=words):
            lx.Rope("rope", points, length)
