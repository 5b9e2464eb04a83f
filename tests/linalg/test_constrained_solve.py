"""The constrained solve for any rank of J, in both metrics, and its derivatives to second order."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.least_multipliers import least_multipliers
from linkax.linalg.saddle_inverse import invert, invert_apart, with_mass

TOLERANCE = 1e-10
METRICS = ["mass", "identity"]
UNITS = {3: np.array([1.0, 0.05, 20.0]), 5: np.array([1.0, 20.0, 1.0, 0.05, 1.0])}
ONES = {n: np.ones(n) for n in UNITS}


class Problem(NamedTuple):
    """M = Pᵀ diag(m) P and J = C K, so that masses and dependent rows are chosen freely."""

    shape: np.ndarray
    masses: np.ndarray
    combination: np.ndarray
    rows: np.ndarray
    force: np.ndarray
    rate: np.ndarray
    direction: np.ndarray


def problem(case, seed=0):
    rng = np.random.default_rng(seed)
    n, m = {"more rows than columns": (3, 5), "no rows": (5, 0)}.get(case, (5, 4))
    combination = np.eye(m)
    if case == "redundant":
        combination[3] = combination[0] - 2.0 * combination[1]
    if case == "zero rows":
        combination[[0, 2]] = 0.0
    if case == "more rows than columns":
        combination = rng.normal(size=(5, 2)) @ rng.normal(size=(2, 5))
    masses = 0.5 + rng.random(n)
    if case == "massless":
        masses[0] = 0.0
    return Problem(
        shape=np.eye(n) + 0.3 * rng.normal(size=(n, n)),
        masses=masses,
        combination=combination,
        rows=rng.normal(size=(m, n)),
        force=rng.normal(size=n),
        rate=rng.normal(size=n),
        direction=0.2 * rng.normal(size=(2, n, n)),
    )


RANKS = {
    "regular": 4,
    "redundant": 3,
    "zero rows": 2,
    "massless": 4,
    "more rows than columns": 2,
    "no rows": 0,
}


def matrices(given_problem, theta):
    """M, J, f and γ at parameters θ, (2,); the rank of J does not depend on them."""
    p, n = given_problem, given_problem.masses.shape[0]
    turn = jnp.tensordot(theta, p.direction, 1)
    shape = p.shape @ (jnp.eye(n) + turn + turn @ turn)
    mass = shape.T @ (p.masses[:, None] * (1.0 + theta[0] ** 2) * shape)
    jacobian = (1.0 + theta[1]) * p.combination @ p.rows @ (jnp.eye(n) - turn @ turn + turn.T)
    return mass, jacobian, p.force * (1.0 + theta[0] * theta[1]), jacobian @ (p.rate + theta[0] * p.force)


def inverted(metric, mass, jacobian, scales):
    if metric == "mass":
        return invert(mass, jacobian, scales, TOLERANCE)
    return with_mass(invert(None, jacobian, scales, TOLERANCE), mass)


def solved(metric, given_problem, scales, theta):
    """What is unique: a and the constraint force Jᵀλ; and λ."""
    mass, jacobian, f, gamma = matrices(given_problem, theta)
    a, multipliers = constrained_solve(inverted(metric, mass, jacobian, scales), mass, jacobian, f, gamma)
    return jnp.concatenate([a, jacobian.T @ multipliers]), multipliers


answers = jax.jit(solved, static_argnums=0)
THETA = np.array([0.1, -0.2])


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("case", RANKS)
@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 2**32 - 1))
def test_it_solves_the_saddle_point_system(case, metric, seed):
    chosen = problem(case, seed)
    scales = UNITS[chosen.masses.size]
    mass, jacobian, f, gamma = map(np.asarray, matrices(chosen, THETA))
    unique, multipliers = map(np.asarray, answers(metric, chosen, scales, THETA))
    n, m = mass.shape[0], len(jacobian)
    saddle = np.block([[mass, -jacobian.T], [jacobian, np.zeros((m, m))]])
    expected = np.linalg.lstsq(saddle, np.concatenate([f, gamma]), rcond=1e-10)[0]
    # Random matrices can be ill-conditioned; nothing can be better than rounding times that.
    values = np.linalg.svd(saddle, compute_uv=False)
    condition = values[0] / values[values > 1e-10 * values[0]][-1]
    atol = 1e-14 * condition * max(1.0, np.max(np.abs(expected)))
    np.testing.assert_allclose(unique[:n], expected[:n], atol=atol)
    np.testing.assert_allclose(unique[n:], jacobian.T @ expected[n:], atol=atol)
    np.testing.assert_allclose(mass @ unique[:n], f + jacobian.T @ multipliers, atol=atol)
    np.testing.assert_allclose(jacobian @ unique[:n], gamma, atol=atol)


@pytest.mark.parametrize("case", RANKS)
def test_the_answer_depends_on_neither_metric_nor_units(case):
    chosen = problem(case)
    n = chosen.masses.size
    found = [answers(metric, chosen, scales[n], THETA)[0] for metric in METRICS for scales in (UNITS, ONES)]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-12 * np.max(np.abs(found[0])))


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("case", RANKS)
def test_the_blocks_of_the_inverse(case, metric):
    """T spans the tangent space, G is a right inverse of J on its range, T M G = 0."""
    chosen = problem(case)
    mass, jacobian, _, _ = map(np.asarray, matrices(chosen, THETA))
    inverse = jax.tree.map(np.asarray, inverted(metric, mass, jacobian, UNITS[len(mass)]))
    scale = np.max(np.abs(inverse.tangent))
    np.testing.assert_allclose(inverse.tangent, inverse.tangent.T, atol=1e-13 * scale)
    np.testing.assert_allclose(inverse.tangent @ mass @ inverse.tangent, inverse.tangent, atol=1e-12 * scale)
    np.testing.assert_allclose(jacobian @ inverse.tangent, 0.0, atol=1e-12 * scale)
    np.testing.assert_allclose(jacobian @ inverse.normal @ jacobian, jacobian, atol=1e-12)
    if case != "massless":
        np.testing.assert_allclose(inverse.tangent @ mass @ inverse.normal, 0.0, atol=1e-11 * scale)
    assert inverse.rank == RANKS[case]
    assert np.linalg.matrix_rank(inverse.tangent, tol=1e-8 * scale) == len(mass) - RANKS[case]


@pytest.mark.parametrize("heavy", [1.0, 1e8])
def test_rows_hold_massless_speeds_whatever_is_next_to_zero_in_them(heavy):
    """Rows that move a massless speed alone, but for entries of rounding, or larger ones, at any ratio of masses."""
    mass, force, rate = np.diag([heavy, 1.0, 0.0]), np.array([heavy, 0.5, 0.3]), np.array([0.7])
    for off in (0.0, 1e-17, 1e-15, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-3):
        row = np.array([[off, -2.0 * off, 0.4]])
        kkt = np.block([[mass, -row.T], [row, np.zeros((1, 1))]])
        expected = np.linalg.solve(kkt, np.concatenate([force, rate]))
        inverse = invert(jnp.asarray(mass), jnp.asarray(row), jnp.ones(3), TOLERANCE)
        assert inverse.definiteness > 1e-8
        found = np.concatenate(constrained_solve(inverse, mass, row, force, rate))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_distance_is_the_ratio_of_the_diagonal_of_r():
    _, jacobian, _, _ = matrices(problem("redundant"), THETA)
    diagonal = np.abs(np.diagonal(scipy.linalg.qr(np.asarray(jacobian).T, pivoting=True)[1]))[:3]
    inverse = invert(None, jacobian, ONES[5], TOLERANCE)
    np.testing.assert_allclose(inverse.distance, diagonal[2] / diagonal[0], rtol=1e-12)


@pytest.mark.parametrize(("smallest", "rank"), [(1e-3, 2), (1e-9, 2), (1e-11, 1), (0.0, 1)])
def test_distance_falls_towards_a_singular_position(smallest, rank):
    """Rows at an angle of `smallest` to each other; one of them is dropped below the rank tolerance."""
    jacobian = np.array([[1.0, 0.0, 0.0], [1.0, smallest, 0.0]])
    for weight in (None, np.diag([1.0, 2.0, 3.0])):
        inverse = invert(weight, jacobian, ONES[3], TOLERANCE)
        assert int(inverse.rank) == rank
        # The first row alone has distance one; in another metric the ratio changes by that metric's.
        assert smallest / 3 <= float(inverse.distance) <= 3 * smallest or (rank == 1 and inverse.distance == 1.0)


def test_without_independent_rows_nothing_is_constrained():
    mass = np.diag([1.0, 2.0, 4.0])
    for rows in (0, 2):
        inverse = invert(mass, np.zeros((rows, 3)), UNITS[3], TOLERANCE)
        assert int(inverse.rank) == 0
        assert float(inverse.distance) == 1.0
        a, multipliers = inverse.apply(np.ones(3), np.zeros(rows))
        np.testing.assert_allclose(a, 1.0 / np.diagonal(mass), rtol=1e-15)
        np.testing.assert_array_equal(multipliers, np.zeros(rows))


def compositions(metric, given_problem, scales, theta):
    function = lambda theta: solved(metric, given_problem, scales, theta)[0]
    return {
        "value": function(theta),
        "forward": jax.jacfwd(function)(theta),
        "reverse": jax.jacrev(function)(theta),
        "forward of forward": jax.jacfwd(jax.jacfwd(function))(theta),
        "forward of reverse": jax.jacfwd(jax.jacrev(function))(theta),
        "reverse of forward": jax.jacrev(jax.jacfwd(function))(theta),
        "reverse of reverse": jax.jacrev(jax.jacrev(function))(theta),
    }


derivatives = jax.jit(compositions, static_argnums=0)
derivatives_of_batch = jax.jit(jax.vmap(compositions, (None, None, None, 0)), static_argnums=0)
STEP = 1e-5
AROUND = THETA + STEP * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def central(values):
    """Differences over AROUND, the direction last as JAX has it."""
    return np.stack([values[1] - values[2], values[3] - values[4]], axis=-1) / (2 * STEP)


@pytest.mark.parametrize("metric", ["mass", pytest.param("identity", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in ("more rows than columns", "no rows") else name
        for name in RANKS
    ],
)
def test_derivatives_to_second_order_in_all_modes(case, metric):
    chosen = problem(case)
    scales = UNITS[chosen.masses.size]
    batch = jax.tree.map(np.asarray, derivatives_of_batch(metric, chosen, scales, AROUND))
    first, second = central(batch["value"]), central(batch["forward"])
    for mode, found in batch.items():
        expected = {"value": batch["value"][0], "forward": first, "reverse": first}.get(mode, second)
        # Truncation of the differences is of the order STEP², their rounding of 1e-16 / STEP.
        np.testing.assert_allclose(found[0], expected, atol=1e-8 * np.max(np.abs(expected)), err_msg=mode)
    for mode in ("forward of reverse", "reverse of forward", "reverse of reverse"):
        scale = np.max(np.abs(second))
        np.testing.assert_allclose(batch[mode], batch["forward of forward"], atol=1e-12 * scale, err_msg=mode)
    np.testing.assert_allclose(batch["reverse"], batch["forward"], atol=1e-12 * np.max(np.abs(first)))


@pytest.mark.slow
@pytest.mark.parametrize("metric", METRICS)
def test_a_batch_of_derivatives_equals_its_members(metric):
    """Redundant and zero rows in one batch, each with a rank of its own."""
    alone = [problem("redundant"), problem("zero rows"), problem("regular")]
    batch = jax.tree.map(lambda *entries: np.stack(entries), *alone)
    over_problems = jax.jit(jax.vmap(compositions, (None, 0, None, None)), static_argnums=0)
    together = over_problems(metric, batch, UNITS[5], THETA)
    for index, chosen in enumerate(alone):
        single = derivatives(metric, chosen, UNITS[5], THETA)
        for mode, found in together.items():
            scale = np.max(np.abs(single[mode]))
            np.testing.assert_allclose(found[index], single[mode], atol=1e-12 * scale, err_msg=mode)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("case", ["regular", "massless"])
def test_sweeps_converge_at_the_rate_of_the_distance(case, metric):
    """The inverse of a system ε away: k sweeps leave an error of the order ε^(k + 1)."""
    chosen = problem(case)
    sweeps, distances = range(4), (1e-2, 1e-3)
    errors = np.array([[error_after(chosen, metric, count, away) for count in sweeps] for away in distances])
    for order, (far, near) in enumerate(zip(*errors, strict=True), start=1):
        if near > 1e-13:
            assert far / near == pytest.approx(10.0**order, rel=0.3 * order)
    assert errors[1, 3] < 1e-9


def error_after(chosen, metric, sweeps, away):
    direction = np.array([0.6, -0.8])
    mass, jacobian, f, gamma = matrices(chosen, THETA)
    nearby = matrices(chosen, THETA + away * direction)[:2]
    inverse = inverted(metric, *nearby, UNITS[len(mass)])
    exact = constrained_solve(inverted(metric, mass, jacobian, UNITS[len(mass)]), mass, jacobian, f, gamma, 3)[0]
    return np.max(np.abs(constrained_solve(inverse, mass, jacobian, f, gamma, sweeps)[0] - exact))


@pytest.mark.parametrize("metric", ["mass", "identity"])
def test_islands_are_inverted_as_in_one(metric):
    generator = np.random.default_rng(3)
    islands = (((0, 3), (0, 2, 5)), ((1, 4), (1, 6, 7)), ((2,), (3, 4)))
    jacobian, mass = np.zeros((5, 8)), np.zeros((8, 8))
    for rows, columns in islands:
        jacobian[np.ix_(rows, columns)] = generator.normal(size=(len(rows), len(columns)))
        root = generator.normal(size=(len(columns), len(columns)))
        mass[np.ix_(columns, columns)] = root @ root.T + np.eye(len(columns))
    jacobian[4] = 2.0 * jacobian[1]
    weight = jnp.array(mass) if metric == "mass" else None
    arguments = weight, jnp.array(jacobian), jnp.ones(8), 1e-10

    @jax.jit
    def inverted(*arguments):
        apart = invert_apart(*arguments, islands)
        return invert(*arguments), apart, invert_apart(*arguments, islands, apart.rank)

    whole, apart, known = inverted(*arguments)
    np.testing.assert_array_equal(apart.rank, [2, 1, 1])
    assert whole.rank == 4
    np.testing.assert_allclose(apart.tangent, whole.tangent, atol=1e-12)
    # Which of dependent rows is taken may differ, but not what J, normal and right sides in its range give.
    np.testing.assert_allclose(apart.normal @ jacobian, whole.normal @ jacobian, atol=1e-12)
    np.testing.assert_allclose(known.normal, apart.normal, atol=1e-14)


def test_least_multipliers_are_smallest_and_differentiable():
    generator = np.random.default_rng(4)
    basic, mix = generator.normal(size=(2, 4)), generator.normal(size=(5, 2))
    jacobian = lambda s: jnp.array(mix) @ (jnp.array(basic) * (1.0 + s))
    given = jnp.array(generator.normal(size=5))
    found = least_multipliers(jacobian(0.0), given, jnp.ones(4), 1e-10, 2)
    exact = lambda s: jnp.linalg.pinv(jacobian(s).T) @ (jacobian(s).T @ given)
    np.testing.assert_allclose(found.multipliers, exact(0.0), atol=1e-12)
    free = np.asarray(found.free)
    assert np.sum(np.any(np.abs(free) > 0.0, axis=0)) == 3
    np.testing.assert_allclose(jacobian(0.0).T @ free, 0.0, atol=1e-12)
    rows = lambda s: jnp.array(mix) @ (jnp.array(basic) + s * jnp.array(basic[::-1]))
    of = lambda s: least_multipliers(rows(s), given, jnp.ones(4), 1e-10, 2).multipliers
    pinned = lambda s: jnp.linalg.pinv(rows(s).T) @ (rows(s).T @ given)
    difference = (pinned(1e-6) - pinned(-1e-6)) / 2e-6
    np.testing.assert_allclose(jax.jacfwd(of)(0.0), difference, atol=1e-7)
