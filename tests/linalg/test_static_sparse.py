"""Products of matrices whose zeros are known: those of full matrices, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np

from linkax.linalg.static_sparse import sums_of_pairs

RNG = np.random.default_rng(0)
K, N = 5, 7


def test_sums_of_pairs():
    """M = Σ Jᵀ I J, its derivatives in both modes, and no more entries than there are."""
    has = RNG.random((K, N)) < 0.4
    inertia = RNG.normal(size=(K, 6, 6))
    inertia += inertia.swapaxes(1, 2)

    def sparse(jacobian):
        return sums_of_pairs(has, jacobian, jnp.einsum("kab,kjb->kja", inertia, jacobian))

    def dense(jacobian):
        return jnp.einsum("kia,kab,kjb->ij", jacobian, inertia, jacobian)

    jacobian, change = RNG.normal(size=(2, K, N, 6)) * has[:, :, None]
    common = np.any(has[:, :, None] & has[:, None, :], axis=0)
    assert len(sparse(jacobian).values) == np.count_nonzero(np.tril(common))

    entries = lambda jacobian: sparse(jacobian).dense()
    found, tangent = jax.jvp(entries, (jacobian,), (change,))
    whole, of_whole = jax.jvp(dense, (jacobian,), (change,))
    np.testing.assert_allclose(found, whole, atol=1e-13)
    np.testing.assert_allclose(tangent, of_whole, atol=1e-13)
    weight = RNG.normal(size=(N, N))
    slopes = [jax.vjp(of, jacobian)[1](weight)[0] * has[:, :, None] for of in (entries, dense)]
    np.testing.assert_allclose(*slopes, atol=1e-12)
