"""Our pivoted QR against LAPACK's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.pivoted_qr import ENTRIES, TOGETHER, pivoted_qr
from linkax.linalg.saddle_inverse import invert

SHAPES = {"tall": (7, 4), "wide": (4, 7), "square": (6, 6), "row": (1, 5), "column": (5, 1)}

factorise = jax.jit(pivoted_qr)
factorise_batch = jax.jit(jax.vmap(pivoted_qr))


def assert_factorisation(a, tolerance=1e-14, factors=None):
    """A P = Q R with Q orthogonal and R upper trapezoidal, its diagonal falling."""
    q, r, order = map(np.asarray, factors or factorise(a))
    n, m = a.shape
    scale = max(np.linalg.norm(a), np.finfo(a.dtype).tiny)
    assert sorted(order) == list(range(m))
    np.testing.assert_allclose(q.T @ q, np.eye(n), atol=tolerance * n)
    np.testing.assert_allclose(q @ r / scale, a[:, order] / scale, atol=tolerance * n)
    assert np.all(np.tril(r, -1) == 0.0)
    diagonal = np.abs(np.diagonal(r))
    assert np.all(diagonal[1:] <= diagonal[:-1] * (1 + 10 * tolerance) + tolerance * scale)
    return r, order


def assert_like_lapack(a, tolerance=1e-13):
    """The same pivots and the same |R| (signs of its rows are a convention)."""
    r, order = assert_factorisation(a)
    _, expected, pivots = scipy.linalg.qr(a, pivoting=True)
    np.testing.assert_array_equal(order, pivots)
    np.testing.assert_allclose(np.abs(r), np.abs(expected), atol=tolerance * np.linalg.norm(a))
    return r, order


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_random(shape, seed):
    assert_like_lapack(np.random.default_rng(seed).normal(size=shape))


@pytest.mark.parametrize("shape", [SHAPES["tall"], SHAPES["wide"], SHAPES["square"]])
@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_graded_columns(shape, seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=shape)
    sizes = rng.permutation(np.logspace(-12, 0, shape[1]))
    a *= sizes / np.linalg.norm(a, axis=0)
    r, order = assert_like_lapack(a)
    # Small columns come out right to their own size, not only to that of the largest.
    np.testing.assert_allclose(np.linalg.norm(r, axis=0), sizes[order], rtol=1e-13)


@pytest.mark.parametrize("seed", range(5))
def test_graded_singular_values(seed):
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(2))
    a = left @ np.diag(np.logspace(0, -12, 6)) @ right
    assert_like_lapack(a)


def test_kahan():
    """Kahan's matrix is its own R, and hides that it is nearly singular from the pivoting."""
    n, angle = 12, 1.2
    a = np.sin(angle) ** np.arange(n)[:, None] * (np.eye(n) - np.cos(angle) * np.triu(np.ones((n, n)), 1))
    # Its columns tie at each step; Kahan's perturbation of the diagonal decides for the first.
    a += 25 * np.finfo(float).eps * np.diag(np.arange(n, 0, -1.0))
    r, order = assert_like_lapack(a)
    np.testing.assert_array_equal(order, np.arange(n))
    np.testing.assert_allclose(np.abs(r), np.abs(a), atol=1e-14)
    assert np.linalg.svd(a, compute_uv=False)[-1] < 0.2 * np.abs(r[-1, -1])


@pytest.mark.parametrize("rows", [3, 8])
def test_duplicate_columns(rows):
    """Equal columns tie exactly, so which of them comes first is free: |R| is the same for all."""
    a = np.random.default_rng(rows).normal(size=(rows, 3))[:, [0, 1, 0, 2, 1, 0]]
    r, _ = assert_factorisation(a)
    _, expected, _ = scipy.linalg.qr(a, pivoting=True)
    np.testing.assert_allclose(np.abs(r[:, :3]), np.abs(expected[:, :3]), atol=1e-14)
    np.testing.assert_allclose(r[3:], 0.0, atol=1e-14)


def test_equal_axis_aligned_columns():
    """All columns tie exactly; any order is right, and gives the same |R|."""
    a = np.eye(5)[:, [3, 0, 4, 1]] * np.array([2.0, -2.0, 2.0, -2.0])
    r, _ = assert_factorisation(a, tolerance=0.0)
    np.testing.assert_array_equal(np.abs(r), 2.0 * np.eye(5, 4))


def test_axis_aligned_columns_of_different_size():
    """The head of a column is exactly zero where its sign chooses the reflection."""
    a = np.eye(5)[:, [3, 0, 4, 1]] * np.array([1.0, -3.0, 2.0, -4.0])
    assert_like_lapack(a)


