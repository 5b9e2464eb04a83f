"""Mechanisms far from the origin and tilted, and those with numbers that are zero."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import turning
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.scenes import SCENES

SETTINGS = SCENES["crank-slider"].settings(changes={"rod": 1.3, "angle": 0.3, "speed": 2.0})
ACCURACY = lx.Accuracy(rtol=1e-10)
FAR = np.array([1e6, -3e5, 7e5]) / 3.0
TURNS = [[0.0, 0.0, 0.0], [0.3, -0.7, 1.1], [np.pi, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.0, np.pi / 2, 0.0]]


def placed(origin, turn):
    """The crank-slider with its ground moved and turned, as numbers: which rows are redundant is found at run time."""
    gravity = lx.Gravity(jnp.asarray(turn) @ jnp.array([0.0, -SETTINGS["gravity"], 0.0]))
    mechanism, state = turning(SETTINGS, [gravity])
    ground = lx.GROUND.at(origin, jnp.asarray(turn))
    on_ground = lambda joint: joint.parent.body == "ground"
    moved = lambda joint: eqx.tree_at(lambda j: j.parent, joint, ground) if on_ground(joint) else joint
    mechanism = lx.Mechanism(mechanism.bodies, map(moved, mechanism.joints), [gravity])
    return lx.simulate(mechanism, state, t1=2.0, accuracy=ACCURACY)


@pytest.mark.slow
def test_neither_place_nor_direction_matters():
    plain = lx.simulate(*turning(SETTINGS), t1=2.0, accuracy=ACCURACY)
    for turn in Rotation.from_rotvec(TURNS).as_matrix():
        for origin in (np.zeros(3), FAR):
            found = placed(origin, turn)
            assert found.rank()[0] == 2
            # Rounding of a rotation, some ulps, which the choice of steps amplifies as it does in other units.
            np.testing.assert_allclose(found.q, plain.q, atol=1e-11)
            worst = found.worst_violation()
            assert max(worst.position, worst.velocity, worst.acceleration) <= 1e-14
            # Places are read in ground axes, with the rounding of the largest.
            local = (found.position("slider") - origin) @ turn
            rounding = 2.0 * np.finfo(float).eps * np.max(np.abs(origin))
            np.testing.assert_allclose(local, plain.position("slider"), atol=1e-11 + rounding)


@pytest.mark.parametrize("changes", [{}, {"rod": 1.0, "angle": np.pi / 2}], ids=["anywhere", "singular"])
def test_without_gravity_and_speed_nothing_moves(changes):
    """Nor in a singular configuration."""
    mechanism, state = turning(SETTINGS | {"gravity": 0.0, "speed": 0.0} | changes)
    found = lx.simulate(mechanism, state, t1=1e6, accuracy=ACCURACY)
    assert not np.any(found.v)
    # Putting it on the loops may change the last digits.
    np.testing.assert_allclose(found.q, np.broadcast_to(state.q, found.q.shape), atol=1e-15)
