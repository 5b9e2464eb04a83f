"""Assembly from where bodies and points are in the world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import coupler_between_balls
from refusals import refused

import linkax as lx
from benchmarks.assembly import share
from benchmarks.linkages import LINKAGES, hidden

FAR = np.array([1e6, 0.0, 0.0])  # where it stands
NONE = np.zeros(3)


def four_bar(coupler=1.0, origin=NONE):
    crank, link, rocker = lx.rod("crank", 0.4, 1.0), lx.rod("coupler", coupler, 1.0), lx.rod("rocker", 0.8, 1.0)
    hinge = lambda *ends: lx.Revolute(*ends, axis="z")
    joints = [
        hinge("A", lx.GROUND.at(origin), crank.at("base")),
        hinge("B", crank.at("tip"), link.at("base")),
        hinge("C", link.at("tip"), rocker.at("tip")),
        hinge("D", lx.GROUND.at(origin + np.array([1.0, 0.0, 0.0])), rocker.at("base")),
    ]
    return lx.Mechanism([crank, link, rocker], joints)


def in_mode(side):
    """The four-bar far away with its rocker up or down, and its state."""
    mechanism, place = four_bar(origin=FAR), FAR + np.array([1.0, 0.7 * side, 0.0])
    return mechanism, lx.assemble(mechanism, {"A": 1.0}, guess={"coupler.tip": place})


def read(mechanism, state):
    return lx.Solution.of_state(mechanism, state)


def test_a_rough_place_of_a_point_chooses_the_mode():
    for side in (1.0, -1.0):
        place = read(*in_mode(side)).position("coupler", at="tip")[0] - FAR
        np.testing.assert_allclose(np.linalg.norm(place - np.array([1.0, 0.0, 0.0])), 0.8, atol=1e-9)
        assert np.sign(place[1]) == side


def test_a_cut_joint_is_guessed_as_one_in_the_tree_is():
    mechanism, known = in_mode(-1.0)
    (name,) = set(mechanism.topology.joints) - set(mechanism.topology.coordinates)
    angle = float(read(mechanism, known).joint(name)[0])
    state = lx.assemble(mechanism, {"A": 1.0}, guess={name: angle + 0.2})
    np.testing.assert_allclose(state.q, known.q, atol=1e-9)


def test_a_guess_that_closes_the_loops_stays_as_it_is():
    """Of the pose of a coupler, in both modes, where the crank may turn; and of one that is off, what is near."""
    mechanism = four_bar(origin=FAR)
    for angle in (1.0, -2.0):
        place = {"coupler.tip": FAR + np.array([1.0, 0.7 * np.sign(angle), 0.0])}
        known = lx.assemble(mechanism, {"A": angle}, guess=place)
        pose = lx.Pose(*(part[0] for part in read(mechanism, known).poses()["coupler"]))
        np.testing.assert_allclose(lx.assemble(mechanism, guess={"coupler": pose}).q, known.q, atol=1e-9)
        off = lx.Pose(pose.position + np.array([1e-3, 1e-3, 0.0]), pose.orientation)
        np.testing.assert_allclose(lx.assemble(mechanism, guess={"coupler": off}).q, known.q, atol=1e-2)


def test_places_and_velocities_in_the_world_are_held():
    mechanism, known = in_mode(1.0)
    pose, rocker = (read(mechanism, known).poses()[body] for body in ("coupler", "rocker"))
    speed = {"crank.tip": 2.0 * 0.4 * np.array([-np.sin(1.0), np.cos(1.0), 0.0])}
    rough = lx.Pose(rocker.position[0] + 0.1, rocker.orientation[0])
    state = lx.assemble(mechanism, {"coupler": lx.Pose(*(part[0] for part in pose))}, speed, guess={"rocker": rough})
    assert state.topology == mechanism.topology
    np.testing.assert_allclose(state.q, known.q, atol=1e-9)
    np.testing.assert_allclose(state.v[mechanism.topology.speeds["A"]], 2.0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_what_is_held_in_the_world():
    """Of the rocker's angle by the place of the crank's tip along its circle, and by the coupler's length."""

    def angle(turn, coupler):
        mechanism = four_bar(coupler)
        tip = 0.4 * jnp.stack([jnp.cos(turn), jnp.sin(turn), jnp.zeros(())])
        state = lx.assemble(mechanism, {"crank.tip": tip}, guess={"coupler.tip": [1.0, 0.7, 0.0]})
        return state.q[mechanism.topology.coordinates["D"]][0]

    def exact(turn, coupler):
        reach = jnp.stack([0.4 * jnp.cos(turn) - 1.0, 0.4 * jnp.sin(turn)])
        distance = jnp.linalg.norm(reach)
        between = jnp.arccos((0.64 + distance**2 - coupler**2) / (1.6 * distance))
        return jnp.arctan2(reach[1], reach[0]) - between

    numbers = (1.0, 1.0)
    np.testing.assert_allclose(angle(*numbers), exact(*numbers), atol=1e-9)
    slopes = jax.grad(angle, (0, 1))(*numbers)
    np.testing.assert_allclose(slopes, jax.grad(exact, (0, 1))(*numbers), rtol=1e-8)


