"""Machines beside MuJoCo: states in its coordinates, and what both compute of a tree; loops, which no tree has."""

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.dynamics import generalised_force, mass_matrix
from linkax.equations.motion import move
from linkax.equations.system import system_of

FREE, BALL = (kind.value for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL))


def rotation(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


def random_state(mechanism, rng):
    topology = mechanism.topology
    q = rng.normal(size=topology.num_coordinates)
    for start, _ in topology.quaternions:
        q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    return lx.State(jnp.asarray(q), jnp.asarray(rng.normal(size=topology.num_speeds)), topology)


def state_of(mechanism, start):
    """The state at a start that a file names, of joints in the tree alone."""
    order = mechanism.topology.coordinates
    flat = lambda given: np.concatenate([np.atleast_1d(given[name]) for name in order if name in given])
    return lx.State(jnp.asarray(flat(start.positions)), jnp.asarray(flat(start.speeds)), mechanism.topology)


def positions(model, mechanism, names, q):
    """qpos at coordinates; `names` are those of MuJoCo's joints in linkax."""
    qpos = np.array(model.qpos0)
    for index, name in enumerate(names):
        joint, own = model.joint(index), np.array(q[mechanism.topology.coordinates[name]])
        at = joint.qposadr[0]
        if joint.type[0] == FREE:
            here = rotation(qpos[at + 3 : at + 7])
            turned = here * rotation(own[:4])
            qpos[at : at + 7] = [*(qpos[at : at + 3] + here.apply(own[4:])), *turned.as_quat(scalar_first=True)]
        elif joint.type[0] == BALL:
            qpos[at : at + 4] = own
        else:
            qpos[at] += own[0]
    return qpos


def matrix_of_speeds(model, mechanism, names, qpos):
    """The matrix from qvel, and qacc, to linkax's speeds: of balls and free bodies in the parent's axes."""
    found = np.zeros((mechanism.topology.num_speeds, model.nv))
    for index, name in enumerate(names):
        joint = model.joint(index)
        row, dof, at = mechanism.topology.speeds[name], joint.dofadr[0], joint.qposadr[0]
        if joint.type[0] == FREE:
            drawn = rotation(model.body_quat[joint.bodyid[0]]).as_matrix().T
            found[row.start : row.start + 3, dof + 3 : dof + 6] = drawn @ rotation(qpos[at + 3 : at + 7]).as_matrix()
            found[row.start + 3 : row.stop, dof : dof + 3] = drawn
        elif joint.type[0] == BALL:
            found[row, dof : dof + 3] = rotation(qpos[at : at + 4]).as_matrix()
        else:
            found[row, dof] = 1.0
    return found


@jax.jit
def tree_dynamics(mechanism, state):
    """The mass matrix, the generalised force with that of inertia at zero acceleration, and centres of mass."""
    configuration = configure(system_of(mechanism, np.float64), 0.0, state.q)
    motion = move(configuration, state.v)
    return mass_matrix(configuration), generalised_force(motion), configuration.world_center_of_mass()


def check_loops(mechanism, expected, state=None):
    """Numbers of loops, degrees of freedom and redundant rows; and loops closed at a state, or else at a found one."""
    state = lx.assemble(mechanism) if state is None else state
    found = lx.mobility(mechanism, state)
    assert (mechanism.topology.num_cuts, found.degrees_of_freedom, found.num_redundant) == expected
    open_by = eqx.filter_jit(lambda state: lx.Solution.of_state(mechanism, state).worst_violation().position)
    assert open_by(state) < 1e-12
