"""Inertia along joints, of geared rotors, against closed formulas, heavier bodies and MuJoCo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import four_bar, pendulum

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.dynamics import mass_matrix
from linkax.equations.system import system_of
from linkax.simulation.explain.diagnosis import massless_bodies

MASS, LENGTH, GRAVITY = 2.0, 0.7, 9.81
HANGING = lx.State(jnp.full(1, -np.pi / 2.0), jnp.zeros(1))


def geared(*inertias):
    """A pendulum with rotors at its hinge."""
    return pendulum(LENGTH, MASS, GRAVITY, [lx.JointInertia("hinge", inertia) for inertia in inertias])


def exact(angle, inertia):
    """The acceleration of the pendulum."""
    return -MASS * GRAVITY * LENGTH / 2.0 * jnp.cos(angle) / (MASS * LENGTH**2 / 3.0 + inertia)


def test_a_pendulum_swings_more_slowly():
    at = lambda inertia: lx.Solution.of_state(
        geared(inertia / 3.0, 2.0 * inertia / 3.0), lx.State(jnp.array([0.8]), jnp.array([2.0]))
    )
    acceleration, slope = jax.value_and_grad(lambda inertia: at(inertia).joint_acceleration("hinge")[0])(0.4)
    np.testing.assert_allclose(acceleration, exact(0.8, 0.4), rtol=1e-12)
    np.testing.assert_allclose(slope, jax.grad(exact, argnums=1)(0.8, 0.4), rtol=1e-12)
    np.testing.assert_allclose(at(0.4).kinetic_energy()[0], (MASS * LENGTH**2 / 3.0 + 0.4) * 2.0**2 / 2.0, rtol=1e-14)


def test_frequencies_and_inverse_dynamics_count_it():
    mechanism = geared(0.4)
    found = lx.linearise(mechanism, HANGING)
    np.testing.assert_allclose(found.natural_frequencies, [np.sqrt(-jax.grad(exact)(-np.pi / 2.0, 0.4))], rtol=1e-10)
    needed = lx.inverse_dynamics(mechanism, HANGING, {"hinge": 3.0})
    np.testing.assert_allclose(needed.forces["hinge"], [3.0 * (MASS * LENGTH**2 / 3.0 + 0.4)], rtol=1e-12)


NAMES = ("crank_bearing", "crank_pin", "rocker_pin", "rocker_bearing")


def parallelogram(*rotors, heavier=0.0, cut=None):
    """A parallelogram whose crank turns at 6 rad/s, heavier about its pivot than a rod is [kg m²], and its state."""
    plain = four_bar(rocker=0.4, cut=cut, forces=rotors)
    along = heavier * np.diag([0.0, 0.0, 1.0])
    crank = eqx.tree_at(lambda body: body.inertia, plain.bodies[0], plain.bodies[0].inertia + along)
    mechanism = lx.Mechanism([crank, *plain.bodies[1:]], plain.joints, plain.forces)
    turns = np.array([-1.0 if name == "crank_pin" else 1.0 for name in mechanism.topology.coordinates])
    return mechanism, lx.State(0.9 * turns, 6.0 * turns)


@pytest.mark.parametrize("cut", [None, "crank_bearing"], ids=["in the tree", "closing the loop"])
def test_a_rotor_at_a_crank_is_a_heavier_crank(cut):
    rotor = lx.JointInertia("crank_bearing", 0.3)
    found, other = (lx.Solution.of_state(*of) for of in (parallelogram(rotor, cut=cut), parallelogram(heavier=0.3)))
    for body in ("crank", "coupler", "rocker"):
        np.testing.assert_allclose(found.acceleration(body), other.acceleration(body), rtol=1e-10)
    for name in NAMES:
        np.testing.assert_allclose(found.reaction(name), other.reaction(name), atol=1e-9)


def test_rotors_at_all_joints_of_a_loop_keep_the_energy():
    mechanism, state = parallelogram(*(lx.JointInertia(name, 0.1) for name in NAMES))
    assert set(NAMES) == set(mechanism.topology.speeds)
    solution = lx.simulate(mechanism, state, t1=1.0)
    bodies = sum(
        body.mass * np.sum(solution.velocity(body.name) ** 2, axis=-1)
        + body.inertia[2, 2] * solution.angular_velocity(body.name)[:, 2] ** 2
        for body in mechanism.bodies
    )
    speeds = np.sum(solution.v**2, axis=1)
    np.testing.assert_allclose(solution.kinetic_energy(), (bodies + 0.1 * speeds) / 2.0, rtol=1e-12)
    assert np.ptp(solution.energy()) <= 1e-6 * np.max(solution.kinetic_energy())
    assert solution.work() == {}


def test_alike_along_the_turns_of_a_ball_it_is_that_of_a_sphere():
    moments = np.array([0.2, 0.3, 0.4])
    state = lx.State(jnp.array([0.5, 0.1, -0.7, 0.5]), jnp.array([1.0, -2.0, 3.0]))

    def ball(heavier, *rotors):
        body = lx.RigidBody("body", 1.0, [0.1, 0.2, 0.3], moments + heavier)
        return lx.Mechanism([body], [lx.Spherical("ball", lx.GROUND, body)], [lx.Gravity([0.0, 0.0, -9.81]), *rotors])

    rotors = [lx.JointInertia(("ball", index), 0.15) for index in range(3)]
    found, other = (lx.Solution.of_state(of, state) for of in (ball(0.0, *rotors), ball(0.15)))
    np.testing.assert_allclose(found.joint_acceleration("ball"), other.joint_acceleration("ball"), rtol=1e-12)


def test_the_mass_matrix_is_that_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    generator, count = np.random.default_rng(0), 8
    spec = mujoco.MjSpec()
    bodies, joints, rotors, others = [], [], [], [spec.worldbody]
    for index in range(count):
        carrier = int(generator.integers(-1, index)) if index else -1
        place, axis, center = generator.normal(size=(3, 3))
        root = generator.normal(size=(3, 3))
        inertia = np.trace(root @ root.T) * np.eye(3) - root @ root.T
        mass, armature, slides = 0.5 + generator.random(), generator.random(), bool(generator.integers(2))
        axis /= np.linalg.norm(axis)
        bodies.append(lx.RigidBody(f"body_{index}", mass, center, inertia))
        on = lx.GROUND if carrier < 0 else bodies[carrier]
        joints.append((lx.Prismatic if slides else lx.Revolute)(f"joint_{index}", on.at(place), bodies[-1], axis))
        rotors.append(lx.JointInertia(f"joint_{index}", armature))
        others.append(
            others[carrier + 1].add_body(
                name=f"body_{index}",
                pos=place,
                mass=mass,
                ipos=center,
                fullinertia=[*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]],
            )
        )
        kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
        others[-1].add_joint(name=f"joint_{index}", type=kind, axis=axis, armature=armature)
    mechanism, model = lx.Mechanism(bodies, joints, rotors), spec.compile()
    order = [model.joint(name).qposadr[0] for name in mechanism.topology.speeds]
    data, q = mujoco.MjData(model), generator.normal(size=count)
    data.qpos[order] = q
    mujoco.mj_forward(model, data)
    expected = np.zeros((count, count))
    mujoco.mj_fullM(model, data, expected)
    found = jax.jit(lambda q: mass_matrix(configure(system_of(mechanism, float), 0.0, q)))(jnp.asarray(q))
    np.testing.assert_allclose(found, expected[np.ix_(order, order)], atol=1e-12 * np.max(expected))


def test_its_force_is_read_by_accelerations():
    here = lx.Solution.of_state(geared(0.4), HANGING)
    with pytest.raises(ValueError, match=r"JointInertia on 'hinge' .* read -inertia \* solution.joint_acceleration"):
        here.force("JointInertia on 'hinge'")
    assert "inertia 0.4 kg m²" in repr(here.mechanism)


def test_bodies_without_mass_move_with_it():
    """However little it is; the body that has none is named."""
    bodies = [lx.RigidBody(name, 0.0) for name in ("turning", "sliding", "loose")]
    kinds = {"turn": lx.Revolute, "slide": lx.Prismatic, "pin": lx.Revolute}
    joints = [kind(name, lx.GROUND, body, "z") for (name, kind), body in zip(kinds.items(), bodies, strict=True)]
    rotors = [lx.JointInertia("turn", 1e-9), lx.JointInertia("slide", 1e-12), lx.JointInertia("pin", 0.0)]
    system = system_of(lx.Mechanism(bodies, joints, rotors), float)
    assert massless_bodies(system, lx.TangentSpace().prepared(float), jnp.zeros(()), jnp.zeros(3)) == ["loose"]
