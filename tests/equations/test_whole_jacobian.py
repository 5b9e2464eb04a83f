"""Functions whose Jacobians are computed whole: derivatives, also of batches in which some results are all alike."""

import jax
import jax.numpy as jnp
import numpy as np

from linkax.xla.whole_jacobian import whole_jacobian


def test_derivatives_are_those_of_the_function():
    def function(static, x, y):
        return static * jnp.sin(x) * y[0], jnp.ones((2, 3)), {"last": x}

    whole = lambda x, y: whole_jacobian(function)(3.0, x, y)
    one = lambda x, y: function(3.0, x, y)
    batch = lambda of: jax.jit(jax.vmap(of, (0, None)))
    x, y = jnp.linspace(0.1, 1.0, 12).reshape(4, 3), jnp.array([0.3, 0.4])
    for transform in (jax.jacfwd, jax.jacrev, lambda of: jax.jacfwd(jax.jacfwd(of))):
        found, right = transform(batch(whole))(x, y), transform(batch(one))(x, y)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-15), found, right)
