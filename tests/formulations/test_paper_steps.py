"""The paper's steps, written out in NumPy and SciPy, give what `linkax.TangentSpace` gives.

`notebooks/method.ipynb` explains them.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import start
from scipy.linalg import qr

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.formulations.formulation import linear_system

TOLERANCE = 1e-6


def driven():
    """A crank-slider that a drive moves, with an arm that swings on its slider: b is not zero."""
    mechanism, _ = start("crank-slider", "SC4", {"rod": 1.5})
    arm = lx.rod("arm", 0.4, 2.0)
    mechanism = lx.Mechanism(
        [*mechanism.bodies, arm],
        [*mechanism.joints, lx.Revolute("hinge", mechanism.body("slider"), arm.at("base"), "z")],
        forces=mechanism.forces,
        constraints=[lx.Drive("motor", "bearing", lambda t: 1.0 + 2.0 * t)],
    )
    return mechanism, lx.assemble(mechanism, positions={"hinge": 0.5}, speeds={"hinge": 1.0})


# Mechanism and state, rank of J along the motion: Bricard's mechanism has a row too many.
CASES = {
    "crank-slider": (lambda: start("crank-slider", "SC4", {"speed": 2.0, "rod": 1.5}), 2),
    "bricard": (lambda: start("bricard", None, {"angle": 0.3, "speed": 1.0}), 4),
    "n-four-bar": (lambda: start("n-four-bar", None, {"N": 3, "angle": 1.2}), 6),
    "driven": (driven, 3),
}


class Split(NamedTuple):
    """L⁻ᵀQ₁, L⁻ᵀQ₂, R₁₁ of the independent rows, (r,), which are scaled; d."""

    normal: np.ndarray
    tangent: np.ndarray
    R11: np.ndarray
    rows: np.ndarray
    scale: np.ndarray
    distance: float

    def least_change(self, right):
        """δ = L⁻ᵀ Q₁ R₁₁⁻ᵀ (Pᵀ right)ᵣ."""
        return self.normal @ np.linalg.solve(self.R11.T, (self.scale * right)[self.rows])


def split(J, W, scales, most):
    """A P = Q R of A = L⁻¹Jᵀ, each row of J as long as it is in units of the speeds."""
    to_metric = np.linalg.inv(np.linalg.cholesky(W))
    A = to_metric @ J.T
    scale = np.linalg.norm(J * scales, axis=1) / np.linalg.norm(A, axis=0)
    Q, R, order = qr(A * scale, pivoting=True)
    size = np.abs(np.diag(R))
    r = min(most, np.sum(size > TOLERANCE * max(size[0], 1.0)))
    basis = to_metric.T @ Q
    return Split(basis[:, :r], basis[:, r:], R[:r, :r], order[:r], scale, size[most - 1] / size[0])


def metric_of(metric, J, M, scales):
    """W: units of the speeds, or M + JᵀDJ."""
    if metric == "identity":
        return np.diag(scales**-2.0)
    D = (J * scales) ** 2 @ (np.diag(M) * scales**2) / np.sum((J * scales) ** 2, axis=1) ** 2
    return M + (J.T * D) @ J


def accelerations(split, J, M, f, gamma):
    """v̇ by the projected equation, and λ of the independent rows, zero for the others."""
    normal, T = split.least_change(gamma), split.tangent
    acceleration = normal + T @ np.linalg.solve(T.T @ M @ T, T.T @ (f - M @ normal))
    multipliers = np.zeros(len(J))
    multipliers[split.rows] = np.linalg.solve(split.R11, split.normal.T @ (M @ acceleration - f))
    return acceleration, split.scale * multipliers


@eqx.filter_jit
def of_linkax(method, system, q, v):
    """c, J, M, b, f, γ at a state off the loops or on them, and every step there."""
    linear = linear_system(system, 0.0, q)
    factors, motion = method.split(linear), move(linear.configuration, v)
    c, b = residual(linear.configuration), rate(linear.configuration)
    f, right = generalised_force(motion), gamma(motion)
    acceleration, multipliers = method.solve_accelerations(linear, factors, f, right, refinements=2)
    return {
        "equations": (c, linear.jacobian, linear.mass, b, f, right),
        "distance": factors.distance,
        "position": method.correct_position(linear, factors, linear.configuration),
        "velocity": method.correct_velocity(linear, factors, v, refinements=2),
        "acceleration": acceleration,
        "reaction": linear.jacobian.T @ multipliers,
        "tangential": method.tangential_part(linear, factors, v),
    }


def written_out(metric, found, scales, most, q, v):
    """The same steps from c, J, M, b, f and γ."""
    c, J, M, b, f, right = map(np.asarray, found["equations"])
    W = metric_of(metric, J, M, scales)
    at = split(J, W, scales, most)
    along = at.tangent @ (at.tangent.T @ W @ v)
    acceleration, multipliers = accelerations(at, J, M, f, right)
    return {
        "distance": at.distance,
        "position": q + at.least_change(-c),
        "velocity": along + at.least_change(b),
        "acceleration": acceleration,
        "reaction": J.T @ multipliers,
        "tangential": along,
    }


@pytest.mark.parametrize("metric", ["identity", "mass"])
@pytest.mark.parametrize(
    "scene", ["crank-slider", "bricard", "driven", pytest.param("n-four-bar", marks=pytest.mark.slow)]
)
def test_steps_written_out(scene, metric):
    case, rank = CASES[scene]
    mechanism, state = case()
    system = system_of(mechanism, float)
    scales, random = np.asarray(system.scales), np.random.default_rng(2)
    method = lx.TangentSpace(TOLERANCE, metric=metric).prepared(float, jnp.array([rank]))
    pushed = lambda part, size: np.asarray(part) + size * scales * random.normal(size=len(scales))
    q, v = pushed(state.q, 1e-3), pushed(state.v, 1e-2)
    opened = []

    def compare(steps):
        found = of_linkax(method, system, jnp.asarray(q), jnp.asarray(v))
        own = written_out(metric, found, scales, rank, q, v)
        opened.append(np.max(np.abs(found["equations"][0])))
        for step in steps:
            size = max(np.max(np.abs(own[step])), 1.0)
            np.testing.assert_allclose(found[step], own[step], rtol=0.0, atol=1e-12 * size, err_msg=step)
        return own

    # In the paper's order: each step at the state that those before it have corrected.
    for _ in range(3):
        q = compare(["distance", "position"])["position"]
    corrected = compare(["velocity"])["velocity"]
    assert np.any(np.asarray(rate(configure(system, 0.0, q))) != 0.0) == (scene == "driven")
    assert np.max(np.abs(corrected - v)) > 1e-3
    v = corrected
    compare(["distance", "position", "velocity", "acceleration", "reaction", "tangential"])
    assert opened[0] > 1e-4
    assert opened[-1] < 1e-14
