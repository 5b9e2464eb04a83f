"""Values put at places of an array that are known when a program is compiled.

By reading each entry of the result from where it comes from. XLA's scatter, which writes, takes a step for each value
on a CPU, and cannot be part of a larger kernel there (see `linkax.xla.flags`).
"""

import jax.numpy as jnp
import numpy as np


def scatter_static(onto, places, values):
    """`onto` (n, …) with values at places along its first axis, as many of both; neither needs to be flat."""
    places = np.ravel(places)
    if not len(places):
        return onto
    source = np.full(len(onto), -1)
    source[places] = np.arange(len(places))
    values = jnp.reshape(values, (len(places), *onto.shape[1:]))
    chosen = (source >= 0).reshape(-1, *(1,) * (onto.ndim - 1))
    return jnp.where(chosen, values[np.maximum(source, 0)], onto)
