"""Cell by front the constrained solve gives what it gives at once, for rows of fronts of any rank."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.linalg.block_elimination import SaddlePointInFronts, in_fronts, invert_by_blocks, with_identity_metric
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.elimination_plan import plan_elimination
from linkax.linalg.saddle_inverse import invert
from linkax.linalg.static_sparse import StaticSparse

TOLERANCE = 1e-9


class Row(NamedTuple):
    """Cells of so many speeds each, of which the next shares some; rows in each, of which so many are independent."""

    fronts: int
    speeds: int
    shared: int
    rows: int
    rank: int
    closed: bool = False  # the last shares with the first


ROWS = {
    "four-bars": Row(9, 3, 1, 2, 2),
    "redundant": Row(6, 5, 2, 4, 2),
    "free": Row(5, 6, 3, 3, 1),
    "all decided": Row(5, 3, 1, 4, 2),
    "islands": Row(4, 4, 0, 3, 2),
    "one front": Row(1, 4, 0, 2, 2),
    "ring": Row(9, 4, 1, 3, 2, closed=True),
}


class System(NamedTuple):
    mass: np.ndarray
    jacobian: np.ndarray
    scales: np.ndarray
    plan: object
    force: np.ndarray
    rate: np.ndarray


def system(name, seed=0, massless=False):
    """A mechanism with speeds and rows in random order."""
    row, generator = ROWS[name], np.random.default_rng(seed)
    step = row.speeds - row.shared
    size = step * row.fronts + (0 if row.closed else row.shared)
    place, scales = generator.permutation(size), generator.choice([1.0, 0.2], size)
    mass, jacobian, read, coupled = np.diag(1.0 + generator.random(size)), [], [], []
    for front in range(row.fronts):
        speeds = place[(front * step + np.arange(row.speeds)) % size]
        root, first = generator.normal(size=(2, 2)), speeds[:2]
        mass[np.ix_(first, first)] += root @ root.T
        coupled.append(first)
        for values in generator.normal(size=(row.rows, row.rank)) @ generator.normal(size=(row.rank, row.speeds)):
            jacobian.append(np.zeros(size))
            jacobian[-1][speeds] = values
            read.append(speeds)
    if massless:
        speed = place[-1]  # of no front's first two
        mass[speed] = mass[:, speed] = 0.0
    order = generator.permutation(len(jacobian))
    jacobian = np.array(jacobian)[order]
    singles = [np.array([speed]) for speed in range(size)]
    plan = plan_elimination([read[index] for index in order], [*coupled, *singles], size)
    return System(mass, jacobian, scales, plan, generator.normal(size=size), jacobian @ generator.normal(size=size))


# One program each, where operation by operation would be eighty.
at_once_of = eqx.filter_jit(invert)
solve = eqx.filter_jit(lambda inverse, force, rate: inverse.apply(force, rate))


def both(given, metric, rank_nearby=None):
    at_once = at_once_of(given.mass if metric == "mass" else None, given.jacobian, given.scales, TOLERANCE)
    found = blocks(given, given.mass, given.jacobian)
    if metric == "identity":
        found = with_identity_metric(found, given.plan, given.scales)
    return at_once, jax.jit(invert_by_blocks, static_argnums=3)(found, given.scales, TOLERANCE, given.plan, rank_nearby)


def blocks(given, mass, jacobian):
    return in_fronts(given.plan, StaticSparse.whole(jnp.asarray(mass)), StaticSparse.whole(jnp.asarray(jacobian)))


def product_of(given):
    return SaddlePointInFronts(blocks(given, given.mass, given.jacobian), given.plan, given.jacobian.shape[::-1])


def assert_solved(given, inverse, metric, at_once):
    weight = given.mass if metric == "mass" else np.diag(given.scales**-2)
    a, multipliers = map(np.asarray, solve(inverse, given.force, given.rate))
    expected, others = map(np.asarray, solve(at_once, given.force, given.rate))
    atol = 1e-13 / float(at_once.distance) ** 2
    np.testing.assert_allclose(a, expected, atol=atol)
    np.testing.assert_allclose(given.jacobian.T @ multipliers, given.jacobian.T @ others, atol=atol)
    np.testing.assert_allclose(given.jacobian @ a, given.rate, atol=atol)
    np.testing.assert_allclose(weight @ a, given.force + given.jacobian.T @ multipliers, atol=atol)


@pytest.mark.parametrize("metric", ["mass", pytest.param("identity", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ROWS)
def test_cell_by_cell_as_at_once(name, metric):
    given = system(name)
    at_once, by_fronts = both(given, metric)
    assert len(given.plan.interior) >= ROWS[name].fronts
    assert int(by_fronts.rank.sum()) == int(at_once.rank)
    assert float(by_fronts.definiteness) > 0.1
    assert_solved(given, by_fronts, metric, at_once)
    # In units both measure the same; the order in which rows are chosen differs.
    if metric == "identity":
        assert float(at_once.distance) / 20 < float(by_fronts.distance) < 20 * float(at_once.distance)
    _, known = both(given, metric, by_fronts.rank)
    assert_solved(given, known, metric, at_once)


def test_every_speed_and_row_has_one_cell():
    for name in ROWS:
        given = system(name)
        assert sorted(speed for front in given.plan.interior for speed in front) == list(range(len(given.mass)))
        assert sorted(row for front in given.plan.rows for row in front) == list(range(len(given.jacobian)))


def test_cells_stay_small():
    """The work grows with the number of fronts, in whatever order speeds and rows are given."""
    plan = system("four-bars", seed=3).plan
    assert plan.separator_table.shape[1] == 1
    assert plan.table.shape[1] == 3


def test_a_ring_is_open_at_two_places():
    """Speeds of one place pass by the fronts that do not read them."""
    plan = system("ring").plan
    assert plan.separator_table.shape[1] == 2
    passing = [len({*kept} - {*read}) for kept, read in zip(plan.separator, plan.read, strict=True)]
    assert sum(passing) >= ROWS["ring"].fronts - 3


def test_large_plans_are_found_soon():
    """One loop of a thousand bodies, and a lattice, whose separators are hardly wider than it is."""
    one = plan_elimination([np.arange(1000)], [np.arange(1000)], 1000)
    assert len(one.interior) == 1
    side, long = 8, 150
    cell = np.array([0, 1, side, side + 1])
    lattice = [row * side + column + cell for row in range(long - 1) for column in range(side - 1)]
    plan = plan_elimination(lattice, [], side * long)
    assert plan.separator_table.shape[1] <= 3 * side // 2


def test_masses_that_only_the_loops_hold_are_no_hindrance():
    """M needs to be definite on the tangent space alone, and where it is not, that is told."""
    given = system("four-bars", massless=True)
    at_once, by_fronts = both(given, "mass")
    assert_solved(given, by_fronts, "mass", at_once)
    held_by_none = given.jacobian * (np.diagonal(given.mass) > 0.0)
    assert float(both(given._replace(jacobian=held_by_none), "mass")[1].definiteness) < 1e-14


@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-5])
def test_a_cell_that_becomes_singular(away):
    """Rows of one front made dependent, or nearly so: ranks and answers follow."""
    given = system("four-bars")
    first, second = given.plan.rows[4][:2]
    jacobian = given.jacobian.copy()
    jacobian[second] = jacobian[first] + away * jacobian[second]
    given = given._replace(jacobian=jacobian, rate=jacobian @ np.ones(len(given.mass)))
    at_once, by_fronts = both(given, "mass")
    full = 2 * ROWS["four-bars"].fronts
    assert int(by_fronts.rank.sum()) == int(at_once.rank) == (full if away > TOLERANCE else full - 1)
    if away < TOLERANCE:
        assert_solved(given, by_fronts, "mass", at_once)
    else:
        assert 1e-2 * away < float(by_fronts.distance) < away


@pytest.mark.parametrize("name", ["four-bars", "redundant", "ring"])
def test_refinement_with_factors_of_a_system_nearby(name):
    """Products with the matrices of the fronts are those with the whole ones; sweeps converge to the new system's."""
    given = system(name)
    inverse = both(given, "mass")[1]
    unknowns = np.random.default_rng(1).normal(size=len(given.mass) + len(given.jacobian))
    whole = np.block([[given.mass, -given.jacobian.T], [given.jacobian, np.zeros(2 * given.jacobian.shape[:1])]])
    product = eqx.filter_jit(product_of(given))
    np.testing.assert_allclose(product(unknowns), whole @ unknowns, atol=1e-12)
    changed = given._replace(mass=1.001 * given.mass, jacobian=0.999 * given.jacobian, rate=0.999 * given.rate)
    at_once, _ = both(changed, "mass")
    refined = lambda inverse: constrained_solve(
        inverse, changed.mass, changed.jacobian, changed.force, changed.rate, 4, product_of(changed)
    )
    found, _ = eqx.filter_jit(refined)(inverse)
    np.testing.assert_allclose(found, at_once.apply(changed.force, changed.rate)[0], atol=1e-9)


