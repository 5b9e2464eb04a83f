"""Kinematics, dynamics, loop rows and reactions against differentiation of positions, and the laws of mechanics.

Numbers are drawn at random, loops are open, and accelerations and multipliers are what they may: these laws hold all
the same, and each topology compiles once.
"""

from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_answers import start
from mechanisms import POOL, crank_slider, with_cut

import linkax as lx
from linkax.equations import dynamics, loops
from linkax.equations.configuration import bodies_of_cuts, configure
from linkax.equations.constraint_rows import constraint_load
from linkax.equations.coordinates import neutral, on_manifold, rates, retract
from linkax.equations.motion import move
from linkax.equations.reactions import cut_reactions, reactions, seen_from
from linkax.equations.system import system_of
from linkax.equations.tree_sums import sum_by_speed
from linkax.model.beams import BeamElasticity
from linkax.spatial.vectors import cross

SIDES = ("child", "parent")
STORING = (lx.Gravity, lx.Spring, lx.JointSpring, lx.ElasticRope, BeamElasticity)
DRAWS = settings(max_examples=4, deadline=None, derandomize=True, database=None)


def state_of(mechanism, seed=0):
    """Coordinates, speeds, accelerations and multipliers, any of them."""
    generator, topology = np.random.default_rng(seed), mechanism.topology
    q = retract(topology, neutral(topology, float), jnp.array(generator.normal(size=topology.num_speeds)))
    v, acceleration = (jnp.array(generator.normal(size=topology.num_speeds)) for _ in range(2))
    return q, v, acceleration, jnp.array(generator.normal(size=topology.num_rows))


def poses(system, t, q):
    configuration = configure(system, t, on_manifold(system.topology, q))
    return configuration.world_center_of_mass(), configuration.rotation[:-1]


def twists(system, t, q, v):
    """Velocities of centres of mass and angular velocities, from positions alone."""
    (_, turn), (velocity, turn_rate) = jax.jvp(lambda q: poses(system, t, q), (q,), (rates(system.topology, q, v),))
    spin = jnp.einsum("bij,bkj->bik", turn_rate, turn)
    return velocity, jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1)


def kinetic_energy(system, t, q, v):
    velocity, omega = twists(system, t, q, v)
    return (
        jnp.sum(system.mass[:, None] * velocity**2)
        + jnp.einsum("bi,bij,bj", omega, inertia(system, t, q), omega)
        + along_joints(system) @ v**2
    ) / 2


def along_joints(system):
    """Inertia that elements add along speeds."""
    added = jnp.zeros(system.topology.num_speeds)
    for force in system.forces:
        if isinstance(force, lx.JointInertia):
            added = added.at[system.topology.column(force.joint)].add(force.inertia)
    return added


def inertia(system, t, q):
    turn = poses(system, t, q)[1]
    return jnp.einsum("bij,bjk,blk->bil", turn, system.inertia, turn)


def momentum(system, t, q, v):
    """Linear momentum, and angular momentum about the world's origin."""
    velocity, omega = twists(system, t, q, v)
    linear = system.mass[:, None] * velocity
    spin = jnp.einsum("bij,bj->bi", inertia(system, t, q), omega)
    return jnp.sum(linear, axis=0), jnp.sum(cross(poses(system, t, q)[0], linear) + spin, axis=0)


