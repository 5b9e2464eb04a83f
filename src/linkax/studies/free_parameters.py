"""Parameters of a user's function as one vector that may take any value."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from linkax.model.numbers import is_finite, real, require
from linkax.studies.parameters import AbstractParameter
from linkax.studies.progress import path_parts


class FreeParameters(eqx.Module):
    """Parameters as functions of a vector z without bounds, whose entries for plain numbers all start near one.

    - `leaves`: numbers, arrays, and parameters that are functions; `structure`: of the tree that they are leaves of.
    - `scales`: of the free numbers of each leaf.
    - `names`: of all numbers; `leaf_names`.
    """

    leaves: list
    scales: list
    structure: Any = eqx.field(static=True)
    names: list[str] = eqx.field(static=True)
    leaf_names: list[str] = eqx.field(static=True)

    @staticmethod
    def of(params) -> "FreeParameters":
        """Of a pytree of numbers, arrays and `Positive` and its like.

        **Raises:** `ValueError` for leaves that are no numbers, or not finite.
        """
        leaves, structure = jax.tree.flatten(params, is_leaf=_is_parameter)
        if not leaves:
            raise ValueError(f"params are {params!r}; give at least one number")
        paths = [path for path, _ in jax.tree.leaves_with_path(params, is_leaf=_is_parameter)]
        names = []
        for path, leaf in zip(paths, leaves, strict=True):
            _check(path, leaf)
            for inner, part in jax.tree.leaves_with_path(leaf.value if _is_parameter(leaf) else leaf):
                names += _names((*path, *inner), jnp.shape(part))
        leaves = [leaf if _is_parameter(leaf) else jnp.asarray(leaf, float) for leaf in leaves]
        scales = [jnp.ones_like(leaf.free) if _is_parameter(leaf) else _magnitudes(leaf) for leaf in leaves]
        return FreeParameters(leaves, scales, structure, names, [_names(path, ())[0] for path in paths])

    def _starts(self):
        free = [leaf.free if _is_parameter(leaf) else leaf for leaf in self.leaves]
        return [value / scale for value, scale in zip(free, self.scales, strict=True)]

    @property
    def start(self) -> Float[Array, " p"]:
        """z of the parameters as they were given."""
        return ravel_pytree(self._starts())[0]

    def params(self, z):
        """What the user's function gets."""
        values = [part * scale for part, scale in zip(ravel_pytree(self._starts())[1](z), self.scales, strict=True)]
        found = [leaf.value_of(x) if _is_parameter(leaf) else x for leaf, x in zip(self.leaves, values, strict=True)]
        return jax.tree.unflatten(self.structure, found)

    def vector(self, z):
        """All numbers of `params`."""
        return ravel_pytree(self.params(z))[0]

    @property
    def free_names(self) -> list[str]:
        """Of the entries of z: their numbers' own, or of the leaf whose numbers they make together."""
        found, rest = [], list(self.names)
        for of_leaf, leaf, scale in zip(self.leaf_names, self.leaves, self.scales, strict=True):
            size = sum(jnp.size(x) for x in jax.tree.leaves(getattr(leaf, "value", leaf)))
            own, rest = rest[:size], rest[size:]
            found += own if size == scale.size else [of_leaf] * scale.size
        return found

    @property
    def apart(self) -> np.ndarray:
        """For each of these numbers, whether it is a rising function of one entry of z alone."""
        sizes = [
            (sum(jnp.size(x) for x in jax.tree.leaves(getattr(leaf, "value", leaf))), scale.size)
            for leaf, scale in zip(self.leaves, self.scales, strict=True)
        ]
        return np.concatenate([np.full(numbers, numbers == free) for numbers, free in sizes])


def _is_parameter(node):
    return isinstance(node, AbstractParameter)


def _magnitudes(values):
    return jnp.where(values == 0.0, 1.0, jnp.abs(values))


def _check(path, leaf):
    if _is_parameter(leaf):
        return
    name = _names(path, ())[0]
    what = f"parameter {name!r}"
    require(real(leaf, what), is_finite, what, "it must be finite")


def _names(path, shape) -> list[str]:
    name = ".".join(path_parts(path)) or "value"
    return [name + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)]
