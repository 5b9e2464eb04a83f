"""The scenes against answers from elsewhere, at the stated figures."""

import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import PASSING, REDUNDANT, n_four_bar, reference, start

import linkax as lx

PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}


def run(name, variant=None, changes=None, *, t1, accuracy=lx.PRECISE):
    return lx.simulate(*start(name, variant, changes), t1=t1, accuracy=accuracy)


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


# Bounds of the largest error [m or rad] at all times.
BOUNDS = {
    "spatial FL1": 1e-10,
    "spatial FL2": 1e-10,
    "spatial FL3": 1e-7,
    "bricard": 1e-9,
    "rigid-crane": 1e-9,
    "planar-four-bar": 1e-9,
}


def marked(names):
    """Those that take long to compile, and are like others, as slow ones."""
    few = ("SC1", "SC3", "spatial FL3")
    return [pytest.param(name, marks=[] if name in few else [pytest.mark.slow]) for name in names]


@pytest.mark.parametrize("name", marked(REDUNDANT))
def test_redundant_and_coupled_mechanisms(name):
    known = REDUNDANT[name]
    found = known.simulate(accuracy=lx.PRECISE)
    assert np.max(known.error(found)) <= BOUNDS[name]


@pytest.mark.slow
def test_bricard_moves_with_one_constraint_too_many():
    known = REDUNDANT["bricard"]
    found = known.simulate(accuracy=lx.PRECISE)
    assert found.mechanism.topology.num_rows == 5
    assert np.all(found.rank() == found.mechanism.topology.num_speeds - 1)
    # Off the loops the dependent row is not quite dependent: at a loose tolerance too it must not count.
    loose = known.simulate(accuracy=lx.DRAFT)
    assert np.max(known.error(loose)) <= 1e-3


def test_a_start_in_a_singular_configuration_is_at_distance_zero():
    found = lx.simulate(*start("spatial-four-link", "FL4"), t1=20.0)
    np.testing.assert_array_equal(found.rank_nearby, [2])
    assert found.rank()[0] == 1
    assert found.singularity_distance()[0] <= 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_energy_through_ten_turns(count):
    run = PASSING[f"A02-{count}"]._replace(t1=20.0)
    found = run.simulate(accuracy=lx.PRECISE)
    assert np.max(run.error(found)) <= 1e-7
    assert np.ptp(found.energy()) <= 1e-8 * np.max(found.kinetic_energy())


@pytest.mark.parametrize("variant", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("FL1", "FL2")), "FL3"])
def test_four_link_reactions(variant):
    """In-plane reactions in closed form; out of the plane they are not unique, and reported as zero."""
    found = REDUNDANT[f"spatial {variant}"].simulate(accuracy=lx.PRECISE)
    angle, speed = found.joint("A"), found.joint_speed("A")
    gravity = 9.81 if variant == "FL3" else 0.0
    zero = 0.0 * angle
    along = jnp.stack([jnp.cos(angle), jnp.sin(angle), zero], axis=-1)
    across = jnp.stack([-jnp.sin(angle), jnp.cos(angle), zero], axis=-1)
    inward = (gravity * jnp.sin(angle) - speed**2)[:, None] / 2.0 * along
    at_c = inward - gravity / 10.0 * jnp.cos(angle)[:, None] * across
    turning = -1.2 * gravity * jnp.cos(angle)[:, None] * across - (speed**2)[:, None] * along
    at_d = turning / 2.0 + at_c + jnp.array([0.0, gravity, 0.0])
    away = np.abs(np.sin(angle)) > 0.01
    for joint, on, exact in (("C", "parent", at_c), ("B", "child", at_c), ("D", "child", at_d)):
        force, moment = found.reaction(joint, on=on)
        assert np.max(np.abs(force - exact)[away]) <= 1e-7
        assert np.max(np.abs(moment)[away]) <= 1e-7
        unique = found.reaction_unique(joint, on=on)
        np.testing.assert_array_equal(np.all(unique.force[away], axis=0), [True, True, False])
        np.testing.assert_array_equal(np.all(unique.moment[away], axis=0), [False, False, True])
        assert not np.any(unique.force[:, 2] | unique.moment[:, 0] | unique.moment[:, 1])


# Each topology once: all runs of one share a program.
CLOSED = {name: PASSING[name] for name in ("SC1", "SC3", "FL2", "A02-2")} | REDUNDANT


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", marked(CLOSED))
def test_violations_are_rounding(name, preset):
    known = CLOSED[name]._replace(t1=5.0) if CLOSED[name].times is None else CLOSED[name]
    position, velocity, acceleration = known.simulate(accuracy=PRESETS[preset]).worst_violation()
    assert position <= 1e-13
    assert velocity <= 1e-13
    assert acceleration <= 1e-11
