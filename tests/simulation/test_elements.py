"""Forces, lengths and work of single elements, and accelerations of joints and bodies."""

import pickle

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

GRAVITY, TORQUE, RATE = 9.81, 0.7, 3.0


def machine(damping=0.4):
    """A bob on a rod without mass, between a spring, a damper and a slack rope, beside a driven and a braked rotor."""
    bob, rotor, wheel = (
        lx.point_mass("bob", 2.0),
        lx.RigidBody("rotor", 1.0, inertia=[0.1, 0.2, 0.3]),
        lx.rod("w", 1, 1),
    )
    joints = [
        lx.Prismatic("x", lx.GROUND, carriage := lx.point_mass("carriage", 0.0), "x"),
        lx.Prismatic("y", carriage, bob, "y"),
        lx.Revolute("motor", lx.GROUND, rotor, "z"),
        lx.Revolute("axle", rotor, wheel, "z"),
        lx.Planar("measure", lx.GROUND, bob, "z", cut=True),
    ]
    top = lx.GROUND.at([0.0, 3.0, 0.0])
    forces = [
        lx.Gravity([0.0, -GRAVITY, 0.0]),
        lx.Spring(bob, top, 5.0, 0.5, name="spring"),
        lx.Damper(lx.GROUND.at([1.0, 0.0, 0.0]), bob, damping),
        lx.Damper(lx.GROUND.at([1.0, 0.0, 0.0]), bob, damping),
        lx.ElasticRope([bob, top], 3.0, 9.0, name="slack"),
        lx.JointTorque("axle", TORQUE),
    ]
    constraints = [
        lx.Distance("rod", lx.GROUND, bob, 2.0),
        lx.Drive("drive", "motor", lambda t: RATE * t + jnp.sin(t)),
    ]
    return lx.Mechanism([carriage, bob, rotor, wheel], joints, forces, constraints)


def moving(mechanism):
    x, y = 2.0 * np.sin(0.4), -2.0 * np.cos(0.4)
    of = {"x": (x, 1.5), "y": (y, -1.5 * x / y), "motor": (0.0, RATE + 1.0), "axle": (0.0, 0.2)}
    return lx.State(*map(jnp.stack, zip(*(of[name] for name in mechanism.topology.coordinates), strict=True)))


@pytest.fixture(scope="module")
def solution():
    mechanism = machine()
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 0.5, 26))
    return lx.simulate(mechanism, moving(mechanism), t1=0.5, accuracy=lx.PRECISE, saveat=saveat)


