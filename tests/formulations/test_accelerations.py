"""The ways to accelerations and corrections of the classical formulations, on random systems of numbers."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.formulations.named import BASES, formulation

RANDOM = np.random.default_rng(1)
ROOT = RANDOM.normal(size=(6, 6))
MASS, FORCE = jnp.array(ROOT @ ROOT.T + np.eye(6)), jnp.array(RANDOM.normal(size=6))
INDEPENDENT = jnp.array(RANDOM.normal(size=(3, 6)))
REDUNDANT = jnp.array(RANDOM.normal(size=(5, 3))) @ INDEPENDENT
# Those that need independent rows.
NEEDY = ("lagrange-multipliers", "lagrange-multipliers-block")


def exact(jacobian, gamma):
    """v̇ and the least λ by dense least squares on the whole system."""
    m, n = jacobian.shape
    matrix = np.block([[MASS, -jacobian.T], [jacobian, np.zeros((m, m))]])
    solved = np.linalg.lstsq(matrix, np.concatenate([FORCE, gamma]), rcond=1e-10)[0]
    return solved[:n], solved[n:]


@pytest.mark.parametrize("name", BASES)
def test_accelerations_and_multipliers(name):
    solve = eqx.filter_jit(BASES[name].acceleration)
    for jacobian in (INDEPENDENT, REDUNDANT):
        gamma = jacobian @ jnp.arange(6.0)
        if jacobian is REDUNDANT and name in NEEDY:
            # Where rounding makes the rows independent they may do well; a row of zeros it does not.
            jacobian, gamma = jacobian.at[0].set(0.0), gamma.at[0].set(0.0)
            assert not np.all(np.isfinite(solve(MASS, jacobian, FORCE, gamma)[0]))
            continue
        acceleration, multipliers = solve(MASS, jacobian, FORCE, gamma)
        expected, least = exact(jacobian, gamma)
        np.testing.assert_allclose(acceleration, expected, atol=1e-7)
        np.testing.assert_allclose(jacobian.T @ multipliers, jacobian.T @ least, atol=1e-5)
        if "gram-schmidt" not in name:  # which gives none to rows that it leaves out
            np.testing.assert_allclose(multipliers, least, atol=1e-5)


def test_sweeps_of_the_augmented_lagrangian_close_what_the_penalty_leaves_open():
    gamma = INDEPENDENT @ jnp.arange(6.0)
    open_ = []
    for sweeps in (1, 2, 3):
        solve = eqx.filter_jit(lx.AugmentedLagrangian(penalty=1e2, sweeps=sweeps))
        open_.append(float(jnp.max(jnp.abs(INDEPENDENT @ solve(MASS, INDEPENDENT, FORCE, gamma)[0] - gamma))))
    assert open_[0] > 1e-4
    assert open_[1] < 0.1 * open_[0]
    assert open_[2] < 0.1 * open_[1]


@pytest.mark.parametrize("correction", [lx.CoordinatePartitioning(), lx.MassOrthogonalProjection()])
def test_corrections_close_rows_and_each_moves_what_it_says(correction):
    for jacobian in (INDEPENDENT, REDUNDANT):
        back = correction.right_inverse(MASS, jacobian)
        np.testing.assert_allclose(jacobian @ back @ jacobian, jacobian, atol=1e-10)
        if isinstance(correction, lx.MassOrthogonalProjection):
            tangent = np.linalg.svd(jacobian)[2][3:]
            np.testing.assert_allclose(tangent @ MASS @ back, 0.0, atol=1e-10)
        else:
            assert np.sum(np.any(np.asarray(back) != 0.0, axis=1)) == 3


def test_names_combine():
    found = formulation("moore-penrose-svd+baumgarte+projection")
    assert found.acceleration.inverse == "svd"
    assert (found.stabilisation.alpha, found.stabilisation.beta) == (5.0, 5.0)
    assert isinstance(found.correction, lx.MassOrthogonalProjection)
    assert isinstance(formulation("tangent-space"), lx.TangentSpace)
    assert dataclasses.replace(found, correction=None).correction is None


def test_in_single_precision_rounding_is_no_independent_row():
    gamma = REDUNDANT @ jnp.arange(6.0)
    expected = exact(REDUNDANT, gamma)[0]
    for name in ("udwadia-kalaba", "moore-penrose-svd", "moore-penrose-gram-schmidt", "projection-operator"):
        single = [jnp.asarray(part, jnp.float32) for part in (MASS, REDUNDANT, FORCE, gamma)]
        acceleration, _ = eqx.filter_jit(BASES[name].acceleration)(*single)
        np.testing.assert_allclose(acceleration, expected, rtol=1e-2, atol=1e-2)


def test_mass_may_be_singular_where_the_rows_hold_it():
    mass, jacobian = jnp.diag(jnp.array([1.0, 2.0, 0.0])), jnp.array([[0.0, 1.0, 1.0]])
    for name in ("augmented-lagrangian", "lagrange-multipliers-block"):
        acceleration, _ = BASES[name].acceleration(mass, jacobian, jnp.array([1.0, 1.0, 0.5]), jnp.array([0.3]))
        np.testing.assert_allclose(acceleration, [1.0, 0.25, 0.05], atol=1e-6)


def test_parts_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"acceleration of ClassicalFormulation is 'lagrange', which is none"):
        lx.ClassicalFormulation("lagrange")
    with pytest.raises(ValueError, match=r"sweeps of AugmentedLagrangian is 0; it must be an integer of at least 1"):
        lx.AugmentedLagrangian(sweeps=0)


BAD = (
    "augmented-lagrangian+baumgarte",
    "lm",
    "lagrange-multipliers+magic",
    "tangent-space+baumgarte",
    "udwadia-kalaba+partitioning+projection",
    "",
)


@pytest.mark.parametrize("name", BAD)
def test_an_unknown_name_names_the_known_ones(name):
    with pytest.raises(ValueError, match=r"unknown formulation .*; known: tangent-space, or one of lagrange-mult"):
        formulation(name)


def test_bad_numbers_name_the_element():
    with pytest.raises(ValueError, match=r"alpha of Baumgarte \[1/s\] is -1.0; it must be zero or more"):
        lx.Baumgarte(-1)
    with pytest.raises(ValueError, match=r"tolerance of MoorePenrose is nan; it must be finite"):
        lx.MoorePenrose(tolerance=np.nan)
    with pytest.raises(ValueError, match=r"inverse of MoorePenrose is 'qr'; known: 'svd', 'gram-schmidt'"):
        lx.MoorePenrose("qr")