@pytest.mark.parametrize("shape", [SHAPES["tall"], SHAPES["wide"]])
def test_zero_matrix(shape):
    q, r, _ = factorise(np.zeros(shape))
    np.testing.assert_array_equal(q, np.eye(shape[0]))
    np.testing.assert_array_equal(r, np.zeros(shape))


def test_zero_rows_and_columns():
    a = np.random.default_rng(1).normal(size=(6, 6))
    a[:, 2] = a[4] = 0.0
    r, order = assert_factorisation(a)
    _, expected, _ = scipy.linalg.qr(a, pivoting=True)
    assert order[-1] == 2
    np.testing.assert_allclose(np.abs(r[:, :5]), np.abs(expected[:, :5]), atol=1e-14)


@pytest.mark.parametrize("shape", [SHAPES["tall"], SHAPES["wide"]])
def test_a_batch_equals_its_members(shape):
    batch = np.random.default_rng(2).normal(size=(8, *shape))
    together = factorise_batch(batch)
    for index, a in enumerate(batch):
        q, r, order = factorise(a)
        np.testing.assert_array_equal(together.order[index], order)
        np.testing.assert_allclose(together.q[index], q, atol=1e-14)
        np.testing.assert_allclose(together.r[index], r, atol=1e-14)


def test_compiled_equals_uncompiled():
    a = np.random.default_rng(3).normal(size=SHAPES["tall"])
    for compiled, plain in zip(factorise(a), pivoted_qr(jnp.asarray(a)), strict=True):
        np.testing.assert_allclose(compiled, plain, atol=1e-14)


def test_single_precision():
    a = np.random.default_rng(4).normal(size=SHAPES["square"]).astype(np.float32)
    q, r, order = factorise(a)
    assert q.dtype == r.dtype == jnp.float32
    assert_factorisation(a, tolerance=10 * np.finfo(np.float32).eps)
    _, expected, pivots = scipy.linalg.qr(a.astype(np.float64), pivoting=True)
    np.testing.assert_array_equal(order, pivots)
    np.testing.assert_allclose(np.abs(r), np.abs(expected), atol=20 * np.finfo(np.float32).eps)


def test_one_loop_whatever_the_size():
    texts = [factorise.lower(jnp.zeros(shape)).as_text() for shape in [(5, 3), (50, 30), (30, 50)]]
    assert [text.count("stablehlo.while") for text in texts] == [1, 1, 1]
    assert len({text.count("\n") for text in texts}) == 1


# Enough to be factorised together, in several parts that do not come out even.
MEMBERS = 5 * TOGETHER + 4
RANK = 2


def batch_of_kinds(shape, seed):
    """(MEMBERS, n, m) with every kind of matrix in turn, and the number of pivots that are determined in each."""
    rng = np.random.default_rng(seed)
    n, m = shape
    batch, determined = rng.normal(size=(MEMBERS, n, m)), np.full(MEMBERS, min(n, m))
    graded, deficient, zero, duplicated = (slice(first, None, 5) for first in range(1, 5))
    batch[graded] *= rng.permutation(np.logspace(-12, 0, m))
    batch[deficient] = batch[deficient, :, :RANK] @ rng.normal(size=(RANK, m))
    batch[zero] = 0.0
    batch[duplicated, :, 1] = batch[duplicated, :, 0]
    determined[deficient], determined[zero], determined[duplicated] = RANK, 0, 0
    return batch, determined


@pytest.mark.parametrize("shape", [SHAPES["tall"], SHAPES["wide"], SHAPES["square"]])
def test_a_large_batch_is_like_its_members_and_like_lapack(shape):
    batch, determined = batch_of_kinds(shape, seed=5)
    together = zip(*map(np.asarray, factorise_batch(batch)), strict=True)
    for a, pivots, factors in zip(batch, determined, together, strict=True):
        r, order = assert_factorisation(a, factors=factors)
        _, expected, lapack_order = scipy.linalg.qr(a, pivoting=True)
        _, r_by_itself, order_by_itself = factorise(a)
        scale = np.linalg.norm(a)
        for other_r, other_order in [(expected, lapack_order), (r_by_itself, order_by_itself)]:
            np.testing.assert_array_equal(order[:pivots], other_order[:pivots])
            np.testing.assert_allclose(np.abs(np.diagonal(r)), np.abs(np.diagonal(other_r)), atol=1e-13 * scale)
        if pivots == min(shape):
            np.testing.assert_array_equal(order, lapack_order)
            np.testing.assert_allclose(np.abs(r), np.abs(expected), atol=1e-13 * scale)
            np.testing.assert_allclose(r, r_by_itself, atol=1e-13 * scale)


