"""Rodas5P as a solver of diffrax: orders, stiff problems, derivatives."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

TIMES = jnp.array([0.77, 1.5, 2.0])  # between steps, on them, and at the end


def _pendulum(t, y, torque):
    """Of unit length, swinging far, driven."""
    return jnp.stack([y[1], -jnp.sin(y[0]) + torque * jnp.cos(2.0 * t) * y[1]])


def _solved(steps, parameter, y0, solver, field, adjoint):
    options = {"saveat": diffrax.SaveAt(ts=TIMES), "stepsize_controller": diffrax.ConstantStepSize()}
    term, step = diffrax.ODETerm(field), 2.0 / steps
    return diffrax.diffeqsolve(term, solver, 0.0, 2.0, step, y0, parameter, adjoint=adjoint, **options).ys


_compiled = jax.jit(_solved, static_argnums=(3, 4, 5))


def _solve(steps, parameter, y0, solver=None, field=_pendulum, adjoint=None):
    solver, adjoint = solver or lx.Rodas5P(), adjoint or diffrax.RecursiveCheckpointAdjoint()
    return _compiled(steps, parameter, y0, solver, field, adjoint)


def _orders(counts, errors):
    return np.log2(errors[:-1] / errors[1:]) / np.log2(counts[1:] / counts[:-1])[:, None]


def test_orders():
    """Five at steps, four between them."""
    start, counts = jnp.array([1.0, 0.2]), np.array([8, 16, 32])
    exact = _solve(1000, 0.3, start, diffrax.Dopri8())
    errors = np.array([np.max(np.abs(_solve(n, 0.3, start) - exact), axis=1) for n in counts])
    orders = _orders(counts, errors)
    assert np.all(orders > [3.9, 4.8, 4.8])
    assert errors[-1, -1] < 1e-9


def _stiff(t, y, rate):
    return rate * (y - jnp.sin(t)) + jnp.cos(t)


@pytest.mark.parametrize("rate", [-1e4, -1e8])
def test_a_stiff_problem(rate):
    """ẏ = λ (y − sin t) + cos t (Prothero and Robinson, Mathematics of Computation 28, 1974), from off its solution."""
    counts = np.array([8, 16, 32])
    found = [_solve(n, rate, jnp.zeros(1), field=_stiff) for n in counts]
    errors = np.array([np.abs(ys[-1] - np.sin(2.0)) for ys in found])
    assert np.all(_orders(counts, errors) > 2.8)
    assert errors[0] < 1e-4 / abs(rate)
    disturbed = _solve(8, rate, jnp.ones(1), field=_stiff)
    np.testing.assert_allclose(disturbed[-1], np.sin(2.0), atol=1e-6)


@pytest.mark.slow
def test_derivatives_are_those_of_the_steps():
    end = lambda torque, adjoint=None: _solve(16, torque, jnp.array([1.0, 0.2]), adjoint=adjoint)[-1, 0]
    forwards, backwards = jax.jacfwd(lambda torque: end(torque, diffrax.ForwardMode()))(0.3), jax.grad(end)(0.3)
    step = 1e-5
    by_difference = (end(0.3 + step) - end(0.3 - step)) / (2.0 * step)
    np.testing.assert_allclose([forwards, backwards], by_difference, rtol=1e-8)