@pytest.mark.slow
def test_force_and_length_by_name_and_by_element(solution):
    place, velocity = np.asarray(solution.position("bob")), np.asarray(solution.velocity("bob"))
    from_top, anchor = place - np.array([0.0, 3.0, 0.0]), place - np.array([1.0, 0.0, 0.0])
    length, distance = np.linalg.norm(from_top, axis=1), np.linalg.norm(anchor, axis=1)
    np.testing.assert_allclose(solution.length("spring"), length, rtol=1e-12)
    np.testing.assert_allclose(solution.force("spring"), 5.0 * (length - 0.5), rtol=1e-12)
    np.testing.assert_array_equal(solution.force("slack"), 0.0)
    rate = np.sum(anchor * velocity, axis=1) / distance
    damper = "Damper on body 'ground' and body 'bob'"
    np.testing.assert_allclose(solution.force(f"{damper} (2)"), 0.4 * rate, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(solution.force(solution.mechanism.forces[1]), solution.force("spring"))
    np.testing.assert_allclose(solution.length("rod"), 2.0, rtol=1e-13)
    # All forces along the rod hold the bob on its circle.
    along = place / 2.0
    springs = -5.0 * (length - 0.5) / length * np.sum(from_top * along, axis=1)
    dampers = -2.0 * 0.4 * rate / distance * np.sum(anchor * along, axis=1)
    inward = 2.0 * np.sum(velocity**2, axis=1) / 2.0 + springs + dampers - 2.0 * GRAVITY * along[:, 1]
    np.testing.assert_allclose(solution.force("rod"), inward, rtol=1e-9)
    np.testing.assert_allclose(solution.force("drive"), solution.reaction("drive"))


@pytest.mark.parametrize(
    ("read", "told"),
    [
        (
            lambda s: s.force("sprung"),
            r"unknown force, constraint or Distance 'sprung' \(did you mean 'spring'\?\); known: 'Gravity', 'spring'",
        ),
        (lambda s: s.force("Gravity"), "Gravity does not say which force it has; define strength"),
        (lambda s: s.force(s.mechanism.forces[2]), "several elements .* give each a name"),
        (lambda s: s.length("JointTorque on 'axle'"), "JointTorque on 'axle' has no length"),
    ],
)
def test_what_has_no_force_or_length_is_refused(solution, read, told):
    with pytest.raises(ValueError, match=told):
        read(solution)


@pytest.mark.parametrize(
    ("read", "told"),
    [
        (lambda s: s.work()["slak"], r"element that does work 'slak' \(did you mean 'slack'\?\); known: .*, 'slack', "),
        (lambda s: s.reactions()["mottor"], r"unknown joint 'mottor' \(did you mean 'motor'\?\); known: .*'axle'"),
        (lambda s: s.poses()["bobb"], r"unknown body 'bobb' \(did you mean 'bob'\?\); known: .*'w'"),
        (lambda s: s.mechanism.topology.coordinates["z"], "unknown joint in the tree 'z'; known: .*'x'"),
        (lambda s: lx.mobility(s.mechanism, s.end).joint_equations["rodd"], "joint or constraint 'rodd' .* known: "),
    ],
)
def test_readings_by_name_say_which_names_there_are(solution, read, told):
    with pytest.raises(KeyError, match=told):
        read(solution)


def test_readings_by_name_pass_through_programs(solution):
    """They are dictionaries to JAX and to pickle, too."""
    work = solution.work()
    twice = jax.jit(lambda work: jax.tree.map(lambda done: 2.0 * done, work))(work)
    for copied in (twice, pickle.loads(pickle.dumps(work))):
        assert list(copied) == list(work)
        with pytest.raises(KeyError, match="did you mean 'slack'"):
            copied["slak"]
    np.testing.assert_array_equal(twice["drive"], 2.0 * work["drive"])
    assert jax.tree_util.keystr(jax.tree.leaves_with_path(work)[-1][0]) == "['drive']"


def test_names_of_forces_are_unique():
    arm = lx.rod("arm", 1.0, 1.0)
    hinge = lx.Revolute("hinge", lx.GROUND, arm, "z")
    with pytest.raises(ValueError, match="joint, constraint or force 'hinge' appears 2 times"):
        lx.Mechanism([arm], [hinge], [lx.JointDamper("hinge", 1.0, name="hinge")])


def test_accelerations_are_rates_of_speeds(solution):
    rate = lambda values: np.gradient(np.asarray(values), np.asarray(solution.ts), axis=0, edge_order=2)
    for joint in ("x", "motor", "axle"):
        np.testing.assert_allclose(solution.joint_acceleration(joint), rate(solution.joint_speed(joint)), atol=5e-2)
    np.testing.assert_allclose(solution.joint_acceleration("motor"), -np.sin(solution.ts), atol=1e-12)
    turning = solution.joint_acceleration("motor") + solution.joint_acceleration("axle")
    measured = solution.joint_acceleration("measure")[:, 1:]
    np.testing.assert_allclose(measured, solution.acceleration("bob")[:, :2], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solution.angular_acceleration("w")[:, 2], turning, rtol=1e-10)


def test_work_accounts_for_the_energy(solution):
    work = solution.work()
    damper = "Damper on body 'ground' and body 'bob'"
    assert list(work) == [damper, f"{damper} (2)", "slack", "JointTorque on 'axle'", "drive"]
    turned = np.asarray(solution.joint("axle"))
    np.testing.assert_allclose(work["JointTorque on 'axle'"], TORQUE * (turned - turned[0]), atol=1e-10)
    change = np.asarray(solution.energy() - solution.energy()[0])
    assert np.max(np.abs(change)) > 0.3
    np.testing.assert_allclose(sum(work.values()), change, atol=1e-8)
    np.testing.assert_allclose(solution.unaccounted_energy(), 0.0, atol=1e-8)
    power = sum(map(np.asarray, solution.power()))
    np.testing.assert_allclose(np.gradient(change, np.asarray(solution.ts), edge_order=2), power, atol=5e-2)


@pytest.mark.slow
def test_work_of_a_batch_that_ends_early():
    mechanism = machine()
    state, saveat = moving(mechanism), diffrax.SaveAt(ts=np.linspace(0.0, 0.5, 26))
    run = lambda damping: lx.simulate(machine(damping), state, t1=0.5, saveat=saveat, max_steps=6, throw=False)
    solution = jax.vmap(run)(jnp.array([0.4, 0.8]))
    reached = np.isfinite(solution.ts)
    assert 3 < np.sum(reached[0]) < 26
    left = np.asarray(solution.unaccounted_energy())
    np.testing.assert_allclose(left[reached], 0.0, atol=1e-5)
    assert np.all(np.isinf(solution.work()["drive"])[~reached])
