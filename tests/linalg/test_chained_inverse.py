"""Cell by cell the constrained solve gives what it gives at once, for rows of cells of any rank."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.linalg.chain import chained
from linkax.linalg.chained_inverse import SaddlePointInCells, in_cells, invert_chain, with_identity_metric
from linkax.linalg.constrained_solve import constrained_solve, invert
from linkax.linalg.sparse_products import Placed

TOLERANCE = 1e-9


class Row(NamedTuple):
    """Cells of so many speeds each, of which the next shares some; rows in each, of which so many are independent."""

    cells: int
    speeds: int
    shared: int
    rows: int
    rank: int


ROWS = {
    "four-bars": Row(9, 3, 1, 2, 2),
    "redundant": Row(6, 5, 2, 4, 2),
    "free": Row(5, 6, 3, 3, 1),
    "all decided": Row(5, 3, 1, 4, 2),
    "islands": Row(4, 4, 0, 3, 2),
    "one cell": Row(1, 4, 0, 2, 2),
}


class System(NamedTuple):
    mass: np.ndarray
    jacobian: np.ndarray
    units: np.ndarray
    chain: object
    force: np.ndarray
    rate: np.ndarray


def system(name, seed=0, massless=False):
    """A mechanism with speeds and rows in random order."""
    row, generator = ROWS[name], np.random.default_rng(seed)
    step = row.speeds - row.shared
    size = step * row.cells + row.shared
    place, units = generator.permutation(size), generator.choice([1.0, 0.2], size)
    mass, jacobian, read, coupled = np.diag(1.0 + generator.random(size)), [], [], []
    for cell in range(row.cells):
        speeds = place[cell * step : cell * step + row.speeds]
        root, first = generator.normal(size=(2, 2)), speeds[:2]
        mass[np.ix_(first, first)] += root @ root.T
        coupled.append(first)
        for values in generator.normal(size=(row.rows, row.rank)) @ generator.normal(size=(row.rank, row.speeds)):
            jacobian.append(np.zeros(size))
            jacobian[-1][speeds] = values
            read.append(speeds)
    if massless:
        speed = place[-1]  # of no cell's first two
        mass[speed] = mass[:, speed] = 0.0
    order = generator.permutation(len(jacobian))
    jacobian = np.array(jacobian)[order]
    singles = [np.array([speed]) for speed in range(size)]
    chain = chained([read[index] for index in order], [*coupled, *singles], size)
    return System(mass, jacobian, units, chain, generator.normal(size=size), jacobian @ generator.normal(size=size))


def both(given, metric, rank_nearby=None):
    at_once = invert(given.mass if metric == "mass" else None, given.jacobian, given.units, TOLERANCE)
    found = blocks(given, given.mass, given.jacobian)
    if metric == "identity":
        found = with_identity_metric(found, given.chain, given.units)
    return at_once, jax.jit(invert_chain, static_argnums=3)(found, given.units, TOLERANCE, given.chain, rank_nearby)


def blocks(given, mass, jacobian):
    return in_cells(given.chain, Placed.whole(jnp.asarray(mass)), Placed.whole(jnp.asarray(jacobian)))


def product_of(given):
    return SaddlePointInCells(blocks(given, given.mass, given.jacobian), given.chain, given.jacobian.shape[::-1])


def assert_solved(given, inverse, metric, at_once):
    weight = given.mass if metric == "mass" else np.diag(given.units**-2)
    a, multipliers = inverse.apply(given.force, given.rate)
    expected, others = at_once.apply(given.force, given.rate)
    atol = 1e-13 / float(at_once.distance) ** 2
    np.testing.assert_allclose(a, expected, atol=atol)
    np.testing.assert_allclose(given.jacobian.T @ multipliers, given.jacobian.T @ others, atol=atol)
    np.testing.assert_allclose(given.jacobian @ a, given.rate, atol=atol)
    np.testing.assert_allclose(weight @ a, given.force + given.jacobian.T @ multipliers, atol=atol)


@pytest.mark.parametrize("metric", ["mass", "identity"])
@pytest.mark.parametrize("name", ROWS)
def test_cell_by_cell_as_at_once(name, metric):
    given = system(name)
    at_once, by_cells = both(given, metric)
    assert len(given.chain.added) >= ROWS[name].cells
    assert int(by_cells.rank.sum()) == int(at_once.rank)
    assert float(by_cells.definiteness) > 0.1
    assert_solved(given, by_cells, metric, at_once)
    # In units both measure the same; the order in which rows are chosen differs.
    if metric == "identity":
        assert float(at_once.distance) / 20 < float(by_cells.distance) < 20 * float(at_once.distance)
    _, known = both(given, metric, by_cells.rank)
    assert_solved(given, known, metric, at_once)


def test_every_speed_and_row_has_one_cell():
    for name in ROWS:
        given = system(name)
        assert sorted(speed for cell in given.chain.added for speed in cell) == list(range(len(given.mass)))
        assert sorted(row for cell in given.chain.rows for row in cell) == list(range(len(given.jacobian)))


def test_cells_stay_small():
    """The work grows with the number of cells, in whatever order speeds and rows are given."""
    chain = system("four-bars", seed=3).chain
    assert chain.kept_table.shape[1] == 1
    assert chain.table.shape[1] == 3


def test_masses_that_only_the_loops_hold_are_no_hindrance():
    """M needs to be definite on the tangent space alone, and where it is not, that is told."""
    given = system("four-bars", massless=True)
    at_once, by_cells = both(given, "mass")
    assert_solved(given, by_cells, "mass", at_once)
    held_by_none = given.jacobian * (np.diagonal(given.mass) > 0.0)
    assert float(both(given._replace(jacobian=held_by_none), "mass")[1].definiteness) < 1e-14


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-5])
def test_a_cell_that_becomes_singular(away):
    """Rows of one cell made dependent, or nearly so: ranks and answers follow."""
    given = system("four-bars")
    first, second = (np.array(given.chain.rows[4]) for _ in range(2))
    first, second = first[0], second[1]
    jacobian = given.jacobian.copy()
    jacobian[second] = jacobian[first] + away * jacobian[second]
    given = given._replace(jacobian=jacobian, rate=jacobian @ np.ones(len(given.mass)))
    at_once, by_cells = both(given, "mass")
    full = 2 * ROWS["four-bars"].cells
    assert int(by_cells.rank.sum()) == int(at_once.rank) == (full if away > TOLERANCE else full - 1)
    if away < TOLERANCE:
        assert_solved(given, by_cells, "mass", at_once)
    else:
        assert 1e-2 * away < float(by_cells.distance) < away


@pytest.mark.parametrize("name", ["four-bars", "redundant"])
def test_refinement_with_factors_of_a_system_nearby(name):
    """Products with the matrices of the cells are those with the whole ones; sweeps converge to the new system's."""
    given = system(name)
    inverse = both(given, "mass")[1]
    unknowns = np.random.default_rng(1).normal(size=len(given.mass) + len(given.jacobian))
    whole = np.block([[given.mass, -given.jacobian.T], [given.jacobian, np.zeros(2 * given.jacobian.shape[:1])]])
    product = product_of(given)
    np.testing.assert_allclose(product(unknowns), whole @ unknowns, atol=1e-12)
    changed = given._replace(mass=1.001 * given.mass, jacobian=0.999 * given.jacobian, rate=0.999 * given.rate)
    at_once, _ = both(changed, "mass")
    found, _ = constrained_solve(
        inverse, changed.mass, changed.jacobian, changed.force, changed.rate, 4, product_of(changed)
    )
    np.testing.assert_allclose(found, at_once.apply(changed.force, changed.rate)[0], atol=1e-9)


def test_derivatives_and_batches():
    given = system("redundant")

    def acceleration(scale, inverse_of):
        mass, jacobian = scale * given.mass, given.jacobian * (1.0 + 0.1 * scale)
        inverse = inverse_of(mass, jacobian)
        return constrained_solve(inverse, mass, jacobian, given.force, given.rate)[0]

    def by_cells(mass, jacobian):
        return invert_chain(blocks(given, mass, jacobian), given.units, TOLERANCE, given.chain)

    at_once = lambda mass, jacobian: invert(mass, jacobian, given.units, TOLERANCE)
    for transform in (jax.jacfwd, jax.jacrev, lambda f: lambda x: jax.vmap(f)(jnp.array([x, 2.0 * x]))):
        found, expected = (transform(lambda x, way=way: acceleration(x, way))(1.3) for way in (by_cells, at_once))
        np.testing.assert_allclose(found, expected, atol=1e-11)
