import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import PASSING, start

import linkax as lx
from linkax.scenes import SCENES

CLOSE = (0.5, 2.0)  # of estimates over errors; a run at a hundredth of the tolerance is far better


def position(solution):
    return solution.position("link", at="bob")


@pytest.fixture(scope="module")
def pendulum():
    return start("pendulum")


def exact(solution):
    scene = SCENES["pendulum"]
    return scene.exact(scene.settings(), np.asarray(solution.ts))["bob"]


def ratio(estimate, solution):
    return np.max(estimate) / np.max(np.abs(position(solution) - exact(solution)))


@pytest.mark.parametrize("dtype", [float, pytest.param(jnp.float32, marks=pytest.mark.slow)])
def test_estimates_are_the_errors(pendulum, dtype):
    found = lx.simulate(*pendulum, t1=5.0, accuracy=lx.DRAFT, dtype=dtype)
    estimate = found.error_estimate(position)
    assert estimate.shape == (201, 3)
    assert CLOSE[0] < ratio(estimate, found) < CLOSE[1]


def test_fixed_steps_are_halved(pendulum):
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.05, "solver": diffrax.Tsit5()}
    found = lx.simulate(*pendulum, t1=5.0, **fixed)
    assert CLOSE[0] < ratio(found.error_estimate(position), found) < CLOSE[1]


@pytest.mark.slow
def test_through_singular_configurations():
    known = PASSING["SC1"]
    found = known.simulate(accuracy=lx.DRAFT)
    estimate = found.error_estimate(lambda solution: solution.position("slider")[:, 0])
    assert CLOSE[0] < np.max(estimate) / np.max(known.error(found)) < CLOSE[1]


def test_members_of_a_batch_are_estimated_each(pendulum):
    mechanism, state = pendulum
    of_speed = lambda v: lx.simulate(mechanism, lx.State(state.q, v), t1=1.0, accuracy=lx.DRAFT)
    speeds = jnp.stack([state.v, state.v + 1.0])
    estimates = jax.vmap(of_speed)(speeds).error_estimate()
    alone = [of_speed(v).error_estimate() for v in speeds]
    assert estimates.shape == (2, 201, 1)
    np.testing.assert_allclose(estimates, alone, rtol=1e-3, atol=1e-12)


def test_times_that_were_not_reached_have_no_estimate(pendulum):
    found = lx.simulate(*pendulum, t1=5.0, accuracy=lx.DRAFT, max_steps=4, throw=False)
    estimate = found.error_estimate()[:, 0]
    np.testing.assert_array_equal(np.isnan(estimate), np.isinf(found.ts))


def test_what_cannot_be_estimated_says_so(pendulum):
    mechanism, state = pendulum
    with pytest.raises(ValueError, match=r"linkax\.simulate"):
        lx.Solution.of_state(mechanism, state).error_estimate()
    given = lx.simulate(*pendulum, t1=1.0, stepsize_controller=diffrax.StepTo(jnp.linspace(0.0, 1.0, 50)))
    with pytest.raises(ValueError, match="StepTo cannot be refined"):
        given.error_estimate()
