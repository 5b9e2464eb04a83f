"""Kinematics, dynamics and loop rows against automatic differentiation and the laws of mechanics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import POOL, crank_slider

import linkax as lx
from linkax.equations import dynamics, kinematics, loops
from linkax.equations.reactions import cut_reactions, reactions
from linkax.equations.system import system_of
from linkax.spatial.rotations import cross


def state_of(mechanism, seed=0):
    generator = np.random.default_rng(seed)
    size = mechanism.topology.num_coordinates
    return jnp.array(generator.normal(size=size)), jnp.array(generator.normal(size=size))


def poses(system, q):
    configuration = kinematics.configure(system, q)
    return configuration.world_center_of_mass(), configuration.rotation[:-1]


def kinetic_energy(system, q, v):
    """From positions alone, independent of the recursions for twists."""
    (_, turn), (velocity, turn_rate) = jax.jvp(lambda q: poses(system, q), (q,), (v,))
    spin = jnp.einsum("bij,bkj->bik", turn_rate, turn)
    omega = jnp.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1)
    inertia = jnp.einsum("bij,bjk,blk->bil", turn, system.inertia, turn)
    return (jnp.sum(system.mass[:, None] * velocity**2) + jnp.einsum("bi,bij,bj", omega, inertia, omega)) / 2


@jax.jit
def recursions(system, q, v):
    configuration = kinematics.configure(system, q)
    motion, cuts = kinematics.move(configuration, v), loops.cut_frames(configuration)
    return {
        "mass": dynamics.mass_matrix(configuration),
        "force": dynamics.generalised_force(0.0, motion),
        "kinetic": dynamics.kinetic_energy(motion),
        "jacobian": loops.jacobian(cuts),
        "gamma": loops.bias(cuts, motion),
        "residual": loops.residual(cuts),
    }


@jax.jit
def oracle(system, q, v):
    residual = lambda q: loops.residual(loops.cut_frames(kinematics.configure(system, q)))
    potential = lambda q: dynamics.potential_energy(kinematics.configure(system, q))
    momentum = lambda q: jax.grad(kinetic_energy, 2)(system, q, v)
    rate = lambda q: jax.jvp(residual, (q,), (v,))[1]
    lagrange = jax.jvp(momentum, (q,), (v,))[1] - jax.grad(kinetic_energy, 1)(system, q, v) + jax.grad(potential)(q)
    return {
        "mass": jax.hessian(kinetic_energy, 2)(system, q, v),
        "force": -lagrange,
        "kinetic": kinetic_energy(system, q, v),
        "jacobian": jax.jacfwd(residual)(q),
        "gamma": -jax.jvp(rate, (q,), (v,))[1],
    }


@pytest.mark.parametrize("name", POOL)
def test_recursions_agree_with_lagrange_and_differentiation(name):
    system = system_of(POOL[name], float)
    for seed in range(3):
        q, v = state_of(POOL[name], seed)
        found, known = recursions(system, q, v), oracle(system, q, v)
        for what, exact in known.items():
            scale = np.max(np.abs(exact), initial=1.0)
            np.testing.assert_allclose(found[what], exact, atol=1e-12 * scale, err_msg=what)
        np.testing.assert_allclose(found["mass"], found["mass"].T, atol=1e-12 * np.max(found["mass"]))


def test_rows_that_were_left_out_never_change():
    for cut in (None, "bearing", "crank_pin", "guide"):
        mechanism = crank_slider(cut=cut)
        assert mechanism.topology.num_rows == 2
        system = system_of(mechanism, float)
        q, _ = state_of(mechanism)
        immobile = lambda q, system=system: loops.immobile_residual(loops.cut_frames(kinematics.configure(system, q)))
        np.testing.assert_allclose(jax.jacfwd(immobile)(q), 0.0, atol=1e-15)
        np.testing.assert_allclose(immobile(q), 0.0, atol=1e-15)


def test_far_from_the_origin_nothing_is_lost():
    near, far = crank_slider(), crank_slider(offset=(1e6, -2e6, 0.0))
    q, v = state_of(near)
    found, known = recursions(system_of(far, float), q, v), recursions(system_of(near, float), q, v)
    for what in known:
        np.testing.assert_allclose(found[what], known[what], rtol=1e-12, atol=1e-13, err_msg=what)


@pytest.mark.parametrize("name", POOL)
def test_reactions_balance_every_body_and_do_no_work(name):
    mechanism = POOL[name]
    system, topology = system_of(mechanism, float), mechanism.topology
    q, v = state_of(mechanism)
    generator = np.random.default_rng(5)
    acceleration = jnp.array(generator.normal(size=topology.num_coordinates))
    configuration = kinematics.configure(system, q)
    motion, cuts = kinematics.move(configuration, v), loops.cut_frames(configuration)
    multipliers = jnp.array(generator.normal(size=topology.num_rows))

    # Table 3: the power of the cut joints' wrenches is that of the multipliers.
    found = cut_reactions(cuts, multipliers)
    parent, child, joints = loops.bodies_of_cuts(topology)
    velocity = lambda body, arm: motion.velocity[body] + cross(motion.angular_velocity[body], arm)
    place = configuration.child_arm[joints]
    on_child = velocity(child, place)
    to_point = configuration.parent_arm[joints] + cuts.separation
    on_parent = velocity(parent, to_point)
    power = jnp.sum(found.force * (on_child - on_parent))
    power += jnp.sum(found.moment * (motion.angular_velocity[child] - motion.angular_velocity[parent]))
    np.testing.assert_allclose(power, multipliers @ (loops.jacobian(cuts) @ v), rtol=1e-11)

    # Tree joints: what they leave along their own speeds is M v̇ - f - Jᵀλ.
    every = reactions(0.0, motion, cuts, acceleration, multipliers)
    body = topology.column_body
    sign = np.where(topology.reversed[body], -1.0, 1.0)[:, None]
    along = jnp.sum(sign * (every.force[body] * configuration.sliding + every.moment[body] * configuration.angular), -1)
    left = dynamics.mass_matrix(configuration) @ acceleration - dynamics.generalised_force(0.0, motion)
    left = left - loops.jacobian(cuts).T @ multipliers
    np.testing.assert_allclose(along, left, atol=1e-11 * np.max(np.abs(left)))


def test_reactions_do_not_depend_on_the_tree():
    """The same motion with each joint of the loop cut in turn."""
    angle, rate, found = 0.7, 1.5, {}
    for cut in ("bearing", "crank_pin", "wrist_pin", "guide"):
        mechanism = crank_slider(cut=cut)
        guess = {"bearing": angle, "crank_pin": -1.2, "wrist_pin": 0.5, "guide": 1.9}
        guess = {name: entry for name, entry in guess.items() if name in mechanism.topology.coordinates}
        state = lx.assemble(mechanism, {"bearing": angle}, {"bearing": rate}, guess=guess)
        system = system_of(mechanism, float)
        instant = lx.TangentSpace(jnp.asarray(1e-10)).dynamics(system, 0.0, state.q, state.v)
        motion = kinematics.move(kinematics.configure(system, state.q), state.v)
        cuts = loops.cut_frames(motion.configuration)
        every = reactions(0.0, motion, cuts, instant.acceleration, instant.multipliers)
        index = {name: place for place, name in enumerate(mechanism.topology.joints)}
        found[cut] = {name: every.force[place] for name, place in index.items()}
    for cut, forces in found.items():
        for name, force in forces.items():
            np.testing.assert_allclose(force, found["guide"][name], atol=1e-11, err_msg=f"{name}, {cut} cut")


def test_orders_of_joints_give_the_same_motion():
    forwards, backwards = crank_slider(), crank_slider(order=-1)
    energies = []
    for mechanism in (forwards, backwards):
        state = lx.assemble(mechanism, {"bearing": 0.6}, {"bearing": 1.0})
        system = system_of(mechanism, float)
        energies.append(recursions(system, state.q, state.v)["kinetic"])
    np.testing.assert_allclose(*energies, rtol=1e-12)
