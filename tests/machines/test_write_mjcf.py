"""Mechanisms as MJCF: MuJoCo moves what linkax moves, and linkax reads back what it wrote."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from beside_mujoco import random_state, state_of
from mechanisms import four_bar
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.dynamics import mass_matrix
from linkax.equations.system import system_of
from linkax.model.numbers import value


def body(name, rng):
    """A body whose principal axes and centre of mass are anywhere."""
    points = rng.normal(size=(6, 3))
    inertia = np.sum([np.dot(p, p) * np.eye(3) - np.outer(p, p) for p in points], axis=0) * 0.02
    return lx.RigidBody(name, rng.uniform(0.5, 2.0), rng.normal(size=3) * 0.3, inertia, {"tip": rng.normal(size=3)})


def frame(on, rng):
    return on.at(rng.normal(size=3), Rotation.random(rng=rng).as_matrix())


def spatial_tree():
    """Joints of all types in the tree, half of them from child to parent, with forces that are MuJoCo's, too."""
    rng = np.random.default_rng(3)
    kinds = {
        "float": lx.Free, "hinge": lx.Revolute, "ball": lx.Spherical, "cross": lx.Universal, "sleeve": lx.Cylindrical,
        "plate": lx.Planar, "table": lx.Rectangular, "weld": lx.Fixed, "slide": lx.Prismatic, "back": lx.Spherical,
        "held": lx.Free, "bearing": lx.Revolute, "link": lx.Universal, "tray": lx.Planar, "loose": lx.Free,
    }  # fmt: skip
    bodies, joints = {name: body(f"{name}_body", rng) for name in kinds}, []
    on = {"float": lx.GROUND, "table": lx.GROUND, "held": lx.GROUND, "bearing": lx.GROUND}
    for index, (name, kind) in enumerate(kinds.items()):
        carrier = on.get(name) or [bodies[other] for other in kinds][index - 1]
        ends = [frame(carrier, rng), frame(bodies[name], rng)]
        backwards = name in ("back", "held", "link", "tray", "loose", "slide")
        axis = {} if kind in (lx.Free, lx.Spherical, lx.Fixed) else {"axis": rng.normal(size=3)}
        joints.append(kind(name, *(ends[::-1] if backwards else ends), **axis))
    forces = [
        lx.Gravity([0.3, -0.2, -9.81]),
        lx.JointSpring("hinge", 3.0, 0.4),
        lx.JointSpring(("tray", 2), 5.0, -0.2),
        lx.JointDamper(("link", 1), 0.7),
        *(lx.JointDamper(("back", index), 0.4) for index in range(3)),
        lx.JointInertia("bearing", 0.3),
        lx.JointDamper(("held", 4), 0.2),
        lx.JointTorque("slide", -2.0, name="push"),
        lx.AffineActuator({"hinge": 1.5, "bearing": -0.5}, 0.6, gain=2.0, bias=[0.1, -3.0, -0.4], name="servo"),
        lx.AffineActuator(("cross", 1), 0.6, gain=[2.0, 0.1, 0.3], force_range=[-90.0, 90.0], name="twist"),
        lx.Spring(bodies["ball"].at("tip"), bodies["tray"].at("tip"), 20.0, 0.5, name="spring"),
        lx.Damper(bodies["hinge"].at("tip"), lx.GROUND, 3.0, name="damper"),
    ]
    return lx.Mechanism(bodies.values(), joints, forces)


@jax.jit
def mass_of(mechanism, state):
    return mass_matrix(configure(system_of(mechanism, np.float64), 0.0, state.q))


def matrix_to_mujoco(mechanism, state):
    """The matrix from linkax's speeds to qvel."""
    qvel = lambda v: lx.mujoco_trajectory(lx.State(state.q, v, mechanism.topology), mechanism)[1]
    return np.array([qvel(row) for row in np.eye(mechanism.topology.num_speeds)]).T


