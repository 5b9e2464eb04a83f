"""Rows of loops long enough to be solved cell by cell."""

import numpy as np
import pytest
from known_answers import start

import linkax as lx
from linkax.equations.system import system_of
from linkax.formulations.formulation import coefficients
from linkax.linalg.chained_inverse import ChainedInverse
from linkax.scenes import SCENES

COUNT = 8
SETTINGS = {"N": COUNT, "angle": 0.0, "speed": -2.0}


@pytest.fixture(scope="module")
def row():
    """A row of four-bars with every right joint twice, all links in line."""
    mechanism, state = start("n-four-bar", "A02", SETTINGS)
    tip = {body.name: body.at("tip") for body in mechanism.bodies}
    again = [lx.Spherical(f"again_{i}", tip[f"coupler_{i}"], tip[f"link_{i}"]) for i in range(1, COUNT + 1)]
    return lx.Mechanism(mechanism.bodies, [*mechanism.joints, *again], mechanism.forces), state


def test_from_a_singular_configuration_through_others_with_redundant_loops(row):
    mechanism, state = row
    chain = mechanism.topology.chain
    assert len(chain.added) >= COUNT
    found = lx.simulate(mechanism, state, t1=4.0)
    exact = SCENES["n-four-bar"].exact(SCENES["n-four-bar"].settings("A02", SETTINGS), found.ts)["B0"]
    assert np.max(np.linalg.norm(found.position("link_0", at="tip") - exact, axis=-1)) <= 1e-6
    assert found.closest < 1e-2
    # Two of each cell's rows; the cell that only prepares the next has none.
    assert sorted(found.rank_nearby) == [0] * (len(chain.added) - COUNT) + [2] * COUNT
    assert np.max(np.abs(found.violation().position)) <= 1e-14


def test_accelerations_and_corrections_are_those_of_all_loops_at_once(row):
    mechanism, _ = row
    _, upright = start("n-four-bar", "A02", {"N": COUNT, "angle": 1.0})
    system, rng = system_of(mechanism, float), np.random.default_rng(0)
    for metric in ("mass", "identity"):
        method = lx.Accuracy(metric=metric).method(float)
        given = coefficients(system, 0.0, upright.q)
        f, gamma = rng.normal(size=len(upright.v)), given.jacobian @ rng.normal(size=len(upright.v))
        by_cells = method._solve(method._split(given), given, f, gamma, sweeps=1)[0]
        at_once = method._solve(method._split_at_once(given), given, f, gamma, sweeps=1)[0]
        np.testing.assert_allclose(by_cells, at_once, atol=1e-11)
        assert isinstance(method._split(given), ChainedInverse)
