"""Constraints that are given twice, or nearly twice: redundant, real, or contradicting each other."""

import copy

import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import KINDS, Numbers

import linkax as lx
from linkax.equations.coordinates import neutral, retract
from linkax.scenes.closed_form import pendulum_angle

START = {"a": 1.2, "b": 1.2, "c": 1.2, "a_pin": -1.2, "beside": -np.pi / 2}
WEIGHT, SPEED, DURATION = 9.81, 1.0, 0.4


def parallelogram(excess=0.0, place=0.4, width=1.0):
    """A coupler on three parallel rods, of which two would do; the third at `place` is longer by `excess` [m].

    The coupler only translates, so that all moves like a pendulum of three rods and a mass at their ends.
    Another rod hangs beside it, in no loop.
    """
    names = ("a", "b", "c")
    rods = [lx.rod(name, 1.0 + (excess if name == "c" else 0.0), 1.0) for name in names]
    points = {"a": np.zeros(3), "b": np.array([width, 0.0, 0.0]), "c": np.array([place, 0.0, 0.0])}
    coupler = lx.RigidBody("coupler", 1.0, points["b"] / 2.0, np.array([0.0, 0.1, 0.1]), points)
    ends = list(zip(names, rods, strict=True))
    joints = [lx.Revolute(name, lx.GROUND.at(points[name]), rod.at("base"), axis="z") for name, rod in ends]
    joints += [lx.Revolute(f"{name}_pin", rod.at("tip"), coupler.at(name), axis="z") for name, rod in ends]
    beside = lx.rod("beside", 1.0, 1.0)
    joints.append(lx.Revolute("beside", lx.GROUND, beside.at("base"), axis="z"))
    return lx.Mechanism([coupler, *rods, beside], joints, [lx.Gravity([0.0, -WEIGHT, 0.0])])


def run(mechanism, speeds, accuracy=lx.PRECISE):
    positions = {name: START[name] for name in mechanism.topology.coordinates}
    state = lx.assemble(mechanism, {"a": START["a"]}, speeds, guess=positions)
    return state, lx.simulate(mechanism, state, t1=DURATION, accuracy=accuracy)


def pendulum(times):
    """J = 3 · 1/3 + 1, and weights of 3 / 2 + 1."""
    return pendulum_angle(times, 2.5 * WEIGHT / 2.0, START["a"] + np.pi / 2.0, SPEED) - np.pi / 2.0


@pytest.mark.parametrize("excess", [0.0, *(s * 10.0**-digits for digits in (14, 13, 12) for s in (1.0, -1.0))])
def test_a_rod_too_many(excess):
    """A length that is off by less than the tolerance opens the loops by as much, and changes nothing else."""
    mechanism = parallelogram(excess)
    state, found = run(mechanism, {"a": SPEED})
    mobility = lx.mobility(mechanism, state)
    assert mobility.degrees_of_freedom == 1 + 1
    # Three rows of each of two pins do not move in a plane, and of the others one depends on the rest.
    assert mobility.num_redundant == 2 * 3 + 1
    angle, beside = (found.q[:, mechanism.topology.coordinates[name]] for name in ("a", "beside"))
    np.testing.assert_allclose(angle[:, 0], pendulum(np.asarray(found.ts)), atol=1e-10)
    assert found.worst_violation().position <= 2.0 * abs(excess) + 1e-15
    np.testing.assert_allclose(beside, -np.pi / 2, atol=1e-14)


@pytest.mark.parametrize("excess", [s * 10.0**-digits for digits in (11, 10, 9) for s in (1.0, -1.0)])
def test_a_rod_a_little_too_long_needs_a_tolerance_that_allows_it(excess):
    mechanism = parallelogram(excess)
    _, found = run(mechanism, {"a": SPEED}, lx.BALANCED)
    np.testing.assert_allclose(found.joint("a"), pendulum(np.asarray(found.ts)), atol=10.0 * lx.BALANCED.rtol)
    assert found.worst_violation().position <= 2.0 * abs(excess)
    with pytest.raises(lx.SimulationError, match=r"'._pin' stays open by .*e-.*nearly redundant.*tolerance"):
        run(mechanism, {"a": SPEED})


