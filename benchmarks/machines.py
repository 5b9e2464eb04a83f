"""Machines from files and ready-made ones: what is found in them, and their motion beside other tools.

Of files, `found`: of each loops, degrees of freedom, redundant rows, and how far open `linkax.assemble` leaves loops,
relative to their length. `pinocchio`: accelerations against `constraintDynamics`, a proximal solve with hard loops, of
a model with the same numbers, at twenty states of a motion. `mujoco`: how far a motion of one second is from MuJoCo's,
whose equalities are soft, as they are stiffened with shorter steps.

Of the scenes of machines, `pins`: of an excavator and a Delta robot, let go without motors, how far pins that close
loops are apart at most [m] here, and in MuJoCo as it comes and stiffened; and the largest force at each pin [N].
`hoberman`: rings of up to 480 struts, their rank, the time of one evaluation of their equations of motion [µs], and how
far from the closed form a motor opens rings of 240 struts, relative to their outer radius.

`python -m benchmarks.machines [PART ...]` prints one JSON object.
"""

import argparse
import dataclasses
import json
import warnings
from pathlib import Path

import diffrax
import mujoco
import numpy as np

import linkax as lx
from benchmarks.evaluation import cost
from linkax.scenes import SCENES

FILES = Path(__file__).parents[1] / "tests" / "data" / "machines"
IGNORED = ("contact", "limit", "friction", "actuator", "tendon", "inertia", "joint")
ALL = (
    "cassie_v2.sdf", "cassie.sdf", "cassie_reduced.sdf", "cassie_simple.sdf", "cassie_wo_gearbox_spring.sdf",
    "robotiq_2f85_v2.xml", "xarm7_gripper.xml", "constraints.xml",
)  # fmt: skip
GRIPPERS = ("robotiq_2f85_v2", "xarm7_gripper")
OF_HINGES = (("robotiq_2f85_v2.xml", None), ("xarm7_gripper.xml", None), ("cassie_v2.sdf", "fixed"))
STATES = 20
STEPS = (2e-3, 1e-3, 5e-4, 2.5e-4, 1.25e-4)
STIFF = 2.0  # steps in which MuJoCo's gaps decay
FALL = 0.3  # of pins [s]
SOFTNESS = {"default": None, **{f"stiffened, step {step}": step for step in (1e-3, 1e-4)}}
RINGS = ((12, 1), (24, 1), (48, 1), (120, 1), (240, 1), (24, 2), (24, 3), (24, 5))  # pairs in a ring, rings
OPENED = ((120, 1), (24, 5))  # whose motion is compared, of 240 struts


def load(name, *ignore, base=None):
    """A machine, without warnings of what is left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lx.LeftOutWarning)
        return lx.load(FILES / name, ignore=[*IGNORED, *ignore], base=base, whole_angles=True)


def found(name):
    """What linkax finds in a file."""
    mechanism = load(name).mechanism()
    state = lx.assemble(mechanism)
    mobility = lx.mobility(mechanism, state)
    return {
        "bodies": mechanism.topology.num_bodies,
        "loops": mechanism.topology.num_cuts,
        "degrees_of_freedom": int(mobility.degrees_of_freedom),
        "redundant_rows": int(mobility.num_redundant),
        "distance": float(mobility.distance),
        "gap": float(lx.Solution.of_state(mechanism, state).worst_violation().position),
    }


def falling(machine, times):
    """The motion of a gripper that falls shut from rest."""
    mechanism = machine.mechanism()
    state = lx.assemble(mechanism)
    return lx.simulate(mechanism, state, t1=times[-1], saveat=diffrax.SaveAt(ts=times), accuracy=lx.PRECISE)


def cut_at_balls(machine):
    """The same machine with its loops cut at balls, where every carrier is a hinge."""
    balls = [joint.kind is lx.Spherical for joint in machine.joints]
    cut = lambda joint: dataclasses.replace(joint, arguments={**joint.arguments, "cut": True})
    joints = (cut(joint) if ball else joint for joint, ball in zip(machine.joints, balls, strict=True))
    return dataclasses.replace(machine, joints=tuple(joints))


def depth_first(predecessor, root=-1):
    """The bodies of a tree, each before those that it carries, branch by branch."""
    for body, carrier in enumerate(predecessor):
        if carrier == root:
            yield body
            yield from depth_first(predecessor, body)


def in_pinocchio(mechanism):
    """Pinocchio's model of a tree of hinges and welds, and its loops, which balls close."""
    import pinocchio

    topology, model = mechanism.topology, pinocchio.Model()
    carried = {"ground": (0, pinocchio.SE3.Identity())}  # of a body: the joint that carries it, and its pose there
    pose = lambda frame: pinocchio.SE3(np.array(frame.rotation.array), np.array(frame.offset))
    for number in depth_first(topology.predecessor):  # as Pinocchio's sparse factorisation takes joints
        body, joint = mechanism.bodies[number], mechanism.joints[number]
        index, place = carried[joint.parent.body]
        place, child = place * pose(joint.parent), pose(joint.child).inverse()
        if joint.speed_units:
            hinge = pinocchio.JointModelRevoluteUnaligned(joint.axis.array)
            index, place = model.addJoint(index, hinge, place, joint.name), pinocchio.SE3.Identity()
        carried[body.name] = index, place * child
        inertia = pinocchio.Inertia(float(body.mass), np.array(body.center_of_mass), np.array(body.inertia))
        model.appendBodyToJoint(index, inertia, carried[body.name][1])
    gravity = next(np.array(force.acceleration) for force in mechanism.forces if isinstance(force, lx.Gravity))
    model.gravity = pinocchio.Motion(np.concatenate([gravity, np.zeros(3)]))
    armature = np.zeros(model.nv)
    for force in mechanism.forces:
        if isinstance(force, lx.JointInertia):
            armature[model.idx_vs[model.getJointId(force.joint.joint)]] = force.inertia
    model.armature = armature
    loops = pinocchio.StdVec_RigidConstraintModel()
    for joint in mechanism.joints[topology.num_bodies :]:
        (first, at), (second, there) = carried[joint.parent.body], carried[joint.child.body]
        kind, axes = pinocchio.ContactType.CONTACT_3D, pinocchio.ReferenceFrame.LOCAL
        places = (first, at * pose(joint.parent), second, there * pose(joint.child))
        loops.append(pinocchio.RigidConstraintModel(kind, model, *places, axes))
    return model, loops


