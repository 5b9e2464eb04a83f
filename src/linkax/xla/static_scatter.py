"""Writing to indices that are known when a program is compiled.

Each entry of the result reads where it comes from. XLA's scatter, which writes, takes a step for each value on a CPU.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from linkax.xla.arrays import Array


def scatter_static(
    onto: Float[Array, "*shape"], places: Int[np.ndarray, "..."] | tuple[int, ...], values: Float[Array, "..."]
) -> Float[Array, "*shape"]:
    """Write values to indices along the first axis of `onto`, (n, …); indices and values need not be flat."""
    places = np.ravel(places)
    if not len(places):
        return onto
    source = np.full(len(onto), -1)
    source[places] = np.arange(len(places))
    values = jnp.reshape(values, (len(places), *onto.shape[1:]))
    chosen = (source >= 0).reshape(-1, *(1,) * (onto.ndim - 1))
    return jnp.where(chosen, values[np.maximum(source, 0)], onto)