def test_what_is_wrong_is_named():
    mechanism = four_bar()
    refused(lambda: lx.assemble(mechanism, guess={"rocker.top": [0.0, 0.0, 0.0]}), "'rocker'", "'top'", "'tip'")
    refused(lambda: lx.assemble(mechanism, guess={"lever": lx.Pose([0.0, 0.0, 0.0])}), "'lever'", "'rocker'")
    for misspelt, meant in (("roker.tip", "rocker.tip"), ("rocker_tip", "rocker.tip"), ("rokcer", "rocker")):
        asked = [{"guess": {misspelt: [0.0, 1.0, 0.0]}}, {"positions": {misspelt: lx.Pose([0.0, 1.0, 0.0])}}]
        for given in [*asked, {"speeds": {misspelt: [0.0, 1.0, 0.0]}}]:
            told = f"unknown joint or body {misspelt!r} (did you mean {meant!r}?)"
            refused(lambda given=given: lx.assemble(mechanism, **given), told, *mechanism.topology.joints)
    refused(lambda: lx.assemble(mechanism, {"rocker.tip": [0.0, 1.0]}), "'rocker.tip'", "(2,)")
    refused(lambda: lx.assemble(mechanism, {"rocker": lx.Velocity([0.0, 1.0, 0.0])}), "'rocker'", "Pose")
    refused(lambda: lx.assemble(mechanism, guess={"rocker": lx.Pose([0.0, 1.0, 0.0], 2.0 * np.eye(3))}), "'rocker'")
    with pytest.raises(lx.AssemblyError, match=r"position asked of 'rocker.tip' in the world is missed by|not close"):
        lx.assemble(mechanism, {"rocker.tip": [5.0, 0.0, 0.0]})


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("four-bar", 10),
        *(pytest.param(name, 100, marks=pytest.mark.slow) for name in LINKAGES),
    ],
)
def test_rough_places_lead_to_the_mode_drawn(name, count):
    (row,) = share(name, count)
    assert row["drawn"] >= 0.98


def test_a_pose_may_be_known_where_the_mechanism_is_traced():
    """Of a rod in the air, whose coordinates it is."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

    @jax.jit
    def assembled(length):
        rod = lx.rod("rod", length, 1.0)
        mechanism = lx.Mechanism([rod], [lx.Free("flight", lx.GROUND, rod)])
        return lx.assemble(mechanism, guess={"rod": lx.Pose([1.0, 2.0, 3.0], turned)}).q

    half = np.sqrt(0.5)
    np.testing.assert_allclose(assembled(2.0), [half, 0.0, 0.0, half, 1.0, 2.0, 3.0], atol=1e-12)


def test_assemblies_are_counted_as_textbooks_do():
    """Of Jansen's leg, which is three dyads with two modes each."""
    leg = hidden(LINKAGES["Jansen leg"]())
    assert len(lx.assemblies(leg.mechanism, leg.held)) == 8


def test_assemblies_of_one_that_turns_anyhow_and_one_that_can_move():
    """A coupler between balls closes an arm and a slide in two ways, however it spins."""
    mechanism = coupler_between_balls()
    found = lx.assemblies(mechanism, {"hinge": 1.0})
    assert all(state.topology == mechanism.topology for state in found)
    places = [state.q[mechanism.topology.coordinates["guide"]][0] for state in found]
    half = np.sqrt(1.0 - 0.2**2 - (0.5 * np.sin(1.0)) ** 2)
    np.testing.assert_allclose(sorted(places), 0.5 * np.cos(1.0) + half * np.array([-1.0, 1.0]), atol=1e-9)
    arm = lx.rod("arm", 0.5, 1.0)
    free = lx.Mechanism([arm], [lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")])
    with pytest.warns(lx.AssemblyWarning, match="can move with the positions held, in 1 ways"):
        lx.assemblies(free)
    refused(lambda: lx.assemblies(mechanism, tries=0), "tries", "0")