def beside_pinocchio(name, base):
    """Largest relative difference of accelerations, without springs, dampers and couplings."""
    import pinocchio

    machine = load(name, "spring", "damping", base=base)
    if machine.constraints:
        machine = machine.without(*(part.name for part in machine.constraints))
    machine = cut_at_balls(machine)
    model, loops = in_pinocchio(machine.mechanism())
    data, loop_data = model.createData(), pinocchio.StdVec_RigidConstraintData()
    for loop in loops:
        loop_data.append(loop.createData())
    pinocchio.initConstraintDynamics(model, data, loops, loop_data)
    solution = falling(machine, np.linspace(0.02, 0.4, STATES))
    names = [model.names[index] for index in range(1, model.njoints)]
    angles, rates, accelerations = (
        np.stack([np.asarray(read(joint)).reshape(STATES) for joint in names], axis=1)
        for read in (solution.joint, solution.joint_speed, solution.joint_acceleration)
    )
    settings = pinocchio.ProximalSettings(1e-14, 1e-10, 100)
    apart = []
    for q, v, wanted in zip(angles, rates, accelerations, strict=True):
        theirs = pinocchio.constraintDynamics(model, data, q, v, np.zeros(model.nv), loops, loop_data, settings)
        apart.append(np.abs(theirs - wanted).max() / np.abs(wanted).max())
    return {"loops": len(loops), "worst": max(apart)}


def beside_mujoco(name):
    """How far bodies are from MuJoCo's over a second, relative to how far they move, by MuJoCo's step."""
    times = np.linspace(0.0, 1.0, 101)
    machine = load(f"{name}.xml")
    ours = falling(machine, times)
    rows = {}
    for step in STEPS:
        spec = mujoco.MjSpec.from_file(str(FILES / f"{name}.xml"))
        theirs = stiffened(spec, step, times, machine)
        places = {body: np.asarray(ours.position(body)) for body in theirs}
        moved = max(np.abs(place - place[0]).max() for place in places.values())
        rows[step] = max(np.abs(place - theirs[body]).max() for body, place in places.items()) / moved
    return rows


