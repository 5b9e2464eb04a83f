"""The scenes against answers from elsewhere, at the stated figures."""

import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import n_four_bar, reference, start

import linkax as lx
from linkax.scenes import SCENES

PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}
# Every scene and variant here: what it must reach with PRECISE is in the tests below.
RUNS = [(name, variant) for name, scene in SCENES.items() for variant in scene.variants]


def run(name, variant=None, changes=None, *, t1, accuracy=lx.PRECISE):
    return lx.simulate(*start(name, variant, changes), t1=t1, accuracy=accuracy)


@pytest.mark.parametrize(("variant", "bound"), [("SC1", 1e-9), ("SC2", 1e-9), ("SC3", 5e-9), ("SC4", 1e-9)])
def test_slider_position_through_singular_passages(variant, bound):
    known, found = reference(f"crank_slider_{variant}"), run("crank-slider", variant, t1=5.0)
    np.testing.assert_allclose(found.ts, known["t"], atol=1e-12)
    assert np.max(np.abs(found.position("slider")[:, 0] - known["x_slider"])) <= bound


@pytest.mark.parametrize("variant", ["SC1", "SC3"])
def test_guide_force_away_from_singular_configurations(variant):
    known, found = reference(f"crank_slider_{variant}"), run("crank-slider", variant, t1=5.0)
    force, moment = found.reaction("guide")
    away = np.abs(np.cos(known["theta"])) > 0.01
    largest = np.max(np.abs(known["guide_force_y"]))
    assert np.max(np.abs(force[:, 1] - known["guide_force_y"])[away]) <= 1e-6 * largest
    # The pin goes through the slider's mass: no moment, and no force along the guide.
    assert np.max(np.abs(moment)) <= 1e-9 * largest
    assert np.max(np.abs(force[away][:, [0, 2]])) <= 1e-9 * largest


def test_regular_crank_slider_under_torque():
    known, found = reference("crank_slider_torque"), run("crank-slider", "regular", t1=3.0)
    at = np.searchsorted(known["t"], 3.0)
    np.testing.assert_allclose(found.joint("bearing")[-1], known["theta"][at], rtol=1e-8)
    np.testing.assert_allclose(found.joint_speed("bearing")[-1], known["theta_dot"][at], rtol=1e-8)
    np.testing.assert_allclose(found.velocity("slider")[-1, 0], known["v_slider"][at], rtol=1e-7)


def test_pendulum_at_ten_seconds():
    known, found = reference("A01_pendulum"), run("pendulum", t1=10.0)
    bob = found.position("link", at="bob")[-1]
    assert np.hypot(bob[0] - known["x"][20], bob[1] - known["y"][20]) <= 1e-9


def test_closed_form_agrees_with_the_tables():
    for count in (1, 2):
        known = reference(f"A02_nfourbar_N{count}")
        np.testing.assert_allclose(n_four_bar(known["t"], count)[:, 0], known["B0x"], atol=1e-12)


def test_start_in_the_singular_configuration_stays_on_the_parallelogram():
    found = run("n-four-bar", "FL2", t1=10.0)
    turn = found.ts
    exact = jnp.stack([1.0 + jnp.cos(turn), jnp.sin(turn), 0.0 * turn], axis=-1)
    assert np.max(np.abs(found.position("coupler_1", at="tip") - exact)) <= 1e-10
    assert found.rank()[0] == 1


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("name", "variant"), RUNS, ids=[f"{name}-{variant}" for name, variant in RUNS])
def test_violations_are_rounding(name, variant, preset):
    found = run(name, variant, t1=5.0, accuracy=PRESETS[preset])
    position, velocity, acceleration = found.worst_violation()
    assert position <= 1e-13
    assert velocity <= 1e-13
    assert acceleration <= 1e-11