def test_a_tree_of_all_joints_moves_as_in_linkax():
    """Places, mass matrix, and accelerations, which gyroscopic terms and all forces make, at random states."""
    mechanism, rng = spatial_tree(), np.random.default_rng(0)
    assert mechanism.topology.reversed.sum() == 6
    model = mujoco.MjModel.from_xml_string(lx.to_mjcf(mechanism))
    data, full, found = mujoco.MjData(model), np.zeros((model.nv, model.nv)), np.zeros(6)
    for _ in range(3):
        state = random_state(mechanism, rng)
        data.qpos, data.qvel = lx.mujoco_trajectory(state, mechanism)
        mujoco.mj_forward(model, data)
        mujoco.mj_rnePostConstraint(model, data)
        mujoco.mj_fullM(model, data, full)
        mass, into = mass_of(mechanism, state), matrix_to_mujoco(mechanism, state)
        assert np.abs(into @ state.v - data.qvel).max() < 1e-13
        assert np.abs(into.T @ full @ into - mass).max() < 1e-10 * np.abs(mass).max()
        solution = lx.Solution.of_state(mechanism, state)
        for name, pose in solution.poses().items():
            assert np.abs(data.body(name).xpos - pose.position[0]).max() < 1e-12
            assert np.abs(data.body(name).xmat.reshape(3, 3) - pose.orientation[0]).max() < 1e-12
            mujoco.mj_objectAcceleration(model, data, mujoco.mjtObj.mjOBJ_BODY, data.body(name).id, found, 0)
            expected = [*solution.angular_acceleration(name)[0], *(solution.acceleration(name)[0] - model.opt.gravity)]
            assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


LOOPS = [
    ((lx.Spherical, lx.Universal, lx.Spherical), lx.Revolute, lx.Distance),
    ((lx.Revolute, lx.Cylindrical, lx.Universal), lx.Spherical),
    ((lx.Prismatic, lx.Spherical, lx.Planar), lx.Fixed),
    ((lx.Universal, lx.Universal, lx.Prismatic, lx.Universal), lx.Revolute),
    ((lx.Rectangular, lx.Revolute, lx.Spherical), lx.Revolute),
    ((lx.Planar, lx.Universal, lx.Cylindrical), lx.Fixed),
    ((lx.Free, lx.Revolute), lx.Spherical, lx.Distance),
    ((lx.Spherical, lx.Universal, lx.Revolute), lx.Revolute),
    ((lx.Cylindrical, lx.Spherical, lx.Prismatic), lx.Revolute),
    ((lx.Revolute, lx.Free), lx.Fixed),
    ((lx.Spherical, lx.Spherical), lx.Revolute),
]


def random_loop(kinds, cut, *rods, seed):
    """A loop that closes at the state, and not where coordinates are zero; joints lead either way.

    A spring and a damper hold its tips to the ground, and a rod if asked for.
    """
    rng = np.random.default_rng(seed)
    bodies = [body(f"body{index}", rng) for index in range(len(kinds))]
    joints = []
    for index, kind in enumerate(kinds):
        ends = [frame([lx.GROUND, *bodies][index], rng), frame(bodies[index], rng)]
        axis = {} if kind in (lx.Free, lx.Spherical) else {"axis": rng.normal(size=3)}
        joints.append(kind(f"joint{index}", *ends[:: rng.choice([-1, 1])], **axis))
    forces = [lx.Gravity([0.0, 0.0, -9.81])]
    forces += [lx.JointSpring(joint.name, 5.0, 0.3) for joint in joints if isinstance(joint, lx.Revolute)]
    forces.append(lx.Spring(lx.GROUND.at([0.3, 1.0, 0.0]), bodies[-1].at("tip"), 20.0, 0.5, name="tied"))
    forces.append(lx.Damper(bodies[0].at("tip"), bodies[-1].at("tip"), 3.0, name="damped"))
    state = random_state(tree := lx.Mechanism(bodies, joints), rng)
    drawn, on_ground = lx.Solution.of_state(tree, state), frame(lx.GROUND, rng)
    last, tip = drawn.poses()[bodies[-1].name], np.asarray(drawn.position(bodies[0].name, "tip")[0])
    into = np.asarray(last.orientation[0]).T
    end = bodies[-1].at(into @ (on_ground.offset - last.position[0]), into @ value(on_ground.rotation))
    axis = {"axis": rng.normal(size=3)} if cut is lx.Revolute else {}
    foot = np.array([0.2, 0.1, 3.0])
    joints += [rod("rod", bodies[0].at("tip"), lx.GROUND.at(foot), np.linalg.norm(tip - foot)) for rod in rods]
    closed = lx.Mechanism(bodies, [*joints, cut("cut", on_ground, end, cut=True, **axis)], forces)
    q = [state.q[tree.topology.coordinates[name]] for name in closed.topology.coordinates]
    return closed, lx.State(jnp.concatenate(q), jnp.zeros_like(state.v), closed.topology)


def read_back(mechanism, state, path):
    """The mechanism that linkax reads from what it writes, with its start."""
    lx.to_mjcf(mechanism, path, state=state)
    machine = lx.load(path)
    found = machine.mechanism()
    return found, state_of(found, machine.starts["start"])


