"""With `jax.disable_jit()`, as for debugging, all is computed operation by operation: slowly, with the same numbers."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, pendulum

import linkax as lx

TWO_STEPS = {"dt0": 0.01, "stepsize_controller": diffrax.ConstantStepSize(), "solver": lx.RungeKutta4(), "max_steps": 2}
START = lx.State(jnp.array([0.3]), jnp.array([0.2]))


def run(gravity):
    return lx.simulate(pendulum(gravity=gravity), START, t1=0.02, saveat=diffrax.SaveAt(t1=True), **TWO_STEPS).q[0, 0]


COMPUTED = {
    "simulate": lambda: run(9.81),
    "jacfwd": lambda: jax.jacfwd(run)(9.81),
    "grad": lambda: jax.grad(run)(9.81),
    "assemble": lambda: lx.assemble(crank_slider(), {"bearing": 0.5}, {"bearing": 2.0}).v,
    "linearise": lambda: lx.linearise(pendulum(), lx.State(jnp.array([-0.5 * np.pi]), jnp.zeros(1))).eigenvalues,
}


@pytest.mark.slow
@pytest.mark.parametrize("computed", COMPUTED.values(), ids=COMPUTED)
def test_nothing_is_compiled_and_numbers_are_the_same(computed):
    with jax.disable_jit():
        found = computed()
    np.testing.assert_allclose(found, computed(), rtol=1e-9, atol=1e-12)
