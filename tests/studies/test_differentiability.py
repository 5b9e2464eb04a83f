"""What a motion has derivatives by: lengths that lock or unfold a mechanism are named, all else passes."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
NUMBERS = {"crank": 1.0, "rod": 1.0, "rod_mass": 1.0, "gravity": 9.81, "angle": np.pi / 3}


def crank_slider(params, t1=2.0, saveat=None):
    settings = SCENE.settings("SC4", params)
    mechanism = SCENE.mechanism(settings)
    return lx.simulate(mechanism, SCENE.initial(mechanism, settings), t1=t1, saveat=saveat)


def parallelogram(params):
    """A coupler on three parallel cranks, one more than hold it."""
    cranks = [lx.rod(f"crank_{i}", length=params["lengths"][i], mass=1.0) for i in range(3)]
    coupler = lx.rod("coupler", length=2.0, mass=params["mass"])
    joints = [lx.Revolute(f"pivot_{i}", lx.GROUND.at([i, 0, 0]), cranks[i].at("base"), axis="z") for i in range(3)]
    tips = [crank.at("tip") for crank in cranks]
    joints += [lx.Revolute(f"pin_{i}", tips[i], coupler.at([i, 0, 0]), axis="z", cut=i > 0) for i in range(3)]
    mechanism = lx.Mechanism([*cranks, coupler], joints, [lx.Gravity([0, -9.81, 0])])
    guess = {"pivot_1": 1.0, "pivot_2": 1.0, "pin_0": -1.0}
    return lx.simulate(mechanism, lx.assemble(mechanism, {"pivot_0": 1.0}, guess=guess), t1=0.2)


@pytest.mark.slow
def test_equal_lengths_of_a_crank_slider_change_together_alone():
    found = lx.differentiability(crank_slider, NUMBERS)
    assert set(found.reasons) == {"crank", "rod"}
    assert not found.ok
    for name in found.reasons:
        assert found.reasons[name].startswith("not differentiable: alone it undoes the singular configuration at t = ")
    assert "crank: not differentiable" in str(found)
    assert "gravity: differentiable" in str(found)
    # All but the difference of the two lengths.
    assert found.directions.shape == (5, 4)
    difference = np.array([0.0, 1.0, 0.0, -1.0, 0.0])
    assert found.names == ["angle", "crank", "gravity", "rod", "rod_mass"]
    np.testing.assert_allclose(difference @ found.directions, 0.0, atol=1e-3)


@pytest.mark.slow
def test_before_the_passage_all_is_differentiable():
    assert lx.differentiability(lambda params: crank_slider(params, t1=0.5), NUMBERS).ok


@pytest.mark.slow
def test_lengths_that_contradict_redundant_loops():
    found = lx.differentiability(parallelogram, {"lengths": np.ones(3), "mass": 1.0})
    assert set(found.reasons) == {"lengths[0]", "lengths[1]", "lengths[2]"}
    assert "contradicts redundant constraints of the loop that joint 'pin_" in found.reasons["lengths[1]"]
    together = np.array([1.0, 1.0, 1.0, 0.0]) / np.sqrt(3.0)
    np.testing.assert_allclose(np.linalg.norm(together @ found.directions), 1.0, atol=1e-6)


def test_numbers_of_an_inertia_have_one_name():
    def motion(params):
        body = params["inertia"]
        link = lx.RigidBody("link", body.mass, body.center_of_mass, body.inertia)
        mechanism = lx.Mechanism([link], [lx.Revolute("hinge", lx.GROUND, link, "z")])
        return lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.ones(1)), t1=0.1)

    inertia = lx.PhysicalInertia(1.0, [0.5, 0.0, 0.0], [0.01, 0.3, 0.3])
    found = lx.differentiability(motion, {"inertia": inertia})
    assert found.ok
    assert found.names == ["inertia"] * 10
    assert found.directions.shape == (10, 10)


def test_saved_times_that_show_no_passage_are_refused():
    end = lambda params: crank_slider(params, saveat=diffrax.SaveAt(t1=True))
    with pytest.raises(ValueError, match="save more times"):
        lx.differentiability(end, NUMBERS)


def test_bad_input():
    with pytest.raises(ValueError, match=r"must return a linkax\.Solution"):
        lx.differentiability(lambda params: jnp.zeros(3), NUMBERS)