def test_small_columns_of_a_large_batch_to_their_own_size():
    sizes = np.logspace(-12, 0, 6)
    batch = np.random.default_rng(6).normal(size=(MEMBERS, *SHAPES["square"]))
    batch *= sizes / np.linalg.norm(batch, axis=1, keepdims=True)
    _, r, order = factorise_batch(batch)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), sizes[order], rtol=1e-13)


def test_a_batch_of_batches():
    batch, _ = batch_of_kinds(SHAPES["square"], seed=7)
    nested = jax.jit(jax.vmap(jax.vmap(pivoted_qr), in_axes=1, out_axes=1))(batch.reshape(4, -1, *batch.shape[1:]))
    for part, flat in zip(nested, factorise_batch(batch), strict=True):
        np.testing.assert_allclose(part.reshape(flat.shape), flat, atol=1e-14)


def test_a_large_batch_in_single_precision():
    batch = np.random.default_rng(8).normal(size=(MEMBERS, *SHAPES["square"])).astype(np.float32)
    q, r, order = map(np.asarray, factorise_batch(batch))
    assert q.dtype == r.dtype == np.float32
    for a, *factors in zip(batch, q, r, order, strict=True):
        assert_factorisation(a, tolerance=10 * np.finfo(np.float32).eps, factors=factors)


def test_members_that_are_not_finite_keep_to_themselves():
    batch, _ = batch_of_kinds(SHAPES["square"], seed=9)
    spoilt = batch.copy()
    spoilt[3, 1, 2], spoilt[70, 0, 0] = np.nan, np.inf
    _, expected, _ = factorise_batch(batch)
    _, r, order = factorise_batch(spoilt)
    others = np.delete(np.arange(MEMBERS), [3, 70])
    np.testing.assert_array_equal(r[others], expected[others])
    assert not np.isfinite(r[3]).all()
    assert not np.isfinite(r[70]).all()
    np.testing.assert_array_equal(np.sort(order, axis=1), np.broadcast_to(np.arange(6), order.shape))
    np.testing.assert_array_equal(np.sort(factorise(spoilt[3]).order), np.arange(6))


def test_a_large_batch_in_loops_of_different_length():
    """A batched `while_loop` in which each member is factorised as often as it says."""

    def repeated(a, times):
        return jax.lax.while_loop(lambda c: c[1] < times, lambda c: (pivoted_qr(c[0]).r, c[1] + 1), (a, 0))[0]

    batch, _ = batch_of_kinds(SHAPES["square"], seed=10)
    times = np.arange(MEMBERS) % 2
    found = jax.jit(jax.vmap(repeated))(batch, times)
    expected = np.where(times[:, None, None] == 1, factorise_batch(batch).r, batch)
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_derivatives_of_solves_in_a_large_batch():
    """Forward and reverse, inside and outside of `vmap`, are those of the members one after another."""
    rng = np.random.default_rng(11)
    rows, direction = rng.normal(size=(2, ENTRIES // 12 + 1, 2, 4))
    mass, force = np.diag([1.0, 2.0, 3.0, 4.0]), np.arange(4.0)

    def size(rows):
        jacobian = rows[jnp.array([0, 1, 0])]
        inverse = invert(mass, jacobian, jnp.ones(4), 1e-9)
        return jnp.sum(constrained_solve(inverse, mass, jacobian, force, jnp.array([1.0, 2.0, 1.0]))[0] ** 2)

    @jax.jit
    def all_of_them(rows, direction):
        total = lambda rows: jnp.sum(jax.vmap(size)(rows))
        return (
            jax.lax.map(jax.grad(size), rows),
            jax.vmap(jax.grad(size))(rows),
            jax.grad(total)(rows),
            jax.jvp(jax.vmap(size), (rows,), (direction,))[1],
            jax.linearize(jax.vmap(size), rows)[1](direction),
        )

    expected, inside, outside, forward, linear = all_of_them(rows, direction)
    scale = np.max(np.abs(expected))
    for found in (inside, outside):
        np.testing.assert_allclose(found, expected, atol=1e-11 * scale)
    for found in (forward, linear):
        np.testing.assert_allclose(found, np.sum(expected * direction, axis=(1, 2)), atol=1e-10 * scale)


def test_a_large_batch_compiles_alike_whatever_the_sizes():
    texts = [
        factorise_batch.lower(jnp.zeros(shape)).as_text() for shape in [(600, 5, 3), (4096, 50, 30), (200, 30, 50)]
    ]
    assert len({text.count("stablehlo.while") for text in texts}) == 1


def test_an_accelerator_gets_one_loop_of_large_operations():
    traced = factorise_batch.trace(jnp.zeros((MEMBERS, *SHAPES["square"])))
    loops = {
        name: traced.lower(lowering_platforms=(name,)).as_text().count("stablehlo.while") for name in ("cpu", "cuda")
    }
    assert loops["cuda"] == 1 < loops["cpu"]