@pytest.mark.parametrize("excess", [s * 10.0**-digits for digits in (8, 7, 6, 5, 4, 3) for s in (1.0, -1.0)])
def test_a_rod_too_long_does_not_fit(excess):
    with pytest.raises(lx.AssemblyError, match=r"joint '._pin' does not close: a gap of .* m remains"):
        run(parallelogram(excess), {"a": SPEED})


@pytest.mark.slow
def test_pivots_in_one_point():
    """A coupler of no length is free to turn, whatever the rods do."""
    mechanism = parallelogram(place=0.0, width=0.0)
    state, found = run(mechanism, {"a": SPEED, "a_pin": 3.0 - SPEED})
    assert lx.mobility(mechanism, state).degrees_of_freedom == 2 + 1
    np.testing.assert_allclose(found.joint("a"), pendulum(np.asarray(found.ts)), atol=1e-10)
    angle = found.joint("a") + found.joint("a_pin")
    np.testing.assert_allclose(angle, 3.0 * found.ts, atol=1e-10)


def door(tilt, fits):
    """A panel on two hinges of which the upper is tilted; the panel `fits` where it is made for that, at angle zero."""
    turned = lambda angle: np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    panel = lx.box("panel", [1.0, 0.1, 2.0], 10.0)
    edge = np.array([-0.5, 0.0, -1.0])
    top = panel.at(edge + np.array([0.0, 0.0, 1.0]), jnp.asarray(turned(tilt if fits else 0.0)))
    joints = [
        lx.Revolute("lower", lx.GROUND, panel.at(edge), axis="z"),
        lx.Revolute("upper", lx.GROUND.at([0.0, 0.0, 1.0], jnp.asarray(turned(tilt))), top, axis="z", cut=True),
    ]
    return lx.Mechanism([panel], joints)


@pytest.mark.parametrize("tilt", 10.0 ** np.arange(-8.0, -2.0))
def test_a_hinge_out_of_line_contradicts_the_other(tilt):
    with pytest.raises(lx.AssemblyError, match=r"joint 'upper' does not close: a gap of .* rad remains"):
        lx.assemble(door(tilt, fits=False), {"lower": 0.0})


@pytest.mark.parametrize("tilt", 10.0 ** np.arange(-12.0, -2.0))
def test_a_hinge_at_an_angle_to_the_other_is_redundant_or_real(tilt):
    """Below the rank tolerance of 1e-6 it takes nothing away; above, the door is stuck and says so."""
    mechanism = door(tilt, fits=True)
    state = lx.assemble(mechanism, {"lower": 0.0})
    stuck = tilt > 1.5e-6
    assert lx.mobility(mechanism, state).degrees_of_freedom == (0 if stuck else 1)
    if stuck:
        with pytest.raises(lx.AssemblyError, match=r"the speed asked of joint 'lower' is missed by 1"):
            lx.assemble(mechanism, {"lower": 0.0}, {"lower": 1.0})
    else:
        turning = lx.assemble(mechanism, {"lower": 0.0}, {"lower": 1.0})
        np.testing.assert_allclose(turning.v, 1.0, atol=1e-12)


def renamed(joint, name):
    other = copy.copy(joint)
    object.__setattr__(other, "name", name)
    return other


@pytest.mark.slow
def test_every_type_of_joint_given_three_times():
    """Rows that are nothing but rounding, of joints that say what the tree says already, leave accelerations alone."""
    numbers, bodies, once, again = Numbers(3), [], [], []
    for kind in (kind for kind in KINDS if kind.can_carry):
        bodies.append(numbers.body(kind.__name__))
        once.append(numbers.joint(kind, kind.__name__, lx.GROUND, bodies[-1]))
        again += [renamed(once[-1], f"{kind.__name__}_{number}") for number in (1, 2)]
    found = []
    for joints in (once, [*once, *again]):
        mechanism = lx.Mechanism(bodies, joints, [lx.Gravity([0.0, -WEIGHT, 0.3])])
        topology, generator = mechanism.topology, np.random.default_rng(0)
        assert set(topology.joints[: topology.num_bodies]) == {joint.name for joint in once}
        q = retract(topology, neutral(topology, float), jnp.array(generator.normal(size=topology.num_speeds)))
        state = lx.State(q, jnp.array(generator.normal(size=topology.num_speeds)))
        assert lx.mobility(mechanism, state).degrees_of_freedom == topology.num_speeds
        at = lx.Solution.of_state(mechanism, state)
        found.append([at.acceleration(body.name) for body in bodies])
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)
