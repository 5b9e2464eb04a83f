"""Products with matrices of which most entries are known to be zero when a program is compiled.

What connects the bodies of a large mechanism concerns few of them at a time. Each product is computed by reading the
entries that it needs, where these are few, and as a product of full matrices where they are not.
"""

import jax.numpy as jnp
import numpy as np

SPARSE = 0.25  # of the entries: what is read is slower than what is in order
LARGE = 256  # entries of a full matrix that are not worth it


def constant_product(matrix: np.ndarray, values):
    """A constant matrix (k, n) times `values` (n, …): (k, …)."""
    flat = values.reshape(len(values), -1)
    width = int(np.max(np.count_nonzero(matrix, axis=1), initial=0))
    if not _is_worth_it(len(matrix) * width, matrix.size):
        found = jnp.asarray(matrix, values.dtype) @ flat
    else:
        # The nonzero entries of each row first, filled up with zeros.
        places = np.argsort(matrix == 0.0, axis=1, kind="stable")[:, :width]
        factors = jnp.asarray(np.take_along_axis(matrix, places, axis=1), values.dtype)
        found = jnp.sum(factors[:, :, None] * flat[places], axis=1)
    return found.reshape(len(matrix), *values.shape[1:])


def products_of_pairs(left: np.ndarray, right: np.ndarray, a, b):
    """The matrix of a_i · b_j, vectors (k, d) and (n, d), with i in `left` and j in `right`; zero where i is -1."""
    present = left >= 0
    pairs, source = np.unique((left * len(b) + right)[present], return_inverse=True)
    places = np.zeros(left.shape, dtype=int)
    if _is_worth_it(len(pairs), len(a) * len(b)):
        down, across = np.divmod(pairs, len(b))
        values = jnp.sum(a[down] * b[across], axis=-1)
        places[present] = 1 + source
    else:
        values = jnp.ravel(a @ b.T)
        places[present] = 1 + pairs[source]
    return jnp.concatenate([jnp.zeros(1, values.dtype), values])[places]


def _is_worth_it(read, entries):
    return entries > LARGE and read <= SPARSE * entries