def check_that_motions_agree(mechanism, state, path):
    again = read_back(mechanism, state, path)
    assert {*again[0].topology.cut_types} == {*mechanism.topology.cut_types}
    motions = [
        lx.simulate(*each, t1=0.2, accuracy=lx.PRECISE, saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 0.2, 5)))
        for each in ((mechanism, state), again)
    ]
    poses = [motion.poses() for motion in motions]
    places = [np.array([of_body[name].position for name in mechanism.topology.bodies]) for of_body in poses]
    assert np.ptp(places[0], axis=1).max() > 1e-3
    assert np.abs(places[0] - places[1]).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("case", range(len(LOOPS)))
def test_linkax_reads_back_the_motion_that_it_writes(case, tmp_path):
    mechanism, state = random_loop(*LOOPS[case], seed=case)
    assert {*mechanism.topology.cut_types} == {*LOOPS[case][1:]}
    check_that_motions_agree(mechanism, state, tmp_path / "loop.xml")


@pytest.mark.slow
def test_linkax_reads_back_the_motion_of_a_four_bar(tmp_path):
    bodies, joints = parts_of_four_bar()
    mechanism = lx.Mechanism(bodies, joints, [lx.Gravity([0.0, -9.81, 0.0]), lx.JointSpring("crank_pin", 5.0, 0.3)])
    # The crank points away from the rocker's bearing: the others are sides of 2 m of a triangle with a base of 3 m.
    angle = np.arccos(0.75)
    of_joint = {"crank_bearing": np.pi, "crank_pin": angle - np.pi, "rocker_bearing": np.pi - angle}
    q = jnp.array([of_joint[name] for name in mechanism.topology.coordinates])
    state = lx.State(q, jnp.zeros(3), mechanism.topology)
    check_that_motions_agree(mechanism, state, tmp_path / "four_bar.xml")


def parts_of_four_bar():
    """Bodies and joints of a planar four-bar that is open where coordinates are zero; its cut joint is a hinge."""
    whole = four_bar(1.0, 2.0, 2.0, 2.0, cut="rocker_pin")
    hinges = "crank_bearing", "crank_pin", "rocker_pin", "rocker_bearing"
    return [whole.body(name) for name in ("crank", "coupler", "rocker")], [whole.joint(name) for name in hinges]


