"""Rows of loops long enough to be solved front by front."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import mechanism_of, start

import linkax as lx
from linkax.equations.structure import structure_of
from linkax.equations.system import system_of
from linkax.formulations.formulation import linear_system
from linkax.linalg.block_elimination import BlockInverse
from linkax.scenes import SCENES

COUNT = 8
SETTINGS = {"N": COUNT, "angle": 0.0, "speed": -2.0}


@pytest.fixture(scope="module")
def row():
    """A row of four-bars with every right joint twice, all links in line."""
    mechanism = mechanism_of("n-four-bar", "A02", SETTINGS)
    tip = {body.name: body.at("tip") for body in mechanism.bodies}
    again = [lx.Spherical(f"again_{i}", tip[f"coupler_{i}"], tip[f"link_{i}"]) for i in range(1, COUNT + 1)]
    return lx.Mechanism(mechanism.bodies, [*mechanism.joints, *again], mechanism.forces)


@pytest.mark.slow
def test_from_a_singular_configuration_through_others_with_redundant_loops(row):
    _, state = start("n-four-bar", "A02", SETTINGS)
    plan = structure_of(row.topology).elimination
    assert len(plan.interior) >= COUNT
    found = lx.simulate(row, state, t1=4.0)
    exact = SCENES["n-four-bar"].exact(SCENES["n-four-bar"].settings("A02", SETTINGS), found.ts)["B0"]
    assert np.max(np.linalg.norm(found.position("link_0", at="tip") - exact, axis=-1)) <= 1e-6
    assert found.closest < 1e-2
    # Two of each front's rows; the front that only prepares the next has none.
    assert sorted(found.rank_nearby) == [0] * (len(plan.interior) - COUNT) + [2] * COUNT
    assert np.max(np.abs(found.violation().position)) <= 1e-14


def test_accelerations_and_corrections_are_those_of_all_loops_at_once(row):
    q = jnp.array([1.0 if name.startswith("pivot") else -1.0 for name in row.topology.coordinates])
    system, rng = system_of(row, float), np.random.default_rng(0)

    @eqx.filter_jit
    def solved(method, f, v):
        given = linear_system(system, 0.0, q)
        by_fronts = method.split(given)
        assert isinstance(by_fronts, BlockInverse)
        splits, gamma = (by_fronts, method._split_at_once(given)), given.jacobian @ v
        return [method.solve_accelerations(given, split, f, gamma, 1)[0] for split in splits]

    for metric in ("mass", "identity"):
        by_fronts, at_once = solved(lx.TangentSpace(metric=metric).prepared(float), *rng.normal(size=(2, len(q))))
        np.testing.assert_allclose(by_fronts, at_once, atol=1e-11)