def stiffened(spec, step, times, machine):
    """MuJoCo's places of all bodies, with equalities that decay in a few steps."""
    for geom in [geom for geom in spec.geoms if geom.meshname]:
        if not (FILES / spec.meshdir / spec.mesh(geom.meshname).file).is_file():
            spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if not (FILES / spec.meshdir / mesh.file).is_file()]:
        spec.delete(mesh)
    spec.option.timestep, spec.option.tolerance, spec.option.iterations = step, 1e-14, 200
    for flag in ("CONTACT", "LIMIT", "FRICTIONLOSS", "ACTUATION"):
        spec.option.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    stiffen(spec.equalities, step)
    model = spec.compile()
    data = mujoco.MjData(model)
    bodies = [name for name in (part.name for part in machine.bodies) if mujoco.mj_name2id(model, 1, name) >= 0]
    places = {name: [] for name in bodies}
    for time in times:
        while data.time < time - step / 2:
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for name in bodies:
            places[name].append(data.body(name).xipos.copy())
    return {name: np.array(place) for name, place in places.items()}


def stiffen(equalities, step):
    """Let gaps of MuJoCo's equalities decay in a few steps."""
    for equality in equalities:
        equality.solref, equality.solimp = [STIFF * step, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]


def pins(name):
    """How far pins are open in a fall, here and in MuJoCo, and what they carry."""
    scene = SCENES[name]
    parameters = scene.settings("held")
    held = scene.mechanism(parameters)
    mechanism = lx.Mechanism(held.bodies, held.joints, held.forces)
    start = scene.initial(mechanism, parameters)
    solution = lx.simulate(mechanism, start, t1=FALL)
    forces = {name: float(np.linalg.norm(found.force, axis=-1).max()) for name, found in solution.reactions().items()}
    text = lx.to_mjcf(mechanism, state=start)
    theirs = {name: open_in_mujoco(text, step) for name, step in SOFTNESS.items()}
    return {"linkax": float(solution.worst_violation().position), "mujoco": theirs, "force": forces}


def open_in_mujoco(text, step):
    """The largest distance [m] between two points that MuJoCo connects; None: its own step and softness."""
    spec = mujoco.MjSpec.from_string(text)
    if step is not None:
        spec.option.timestep, spec.option.tolerance, spec.option.iterations = step, 1e-14, 200
        stiffen(spec.equalities, step)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    worst = 0.0
    while data.time < FALL:
        mujoco.mj_step(model, data)
        gaps = data.efc_pos[: data.ne].reshape(-1, 3)
        worst = max(worst, np.linalg.norm(gaps, axis=1).max())
    return worst


def rings(pairs, count):
    """Rank and cost of a ring of scissors, or several, as drawn."""
    scene, changes = SCENES["hoberman"], {"pairs": pairs, "rings": count, "angle": 1.3 * np.pi / pairs}
    mechanism = scene.mechanism(scene.settings(changes=changes | {"motor": 2}))
    topology = mechanism.topology
    state = lx.State(np.zeros(topology.num_coordinates), np.zeros(topology.num_speeds), topology)
    mobility, price = lx.mobility(mechanism, state), cost(mechanism, state)
    return {
        "struts": 2 * pairs * count,
        "bodies": topology.num_bodies,
        "joints": topology.num_bodies + topology.num_cuts,
        "rank": int(mobility.rank),
        "redundant_rows": int(mobility.num_redundant),
        "degrees_of_freedom": int(mobility.degrees_of_freedom),
        "us": price["us"],
        "compile_s": price["compile_s"],
    } | ({"from_closed_form": opened(scene, changes)} if (pairs, count) in OPENED else {})


def opened(scene, changes):
    """How far inner and outer pins are from the closed form while a motor opens the rings."""
    settings = scene.settings(changes=changes | {"angle": 0.3, "angle_change": 0.3, "duration": 0.5})
    mechanism, times = scene.mechanism(settings), np.linspace(0.0, 0.5, 6)
    start, saveat = scene.initial(mechanism, settings), diffrax.SaveAt(ts=times)
    solution = lx.simulate(mechanism, start, t1=times[-1], saveat=saveat, accuracy=lx.Accuracy(rtol=1e-10))
    exact, points = scene.exact(settings, times), scene.points(settings)
    apart = [np.abs(solution.position(*where) - exact[point]).max() for point, where in points.items()]
    return max(apart) / np.abs(exact["outer"]).max()


PARTS = {
    "found": lambda: {name: found(name) for name in ALL},
    "pinocchio": lambda: {name: beside_pinocchio(name, base) for name, base in OF_HINGES},
    "mujoco": lambda: {name: beside_mujoco(name) for name in GRIPPERS},
    "pins": lambda: {name: pins(name) for name in ("excavator", "delta")},
    "hoberman": lambda: [rings(*counts) for counts in RINGS],
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART")
    asked = parser.parse_args().parts or list(PARTS)
    print(json.dumps({part: PARTS[part]() for part in asked}, indent=2))


if __name__ == "__main__":
    main()
