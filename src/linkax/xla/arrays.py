"""Types of arrays, for annotations."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

# JAX's arrays, or NumPy's where the values are known when a model is built.
Array = jax.Array | np.ndarray
# Arithmetic of NumPy's arrays without dimensions gives its scalars.
Scalar = Float[Array | np.floating, ""]
# And a number of Python's, which is no traced one.
ScalarLike = Scalar | float | int


def can_change(leaf: Any) -> bool:
    """Whether this is an array of NumPy's that can be written to."""
    return isinstance(leaf, np.ndarray) and leaf.flags.writeable
