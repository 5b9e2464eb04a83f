"""Whether functions that LLVM compiles compute what JAX does."""

import jax
import numpy as np

from scalarjit import scalarised


def agrees(function, *args, rtol=1e-12, atol=1e-12):
    """Compare results with those of `jax.jit`: their types and shapes too."""
    found = jax.tree.leaves(scalarised(function)(*args))
    expected = jax.tree.leaves(jax.jit(function)(*args))
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        if one.dtype.kind == "f":
            scale = 1.0 if one.dtype == np.float64 else 1e6
            np.testing.assert_allclose(one, other, rtol=scale * rtol, atol=scale * atol)
        else:
            np.testing.assert_array_equal(one, other)


def numbers(*shape, seed=0, dtype=np.float64):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)
