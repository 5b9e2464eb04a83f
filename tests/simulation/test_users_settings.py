"""Known answers, a gradient, a batch and single precision with the settings that users have, which `.ci/run` asks for.

Other tests compile in less time, to code that runs slower. `AS_USERS_DO=1` leaves XLA's own settings.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import PASSING, REDUNDANT, known_slider_end, slider_end, slider_start, start
from mechanisms import pendulum

import linkax as lx

pytestmark = pytest.mark.users_settings

KNOWN = {name: known for name, known in (PASSING | REDUNDANT).items() if known.scene != "spatial-four-link"}
BOUNDS = {"SC3": 5e-9, "A02-1": 1e-7, "A02-2": 1e-7, "A02-5": 1e-6}
MASSES = np.array([0.5, 1.0, 2.0])


@pytest.mark.parametrize(
    "name", [name for name in KNOWN if KNOWN[name].scene in ("crank-slider", "n-four-bar", "bricard")]
)
def test_known_answers(name):
    known = KNOWN[name]
    found = known.simulate(accuracy=lx.PRECISE)
    assert np.max(known.error(found)) <= BOUNDS.get(name, 1e-9)
    assert found.worst_violation().position <= 1e-13


def test_a_gradient():
    slider_start()
    step = 1e-3
    expected = (known_slider_end(1.0 + step) - known_slider_end(1.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(slider_end)(1.0), expected, rtol=1e-4)


def test_a_batch():
    slider_start()
    found = jax.jit(jax.vmap(slider_end))(jnp.array(MASSES))
    np.testing.assert_allclose(found, [known_slider_end(mass) for mass in MASSES], atol=1e-6)


def test_single_precision():
    known = PASSING["SC4"]
    mechanism, state = start(known.scene, known.variant, known.changes)
    options = {"t1": 1.0, "accuracy": lx.DRAFT}
    single = lx.simulate(mechanism, state, dtype=jnp.float32, **options)
    double = lx.simulate(mechanism, state, **options)
    assert single.q.dtype == jnp.float32
    np.testing.assert_allclose(single.q, double.q, atol=1e-2)


def end_of_motion(angle):
    """Of a pendulum, assembled and run."""
    mechanism = pendulum()
    return lx.simulate(mechanism, lx.assemble(mechanism, {"hinge": angle}), t1=0.5).q[-1, 0]


@pytest.fixture(scope="module")
def in_one_program():
    """The same as one program."""
    return jax.jit(end_of_motion).lower(0.4).compile()


def test_assembly_may_be_part_of_a_program_with_callbacks(in_one_program):
    """Errors of Equinox call back to Python, which XLA finds no way to from some programs with loops."""
    np.testing.assert_allclose(in_one_program(0.4), end_of_motion(0.4), rtol=1e-10)
