"""Models drawn in the world: bodies placed, rods between points, and joints that measure."""

import re
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import linkax as lx

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # x to y
DRAWN = {"lx.rod_between": lx.rod_between, "RigidBody.placed": lx.RigidBody.placed}
OTHERS = {"lx.Free": lx.Free, "lx.Rectangular": lx.Rectangular, "lx.assemblies": lx.assemblies}


def run(documented):
    """What the examples of a docstring leave."""
    names = {"lx": lx}
    for block in re.findall(r"```python\n(.*?)```", documented.__doc__, re.DOTALL):
        exec(textwrap.dedent(block), names)
    return names


@pytest.mark.parametrize("name", DRAWN | OTHERS)
def test_examples_of_docstrings_run(name):
    names = run((DRAWN | OTHERS)[name])
    if name == "lx.rod_between":
        np.testing.assert_allclose(names["state"].q, 0.0, atol=1e-12)
    if name == "lx.Free":
        tip = lx.Solution.of_state(names["robot"], names["state"]).position("wrist", at="tip")[0]
        np.testing.assert_allclose(tip[:2], [0.8, 0.7], atol=1e-9)
    if name == "lx.assemblies":
        tip = lambda state: lx.Solution.of_state(names["four_bar"], state).position("rocker", at="tip")[0, 1]
        assert tip(names["up"]) > 0.0 > tip(names["down"])
    if name == "lx.Rectangular":
        found = lx.Solution.of_state(names["table"], names["state"])
        np.testing.assert_allclose(found.position("puck")[0], [0.2, 0.3, 0.0], atol=1e-15)


def test_a_rod_between_points_is_a_rod_placed():
    base, along = np.array([1.0, 2.0, 3.0]), np.array([0.0, 2.0, 0.0])
    found = lx.rod_between("bar", base, base + along, mass=3.0, thickness=0.4)
    rod = lx.rod("bar", length=2.0, mass=3.0, thickness=0.4).placed(base, TURN)
    for of_found, of_rod in zip(jax.tree.leaves(found), jax.tree.leaves(rod), strict=True):
        np.testing.assert_allclose(of_found, of_rod, atol=1e-15)
    np.testing.assert_allclose(np.diag(rod.inertia), [3.0 * (1 / 3 + 0.01), 0.06, 3.0 * (1 / 3 + 0.01)])
    np.testing.assert_allclose(found.at_world(base + along).offset, found.frames["tip"])
    slope = jax.grad(lambda tip: lx.rod_between("bar", base, tip, 3.0).inertia[0, 0])(jnp.asarray(base + along))
    np.testing.assert_allclose(slope, [0.0, 3.0 * 2.0 * 2.0 / 12.0, 0.0])
    refused(lambda: lx.rod("bar", 1.0, 1.0).at_world([0.0, 0.0, 0.0]), "'bar'", "placed")
    refused(lambda: lx.rod_between("bar", base, base, 1.0), "'bar'", "0.0")
    refused(lambda: lx.rod("bar", 1.0, 1.0, thickness=-0.1), "'bar'", "-0.1")


def test_a_flat_body_has_one_moment_of_inertia():
    np.testing.assert_allclose(lx.RigidBody("plate", 2.0, inertia=0.3).inertia, np.diag([0.15, 0.15, 0.3]))


def test_a_cut_cross_slide_holds_what_it_says():
    """Both directions in the plane are free, the third and all turns are not."""
    puck = lx.box("puck", [0.1, 0.2, 0.3], 1.0)
    joints = [lx.Free("afloat", lx.GROUND, puck), lx.Rectangular("table", lx.GROUND, puck, axis="x", cut=True)]
    mechanism = lx.Mechanism([puck], joints)
    assert mechanism.topology.num_rows == 4
    begin = [1.0, 0.1, -0.2, 0.1, 0.3, 0.5, 0.6]
    state = lx.assemble(mechanism, {"table": [0.4, 0.7]}, {"table": [1.0, 2.0]}, guess={"afloat": begin})
    np.testing.assert_allclose(state.q, [1.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.7], atol=1e-9)
    np.testing.assert_allclose(state.v, [0.0, 0.0, 0.0, 0.0, 1.0, 2.0], atol=1e-9)
