"""Products with matrices whose zeros are known when a program is compiled.

In a large mechanism each body concerns few others. Where few entries are needed, they are read one by one; else the
matrices are multiplied. XLA computes an entry anew wherever it is read, so one such product must not follow another.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from linkax.xla.arrays import Array

SPARSE = 0.25  # of the entries: what is read is slower than what is in order
LARGE = 256  # entries of a full matrix that are not worth it


def constant_product(matrix: Shaped[np.ndarray, "k n"], values: Float[Array, "n ..."]) -> Float[jax.Array, "k ..."]:
    """Multiply a constant matrix (k, n) with `values` (n, …): (k, …)."""
    flat = values.reshape(len(values), -1)
    width = int(np.max(np.count_nonzero(matrix, axis=1), initial=0))
    if not _is_worth_it(len(matrix) * width, matrix.size):
        found = jnp.asarray(matrix, values.dtype) @ flat
    else:
        # The nonzero entries of each row first, filled up with zeros.
        columns = np.argsort(matrix == 0.0, axis=1, kind="stable")[:, :width]
        factors = jnp.asarray(np.take_along_axis(matrix, columns, axis=1), values.dtype)
        found = jnp.sum(factors[:, :, None] * flat[columns], axis=1)
    return found.reshape(len(matrix), *values.shape[1:])


class StaticSparse(NamedTuple):
    """A matrix by its entries that may differ from zero.

    - `values`: (k,). `indices`: for each entry of the matrix 1 + its index in `values`, 0 for a zero.
    """

    values: Float[Array, " k"]
    indices: np.ndarray

    @staticmethod
    def whole(matrix: Float[Array, "m n"]) -> "StaticSparse":
        """Take all entries of a matrix."""
        return StaticSparse(jnp.ravel(matrix), 1 + np.arange(matrix.size).reshape(matrix.shape))

    @staticmethod
    def stacked(parts: "list[StaticSparse]") -> "StaticSparse":
        """Stack the rows of several matrices."""
        first = np.cumsum([0, *(len(part.values) for part in parts)])
        indices = [part.indices + start * (part.indices > 0) for part, start in zip(parts, first, strict=False)]
        return StaticSparse(jnp.concatenate([part.values for part in parts]), np.concatenate(indices))

    def plus_diagonal(self, added: Float[Array, " n"]) -> "StaticSparse":
        """Add to the diagonal, each entry of which is among `values`."""
        place = np.zeros(self.values.shape, dtype=int)
        place[np.diagonal(self.indices) - 1] = 1 + np.arange(len(added))
        nothing = jnp.zeros(1, self.values.dtype)
        return self._replace(values=self.values + jnp.concatenate([nothing, added])[place])

    def at(self, down: Int[np.ndarray, "..."] | slice, across: Int[np.ndarray, "..."] | slice) -> Float[Array, "..."]:
        """Read entries, indexed as in NumPy."""
        nothing = jnp.zeros(1, self.values.dtype)
        return jnp.concatenate([nothing, self.values])[self.indices[down, across]]

    def dense(self) -> Float[Array, "m n"]:
        """Read all entries."""
        return self.at(slice(None), slice(None))


def products_of_pairs(
    left: Int[np.ndarray, "..."], right: Int[np.ndarray, "..."], a: Float[Array, "k d"], b: Float[Array, "n d"]
) -> StaticSparse:
    """The matrix of aᵢ · bⱼ, vectors (k, d) and (n, d), i in `left` and j in `right`; zero where i is −1."""
    present = left >= 0
    pairs, source = np.unique((left * len(b) + right)[present], return_inverse=True)
    indices = np.zeros(left.shape, dtype=int)
    if _is_worth_it(len(pairs), len(a) * len(b)):
        down, across = np.divmod(pairs, len(b))
        indices[present] = 1 + source
        return StaticSparse(jnp.sum(a[down] * b[across], axis=-1), indices)
    indices[present] = 1 + pairs[source]
    return StaticSparse(jnp.ravel(a @ b.T), indices)


def sums_of_pairs(has: Bool[np.ndarray, "k n"], a: Float[Array, "k n d"], b: Float[Array, "k n d"]) -> StaticSparse:
    """The matrix of Σₖ aₖᵢ · bₖⱼ, vectors (k, n, d) each, which are zero where `has` (k, n) is False.

    It has to be symmetric, as M = Σ Jᵀ I J is. Of a crane on beams it takes 18 % of the products of full matrices.
    """
    k, down, across = np.nonzero(has[:, :, None] & has[:, None, :] & np.tri(has.shape[1], dtype=bool))
    pairs, of_pair = np.unique(down * has.shape[1] + across, return_inverse=True)
    products = jnp.sum(a[k, down] * b[k, across], axis=-1)
    indices = np.zeros(2 * has.shape[1:], dtype=int)
    down, across = np.divmod(pairs, has.shape[1])
    indices[down, across] = indices[across, down] = 1 + np.arange(len(pairs))
    return StaticSparse(jnp.zeros(len(pairs), a.dtype).at[of_pair].add(products), indices)


def _is_worth_it(read, entries):
    return entries > LARGE and read <= SPARSE * entries


def assembled(
    shape: tuple[int, ...],
    parts: Sequence[tuple[tuple[Int[np.ndarray, "..."], ...], Float[Array, "..."]]],
    dtype: np.dtype,
) -> Float[Array, "..."]:
    """Make an array of parts (indices, values), zero elsewhere; indices as in NumPy, one array for each axis."""
    source = np.zeros(shape, dtype=int)
    first = 1
    for indices, values in parts:
        source[indices] = first + np.arange(values.size).reshape(values.shape)
        first += values.size
    values = [jnp.ravel(values) for _, values in parts]
    return StaticSparse(jnp.concatenate([jnp.zeros(0, dtype), *values]), source).dense()
