"""What a single run warns of is marked in batches: each kind, of the member that it concerns and of no other."""

import dataclasses
import pickle

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import turning
from mechanisms import pendulum
from test_step_control import REST, held_weight

import linkax as lx
from linkax.linalg.spectral_radius import spectral_radius
from linkax.scenes import SCENES
from linkax.simulation.integrate.results import WARNINGS

GRAVITY = lx.Gravity([0.0, -9.81, 0.0])


def carried(length):
    """A pendulum that carries another one, of this length."""
    links = [lx.rod("first", 1.0, 1.0), lx.rod("second", length, 1.0)]
    hinges = [
        lx.Revolute("hinge", lx.GROUND, links[0].at("base"), "z"),
        lx.Revolute("elbow", links[0].at("tip"), links[1].at("base"), "z"),
    ]
    start = lx.State(jnp.array([0.3, 0.0]), jnp.zeros(2))
    return lx.simulate(lx.Mechanism(links, hinges, [GRAVITY]), start, t1=0.1, accuracy=lx.Accuracy(rtol=1e-11))


def held(stiffness):
    """A weight held by a spring: with the program of test_step_control."""
    return lx.simulate(held_weight(stiffness, 0.0), REST, t1=0.5, max_steps=4096)


def test_at_a_stop_the_advice_is_one_that_a_stop_can_follow():
    limit = lx.JointLimit("hinge", lx.ContactLaw(1e8, exponent=1.0, damping=1.0), lower=0.0)
    with pytest.warns(lx.StiffnessWarning, match="JointLimit on 'hinge'.* take one with less stiffness.*linkax.Impact"):
        lx.simulate(pendulum(forces=[limit]), lx.State(jnp.zeros(1), jnp.zeros(1)), t1=0.5)


def from_angle(angle, speed, gravity, **options):
    """A crank-slider of equal lengths."""
    changes = {"angle": angle, "speed": speed, "gravity": gravity}
    mechanism, state = turning(SCENES["crank-slider"].settings(changes=changes))
    return lambda start: lx.simulate(mechanism, lx.State(*start), t1=2.0, **options), (state.q, state.v)


def in_single_precision(times):
    """Beginning so far along a turn: the second one begins beside the singular configuration, and passes it."""
    single = dict(dtype=jnp.float32, accuracy=lx.Accuracy(rtol=1e-4), saveat=diffrax.SaveAt(t1=True))
    starts = [from_angle(time, 0.6, 0.0, **single)[1] for time in times]
    return from_angle(times[0], 0.6, 0.0, **single)[0], jax.tree.map(lambda *parts: np.stack(parts), *starts)


def hanging(distances):
    """At rest beside the hanging singular configuration."""
    starts = [from_angle(distance - np.pi / 2, 0.0, 9.81)[1] for distance in distances]
    return from_angle(0.3, 0.0, 9.81)[0], jax.tree.map(lambda *parts: np.stack(parts), *starts)


# Of each remark a run and a batch of two, of which the second is to be remarked on.
CASES = {
    "rounding": lambda: (carried, np.array([1.0, 1e4])),
    "single_precision": lambda: in_single_precision([-0.3, np.pi / 2 - 0.01]),
    "lingers": lambda: hanging([0.3, 3e-6]),
    "stiff": lambda: (held, np.array([1e2, 1e8])),
}


def member_of(tree, index):
    return jax.tree.map(lambda leaf: leaf[index], tree)


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_members_of_a_batch_are_marked_where_a_run_warns(kind):
    run, starts = CASES[kind]()
    mark = getattr(lx.REMARKS, kind)
    found = jax.vmap(run)(starts)
    remark = pickle.loads(pickle.dumps(found)).remark()
    assert (remark == lx.REMARKS.none).tolist() == [True, False]
    assert (remark == mark).tolist() == [False, True]
    assert member_of(found, 1).remark() == mark
    assert lx.REMARKS[mark] == lx.REMARKS[member_of(remark, 1)] != ""
    assert run(member_of(starts, 0)).remark() == lx.REMARKS.none  # without a warning, which would be an error
    with pytest.warns(WARNINGS[kind]):
        assert run(member_of(starts, 1)).remark() == mark


@pytest.mark.slow
def test_inside_of_transformations():
    """Of any number of batch axes, and beside what a sweep returns."""
    remark = lambda stiffness: held(stiffness).remark()
    inside = jax.jit(jax.vmap(jax.vmap(remark)))(jnp.array([[1e2], [1e8]]))
    assert (inside == lx.REMARKS.stiff).tolist() == [[False], [True]]
    assert (inside == lx.REMARKS.none).tolist() == [[True], [False]]
    with pytest.warns(lx.StiffnessWarning, match="2 of 3 members"):
        found = lx.sweep(lambda stiffness: {"remark": remark(stiffness)}, np.array([1e8, 1e2, 9e7]))
    assert list(found.remarked) == [0, 2]


@pytest.fixture(scope="module")
def swept():
    """The second is stiff, the third one fails."""
    with pytest.warns(lx.StiffnessWarning, match="1 of 3 members: A stiff spring"):
        return lx.sweep(held, np.array([1e2, 1e8, np.nan]))


def test_sweeps_mark_members_where_a_run_warns(swept):
    found, marked = swept.output, [False, True, False]
    for remark in (swept.remarks, found.remark(), pickle.loads(pickle.dumps(found)).remark()):
        assert (remark == lx.REMARKS.stiff).tolist() == marked
        assert (remark == lx.REMARKS.none).tolist() == [not mark for mark in marked]
    assert list(swept.remarked) == [1]
    assert "chooses the steps" in swept.remarked[1]
    assert list(swept.failed) == [2]
    assert held(1e2).remark() == lx.REMARKS.none  # without a warning, which would be an error
    with pytest.warns(lx.StiffnessWarning, match="JointSpring"):
        alone = held(1e8)
    assert alone.remark() == member_of(found, 1).remark() == lx.REMARKS.stiff


# What marks a run that is marked for nothing else, and what just does not, of a tolerance of 1e-8.
BORDERS = {
    "rounding": ({"definiteness": 1e-9}, {"definiteness": 1e-8}),
    "single_precision": ({"closest": np.float32(1e-2)}, {"closest": 1e-2}),
    "lingers": ({"average": 1e-6}, {"average": 1e-4}),
}


@pytest.mark.parametrize("kind", BORDERS)
def test_each_kind_is_marked_by_its_numbers(swept, kind):
    """Of each member, and of those that ended well, before steps are."""
    marked, plain = ({name: np.full(3, of) for name, of in numbers.items()} for numbers in BORDERS[kind])
    remark = dataclasses.replace(swept.output, **marked).remark()
    assert (remark == getattr(lx.REMARKS, kind)).tolist() == [True, True, False]
    unmarked = dataclasses.replace(swept.output, **plain).remark()
    assert (unmarked == lx.REMARKS.none).tolist() == [True, False, True]


def test_a_state_is_no_run_to_remark_on():
    mechanism, state = turning(SCENES["crank-slider"].settings(changes={}))
    assert lx.Solution.of_state(mechanism, state).remark() == lx.REMARKS.none


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_spectral_radius(size):
    rng = np.random.default_rng(0)
    matrices = size * rng.standard_normal((5, 6, 6))
    exact = np.max(np.abs(np.linalg.eigvals(matrices)), axis=-1)
    np.testing.assert_allclose(spectral_radius(matrices), exact, rtol=1e-2)
    assert spectral_radius(jnp.zeros((3, 3))) == 0.0
    assert spectral_radius(jnp.array([[0.0, 1.0], [0.0, 0.0]])) == 0.0