@pytest.mark.slow
def test_derivatives_and_batches():
    given = system("redundant")

    def acceleration(scale, inverse_of):
        mass, jacobian = scale * given.mass, given.jacobian * (1.0 + 0.1 * scale)
        inverse = inverse_of(mass, jacobian)
        return constrained_solve(inverse, mass, jacobian, given.force, given.rate)[0]

    def by_fronts(mass, jacobian):
        return invert_by_blocks(blocks(given, mass, jacobian), given.scales, TOLERANCE, given.plan)

    at_once = lambda mass, jacobian: invert(mass, jacobian, given.scales, TOLERANCE)
    for transform in (jax.jacfwd, jax.jacrev, lambda f: lambda x: jax.vmap(f)(jnp.array([x, 2.0 * x]))):
        found, expected = (transform(lambda x, way=way: acceleration(x, way))(1.3) for way in (by_fronts, at_once))
        np.testing.assert_allclose(found, expected, atol=1e-11)


def test_a_row_that_reads_no_speed_is_in_a_front():
    """As one that locks what stands still, in the loop of a gripper from a file."""
    nothing, both_speeds = np.array([], dtype=int), np.array([0, 1])
    plan = plan_elimination([nothing, both_speeds, nothing], [np.array([0]), np.array([1])], 2)
    assert sorted(row for rows in plan.rows for row in rows) == [0, 1, 2]
