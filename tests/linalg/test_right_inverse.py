"""Right inverses, and the reduced row echelon form behind one of them, on matrices of any rank."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.linalg.right_inverse import by_gram_schmidt, by_partition, by_svd
from linkax.linalg.row_echelon import row_echelon

TOLERANCE = 1e-8
RANDOM = np.random.default_rng(0)


def of_rank(rank, m, n):
    return RANDOM.normal(size=(m, rank)) @ RANDOM.normal(size=(rank, n))


MATRICES = {
    "wide": of_rank(3, 3, 5),
    "tall": of_rank(3, 5, 3),
    "dependent rows": of_rank(2, 5, 4),
    "zero": np.zeros((3, 4)),
    "zero rows": np.concatenate([np.zeros((2, 4)), of_rank(2, 2, 4)]),
    "duplicated": np.repeat(of_rank(2, 2, 4), 3, axis=0),
    "one": np.array([[-2.0]]),
}


@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("inverse", [by_svd, by_gram_schmidt, by_partition])
def test_a_right_inverse_solves_what_has_a_solution(inverse, name):
    matrix = MATRICES[name]
    found = np.asarray(jax.jit(inverse)(matrix, TOLERANCE))
    assert found.shape == matrix.T.shape
    np.testing.assert_allclose(matrix @ found @ matrix, matrix, atol=1e-12)
    rank = np.linalg.matrix_rank(matrix)
    assert np.linalg.matrix_rank(found, tol=1e-10) == rank
    if inverse is by_svd:
        np.testing.assert_allclose(found, np.linalg.pinv(matrix), atol=1e-12)
    if inverse is by_partition:
        assert np.sum(np.any(found != 0.0, axis=1)) == rank, "as few unknowns move as there are independent rows"


def test_gram_schmidt_leaves_out_rows_that_follow_from_those_before():
    first, second = np.array([1.0, 0.0, 1.0]), np.array([0.0, 2.0, 0.0])
    rows = np.stack([first, -3.0 * first, second, first + second])
    found = np.asarray(by_gram_schmidt(jnp.asarray(rows), TOLERANCE))
    np.testing.assert_allclose(found[:, [1, 3]], 0.0, atol=1e-15)
    np.testing.assert_allclose(found[:, [0, 2]], np.linalg.pinv(np.stack([first, second])), atol=1e-15)


def test_a_fixed_cut_off_switches_the_rank_suddenly():
    nearly = np.array([[1.0, 0.0], [1.0, 1e-7]])
    assert np.max(np.abs(by_svd(nearly, 1e-6))) < 2.0
    assert np.max(np.abs(by_svd(nearly, 1e-8))) > 1e6


@pytest.mark.parametrize("name", MATRICES)
def test_reduced_row_echelon_form(name):
    matrix = MATRICES[name]
    found = jax.tree.map(np.asarray, jax.jit(row_echelon)(matrix, TOLERANCE))
    rank = np.linalg.matrix_rank(matrix)
    assert found.rank == rank
    np.testing.assert_allclose(found.transform @ matrix, found.reduced, atol=1e-12)
    np.testing.assert_allclose(found.reduced[:, found.pivot_columns[:rank]][found.pivot_rows[:rank]], np.eye(rank))
    others = np.delete(found.reduced, found.pivot_rows[:rank], axis=0)
    np.testing.assert_allclose(others, 0.0, atol=1e-12)
    assert len(set(found.pivot_columns.tolist())) == len(found.pivot_columns)


def test_the_rank_is_that_of_pivots_above_the_tolerance():
    graded = jnp.diag(jnp.array([1.0, 1e-4, 1e-9]))
    assert [int(row_echelon(graded, tolerance).rank) for tolerance in (1e-3, 1e-6, 1e-12)] == [1, 2, 3]