@jax.jit
def laws(mechanism, t, q, v, acceleration, multipliers):
    """Pairs of what the equations say, and what differentiation and laws say."""
    system, topology = system_of(mechanism, float), mechanism.topology
    configuration = configure(system, t, q)
    motion = move(configuration, v)
    mass, force = dynamics.mass_matrix(configuration), dynamics.generalised_force(motion)
    load = dynamics.applied_load(motion)
    applied = load.joint_force + dynamics.along_speeds(configuration, load.force, load.moment)
    jacobian, residual = loops.jacobian(configuration), loops.residual(configuration)
    along = lambda function, v_dot: jax.jvp(function, (t, q, v), (jnp.ones(()), rates(topology, q, v), v_dot))[1]

    # Newton and Euler for each body, along the speeds that move it.
    by_speed = jax.jacfwd(lambda v: twists(system, t, q, v))(v)
    linear_bias, angular_bias = along(lambda t, q, v: twists(system, t, q, v), jnp.zeros_like(v))
    tensor, omega = inertia(system, t, q), motion.angular_velocity[:-1]
    spin = jnp.einsum("bij,bj->bi", tensor, angular_bias) + cross(omega, jnp.einsum("bij,bj->bi", tensor, omega))
    needed = jnp.einsum("bi,bin->n", system.mass[:, None] * linear_bias, by_speed[0])
    needed = needed + jnp.einsum("bi,bin->n", spin, by_speed[1])
    of_masses = jnp.einsum("b,bin,bim->nm", system.mass, by_speed[0], by_speed[0])
    of_inertia = jnp.einsum("bin,bij,bjm->nm", by_speed[1], tensor, by_speed[1])

    # Loop rows: ċ = J v − b and c̈ = J v̇ − γ.
    rows = lambda t, q, v: loops.residual(configure(system, t, q))
    rate = lambda t, q, v: jax.jvp(lambda t, q: rows(t, q, v), (t, q), (jnp.ones(()), rates(topology, q, v)))[1]

    # Reactions, for any accelerations and multipliers.
    every, cut = reactions(motion, acceleration, multipliers), cut_reactions(configuration, multipliers)
    parent, child, joints = bodies_of_cuts(topology)
    velocity = lambda body, arm: motion.velocity[body] + cross(motion.angular_velocity[body], arm)
    on_parent = velocity(parent, configuration.parent_arm[joints] + configuration.separation)
    power = jnp.sum(cut.force * (velocity(child, configuration.child_arm[joints]) - on_parent))
    power += jnp.sum(cut.moment * (motion.angular_velocity[child] - motion.angular_velocity[parent]))
    of_constraints = multipliers[topology.num_rows - topology.num_constraint_rows :] / system.constraint_scales
    asked = jnp.zeros_like(v)
    if system.constraints:
        pull = constraint_load(configuration, of_constraints)
        at_mass = motion.velocity[:-1] + cross(motion.angular_velocity[:-1], configuration.center_of_mass())
        power += jnp.sum(pull.force * at_mass + pull.moment * motion.angular_velocity[:-1])
        asked = pull.joint_force
    body = topology.moved_body
    sign = jnp.where(topology.reversed[body], -1.0, 1.0)[:, None]
    left = jnp.sum(sign * (every.force[body] * configuration.sliding + every.moment[body] * configuration.angular), -1)
    left = sum_by_speed(topology, left)
    # Of a joint that bends the reaction has the joint's own forces in it.
    bends = np.array([topology.joint_types[body].motion is not None for body, _ in topology.motions])
    own = np.isin(np.arange(topology.num_speeds), topology.motions[bends, 1])
    along_own = load.joint_force + asked - along_joints(system) * acceleration
    left = left - jnp.where(own, along_own, 0.0)
    # On the parent, at its own frame: both sides of a joint balance about the world's origin.
    on_parents = seen_from(configuration, every, "parent", "ground")
    places = [
        jnp.stack([configuration.point_position(getattr(joint, side)) for joint in mechanism.joints]) for side in SIDES
    ]
    about_origin = [r.moment + cross(place, r.force) for r, place in zip((every, on_parents), places, strict=True)]
    along_axes = seen_from(configuration, every, "child", "joint")
    axes = [
        configuration.rotation[configuration.body(joint.child.body)] @ joint.frames()[1] for joint in mechanism.joints
    ]
    solved = jnp.linalg.solve(mass, force + jacobian.T @ multipliers)
    energy = along(lambda t, q, v: kinetic_energy(system, t, q, v), solved)
    stored = along(lambda t, q, v: dynamics.potential_energy(configure(system, t, q)), solved)
    storing = [force for force in system.forces if isinstance(force, STORING)]
    loads = reduce(lx.Load.plus, [force.applied(t, motion) for force in storing], lx.Load.none(system))
    released = loads.joint_force + dynamics.along_speeds(configuration, loads.force, loads.moment)
    momenta = jnp.concatenate(along(lambda t, q, v: momentum(system, t, q, v), solved))
    return {
        "velocities": (motion.velocity[:-1] + cross(omega, configuration.center_of_mass()), twists(system, t, q, v)[0]),
        "mass": (mass, of_masses + of_inertia + jnp.diag(along_joints(system))),
        "symmetry": (mass, mass.T),
        "force": (force, applied - needed),
        "kinetic energy": (dynamics.kinetic_energy(motion), kinetic_energy(system, t, q, v)),
        "loop rates": (jacobian @ v - loops.rate(configuration), rate(t, q, v)),
        "loop Jacobian": (jacobian, jax.jacfwd(lambda v: rate(t, q, v))(v)),
        "loop bias": (-loops.gamma(motion), along(rate, jnp.zeros_like(v))),
        "residual": (residual, rows(t, q, v)),
        "Table 3": (power + asked @ v, multipliers @ (jacobian @ v)),
        "tree joints": (left, mass @ acceleration - force - jacobian.T @ multipliers),
        "parent's side": (about_origin[0], -about_origin[1]),
        "joint axes": (jnp.einsum("jab,jb->ja", jnp.stack(axes), along_axes.moment), every.moment),
        "power in": (energy, applied @ v + multipliers @ (jacobian @ v)),
        "potential energy": (-stored, released @ v),
        "speeds": (v, jnp.concatenate([motion.joint_speeds(name) for name in topology.speeds])),
    }, momenta


