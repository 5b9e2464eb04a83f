"""MuJoCo's model of a `Description`, for MuJoCo and MJX: a tree, and loops closed by soft constraints ("connect")."""

import mujoco
import numpy as np

from benchmarks.peers.description import GROUND, Description

TYPES = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
# Impedance of the loops: as good as rigid at any gap. MuJoCo's default is softer near zero.
RIGID = (0.9999, 0.9999, 0.001, 0.5, 2.0)


def model_of(
    description: Description, integrator: str, step: float, decay_steps: float | None, **options
) -> mujoco.MjModel:
    """A model whose coordinates are the description's, in the order of `places`.

    **Arguments:**

    - `integrator`: of `mujoco.mjtIntegrator`, without its prefix. `step` [s].
    - `decay_steps`: time in which gaps of loops decay, critically damped, in steps; None for MuJoCo's default of 20 ms
      and its soft impedance.
    - `options`: others of `mujoco.MjOption`.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    settings = {
        "timestep": step,
        "gravity": description.gravity,
        "integrator": getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}"),
        "tolerance": 1e-12,
        "disableflags": mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET,
    }
    for name, entry in (settings | options).items():
        setattr(spec.option, name, entry)
    _add_bodies(spec, description)
    softness = {} if decay_steps is None else {"solref": [decay_steps * step, 1.0], "solimp": RIGID}
    for joint, point in description.loop_points:
        first, second = sorted((joint.parent, joint.child), reverse=True)  # ground, -1, second
        data = np.zeros(mujoco.mjNEQDATA)
        data[:3] = point - description.centers[first]
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=description.bodies[first].name,
            name2="world" if second == GROUND else description.bodies[second].name,
            data=data,
            **softness,
        )
    return spec.compile()


def places(model: mujoco.MjModel, description: Description) -> np.ndarray:
    """Where in qpos and in qvel the description's coordinates are, (n,); MuJoCo goes depth first."""
    return np.array([model.joint(joint.name).qposadr[0] for joint in description.tree])


def _add_bodies(spec, description):
    frames = {GROUND: spec.worldbody}
    for index, (body, joint) in enumerate(zip(description.bodies, description.tree, strict=True)):
        inertia = body.inertia
        frames[index] = frames[joint.parent].add_body(
            name=body.name,
            pos=body.center - description.centers[joint.parent],
            mass=body.mass,
            fullinertia=[*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]],
            ipos=np.zeros(3),  # without which `MjSpec` gives the inertia other places and axes
        )
        frames[index].add_joint(
            name=joint.name, type=TYPES[joint.kind], pos=joint.anchor - body.center, axis=joint.axis
        )
