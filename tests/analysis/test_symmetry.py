"""Symmetries of steady motions: where they lead, against an integration."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import linkax as lx
from linkax.analysis.symmetry import Symmetry, num_turns
from linkax.equations.coordinates import rates, retract, speeds
from linkax.equations.system import system_of


def test_a_symmetry_is_followed():
    """Slides on the ground turn about its origin, a ball and a free body about axes of their own, too."""
    block, bob, flyer = lx.point_mass("block", 1.0), lx.rod("bob", 1.0, 1.0), lx.rod("flyer", 1.0, 1.0)
    frame = lx.point_mass("frame", 1.0)
    joints = [
        lx.Prismatic("along", lx.GROUND, frame, "x"),
        lx.Prismatic("across", frame, block, "y"),
        lx.Spherical("ball", block, bob),
        lx.Free("flight", lx.GROUND, flyer),
    ]
    mechanism = lx.Mechanism([frame, block, bob, flyer], joints)
    topology, random = mechanism.topology, np.random.default_rng(1)
    q = retract(topology, lx.assemble(mechanism).q, random.normal(size=topology.num_speeds))
    v, turns = random.normal(size=topology.num_speeds), random.normal(size=num_turns(topology))
    assert len(turns) == 3 + 3 + 3 + 6
    symmetry = Symmetry.through(system_of(mechanism, float), jnp.zeros(()), q, v).turning(q, turns)
    along = jax.jit(lambda q: symmetry.along(q, v))
    follow = jax.jit(lambda q: symmetry.follow(q, jnp.eye(len(v)), jnp.asarray(3.0)))
    np.testing.assert_allclose(symmetry.speeds(q), v, atol=1e-14)

    flow = jax.jit(lambda q: rates(topology, q, symmetry.speeds(q)))
    exact = solve_ivp(lambda _, q: flow(q), (0.0, 3.0), q, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    after, changes = follow(q)
    sign = np.ones(len(q))
    for start, _ in topology.quaternions:
        sign[start : start + 4] = np.sign(after[start] * exact[start])  # q and −q are one
    np.testing.assert_allclose(after, sign * exact, atol=1e-10)
    step = 1e-5
    beside = lambda change: retract(topology, q, change)
    for index, direction in enumerate(step * np.eye(len(v))):
        difference = (follow(beside(direction))[0] - follow(beside(-direction))[0]) / (2.0 * step)
        np.testing.assert_allclose(changes[:, index], speeds(topology, after, difference), atol=1e-8)
    slope = (along(beside(step * v))[0] - along(beside(-step * v))[0]) / (2.0 * step)
    np.testing.assert_allclose(along(q)[1], slope, atol=1e-8)