def drawn(name, seed):
    mechanism = POOL[name](seed)
    return laws(mechanism, jnp.array(0.3), *state_of(mechanism, seed))


# Joints of most other types are in "floating" and "driven" in the tree, and in "cut" cut.
QUICK = ("planar", "Screw", "floating", "cut", "driven")


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in POOL]
)
def test_laws(name):
    @DRAWS
    @given(st.integers(0, 10_000))
    def holds(seed):
        for what, (found, exact) in drawn(name, seed)[0].items():
            scale = np.max(np.abs(exact), initial=1.0)
            np.testing.assert_allclose(found, exact, atol=1e-10 * scale, err_msg=what)

    holds()


def test_momentum_without_outer_force():
    np.testing.assert_allclose(drawn("floating", 3)[1], 0.0, atol=1e-10)


def test_rows_that_were_left_out_never_change():
    for cut in (None, "bearing", "crank_pin", "guide"):
        mechanism = crank_slider(cut=cut)
        assert mechanism.topology.num_rows == 2
        system = system_of(mechanism, float)
        q = state_of(mechanism)[0]
        immobile = lambda q, system=system: loops.immobile_residual(configure(system, 0.0, q))
        np.testing.assert_allclose(jax.jacfwd(immobile)(q), 0.0, atol=1e-15)
        np.testing.assert_allclose(immobile(q), 0.0, atol=1e-15)


def test_far_from_the_origin_nothing_is_lost():
    near, far = crank_slider(), crank_slider(offset=(1e6, -2e6, 0.0))
    here, there = (laws(mechanism, jnp.zeros(()), *state_of(near))[0] for mechanism in (near, far))
    for what in ("mass", "force", "kinetic energy", "loop Jacobian", "loop bias", "residual"):
        np.testing.assert_allclose(there[what][0], here[what][0], rtol=1e-12, atol=1e-13, err_msg=what)


@pytest.mark.slow
def test_reactions_do_not_depend_on_the_tree():
    """A spatial loop with a redundant row at one state, each joint cut in turn: what is unique is the same."""
    mechanism, state = start("bricard", changes={"angle": 0.9, "speed": 2.0})
    coordinates = configure(system_of(mechanism, float), 0.0, state.q).joint_coordinates
    joints = {name: coordinates(name)[0] for name in mechanism.topology.joints}
    found = {}
    for cut in ("P1", "P4"):
        other = with_cut(mechanism, cut)
        q = jnp.array([joints[name] for name in other.topology.coordinates])
        # Speeds of the angles are a', b' of the relation sin a sin b + sin a + sin b = 0, in turn.
        a, b = joints["P1"], joints["P2"]
        rate = -2.0 * np.cos(a) * (1.0 + np.sin(b)) / (np.cos(b) * (1.0 + np.sin(a)))
        v = jnp.array([2.0 if name in ("P1", "P3", "P5") else rate for name in other.topology.coordinates])
        here = lx.Solution.of_state(other, lx.State(q, v))
        found[cut] = {name: (here.reaction(name), here.reaction_unique(name)) for name in joints}
    for name in joints:
        (reaction, unique), *others = (found[cut][name] for cut in found)
        for reaction_there, unique_there in others:
            for part, other, sure, sure_there in zip(reaction, reaction_there, unique, unique_there, strict=True):
                np.testing.assert_array_equal(sure, sure_there, err_msg=name)
                np.testing.assert_allclose(jnp.where(sure, part - other, 0.0), 0.0, atol=1e-10, err_msg=name)