def gaps(text):
    """How far equalities are from zero at the keyframe, in MuJoCo."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data.efc_pos[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]


def test_loops_and_couplings_hold_at_the_keyframe(tmp_path):
    """Hinges, rods, threads and couplings of one, two and three coordinates."""
    bodies, joints = parts_of_four_bar()
    wheels = [body(name, np.random.default_rng(index)) for index, name in enumerate(("a", "b", "c", "d", "nut"))]
    joints += [lx.Revolute(f"{wheel.name}_bearing", lx.GROUND, wheel, axis="z") for wheel in wheels[:4]]
    joints.append(lx.Screw("screw", wheels[4], wheels[0], axis="z", pitch=0.05))
    constraints = [
        lx.Coupling("stop", {"a_bearing": 2.0}, 0.6),
        lx.Coupling("gears", {"a_bearing": 2.0, "b_bearing": 1.0}, 0.1),
        lx.Coupling("planets", {"a_bearing": 1.0, "b_bearing": 2.0, "c_bearing": -3.0}, 0.2),
        lx.PolynomialCoupling("cam", {"d_bearing": 2.0}, {"b_bearing": 3.0}, [0.1, 0.2, 0.3]),
        lx.Distance("rod", bodies[0].at("tip"), lx.GROUND.at([0.3, -2.0, 1.0]), 3.5),
    ]
    mechanism = lx.Mechanism([*bodies, *wheels], joints, constraints=constraints[:-1])
    state = lx.assemble(mechanism, {"crank_bearing": 0.5, "screw": 0.3})
    tip = lx.Solution.of_state(mechanism, state).position("crank", "tip")[0]
    length = float(jnp.linalg.norm(tip - jnp.array([0.3, -2.0, 1.0])))
    rod = lx.Distance("rod", bodies[0].at("tip"), lx.GROUND.at([0.3, -2.0, 1.0]), length)
    whole = lx.Mechanism([*bodies, *wheels], joints, constraints=[*constraints[:-1], rod])
    text = lx.to_mjcf(whole, tmp_path / "machine.xml", state=lx.State(state.q, state.v, whole.topology))
    assert (tmp_path / "machine.xml").read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["machine.xml"]
    found = gaps(text)
    assert len(found) == 6 + 5 + 1  # two connects, four couplings, a rod and a thread
    assert np.abs(found).max() < 1e-12
    # A keyframe where the loop is open is not closed.
    assert np.abs(gaps(lx.to_mjcf(whole, state=lx.State.as_drawn(whole)))).max() > 0.1


class Magnet(lx.AbstractForce):
    name: str = eqx.field(static=True, default="magnet")

    def load(self, t, motion):
        return lx.Load.none(motion.system)


(CRANK, COUPLER, ROCKER), HINGES = parts_of_four_bar()
CARDAN = lx.Universal("cardan", COUPLER.at("tip"), ROCKER.at("tip"), axis="z", cut=True)
BEAM = lx.Beam("boom", 1.0, lx.rectangle(0.1, 0.1, lx.Material(1e9, 0.3, 1e3)))
BALL = lx.Mechanism([CRANK], [lx.Spherical("ball", lx.GROUND, CRANK)], [lx.JointDamper(("ball", 0), 1.0)])
with_forces = lambda *forces: lx.Mechanism([CRANK, COUPLER, ROCKER], HINGES, forces)
REFUSED = [
    (lx.Mechanism([CRANK], [lx.ConstantVelocity("bent", lx.GROUND, CRANK, axis="z")]), "'bent' is a ConstantVelocity"),
    (lx.Mechanism([CRANK, COUPLER, ROCKER], [*HINGES[:2], CARDAN, HINGES[3]]),
     r"'cardan': MuJoCo closes no loop by a Universal; cut another .* by cut=True: 'crank_bearing' or .* ignore="),
    (lx.Mechanism([BEAM], [lx.Fixed("wall", lx.GROUND, BEAM.at("base"))]), "beam 'boom': MuJoCo has no such beam"),
    (with_forces(Magnet()), r"Magnet 'magnet': MuJoCo has no such force; or leave it out by ignore=\['Magnet'\]"),
    (with_forces(lx.JointTorque("crank_pin", lambda t, _: t)), "MuJoCo knows no functions of time; give a number"),
    (with_forces(lx.JointDamper("rocker_pin", 1.0)), "joint 'rocker_pin' is cut, and MuJoCo has no coordinate of it"),
    (with_forces(*2 * [lx.JointSpring("crank_pin", 1.0)]), "joint 'crank_pin' has two of its kind"),
    (BALL, r"joint 'ball': damping about its three axes is \[0.0, 1.0\]"),
    (lx.Mechanism([CRANK], HINGES[:1], constraints=[lx.Drive("motor", "crank_bearing", speed=1.0)]),
     r"no such equality.*ignore=\['Drive'\]"),
]  # fmt: skip


@pytest.mark.parametrize(("mechanism", "message"), REFUSED)
def test_what_mujoco_does_not_have_is_refused_by_name(mechanism, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        lx.to_mjcf(mechanism, tmp_path / "machine.xml")
    assert not [*tmp_path.iterdir()]


def test_wrong_calls_say_what_to_give(tmp_path):
    mechanism = with_forces(Magnet())
    left = lx.to_mjcf(mechanism, ignore=["Magnet"])
    assert left == lx.to_mjcf(mechanism, ignore="magnet") == lx.to_mjcf(with_forces())
    with pytest.raises(ValueError, match=r"cannot write .*; give another path"):
        lx.to_mjcf(mechanism, tmp_path / "missing" / "machine.xml", ignore="magnet")
    with pytest.raises(ValueError, match=r"give mujoco_trajectory\(state, mechanism\)"):
        lx.mujoco_trajectory(lx.State.as_drawn(mechanism))
    with pytest.raises(ValueError, match="outside of jit"):
        jax.jit(lambda mechanism: lx.to_mjcf(mechanism) and 0.0)(with_forces())


def test_stops_friction_and_motors_are_those_of_mujoco():
    law = lx.ContactLaw(1e3, damping=1.0)
    forces = [
        lx.JointLimit("crank_bearing", law, lower=-0.5, upper=2.0),
        lx.JointLimit("crank_pin", law, upper=1.0),
        *2 * [lx.JointFriction("crank_pin", 0.2, 0.01)],
        lx.JointTorque("crank_bearing", 3.0, name="motor"),
    ]
    model = mujoco.MjModel.from_xml_string(lx.to_mjcf(with_forces(*forces)))
    assert model.joint("crank_bearing").range.tolist() == [-0.5, 2.0]
    assert model.joint("crank_pin").range.tolist() == [-1e10, 1.0]
    assert model.jnt_limited.tolist() == [1, 1, 0]
    assert model.joint("crank_pin").frictionloss.tolist() == [0.4]
    data = mujoco.MjData(model)
    for control, torque in ((0.0, 3.0), (0.5, 3.5)):
        data.ctrl = control
        mujoco.mj_forward(model, data)
        assert data.actuator_force == [torque]
