"""Map parameters of a user's function to one vector without bounds, and back."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from linkax.model.numbers import is_finite, real, require
from linkax.studies.parameters.parameters import AbstractParameter
from linkax.studies.parameters.paths import path_parts
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline

NEAREST = 1e-15  # to an end of z, from where no step leads closer
CLOSER = 0.99  # of the way to it, that one step may go


class FreeParameters(eqx.Module):
    """Parameters as functions of a vector z, (p,).

    Plain numbers are in units of their start, so that their entries of z start at ±1, or at 0. Entries of z are between
    `ends`, and one step changes them by no more than `longest`, so that it does not lead to where a parameter, as a
    function of them, is flat.

    - `leaves`: arrays, and `AbstractParameter`s. `structure`: the pytree that they are leaves of.
    - `scales`: units of the free numbers of each leaf.
    - `names`: of all numbers. `leaf_names`: of the leaves.
    """

    leaves: list[Array | AbstractParameter]
    scales: list[Array]
    structure: Any = eqx.field(static=True)
    names: list[str] = eqx.field(static=True)
    leaf_names: list[str] = eqx.field(static=True)

    @staticmethod
    def of(params: Any) -> "FreeParameters":
        """Read a pytree of numbers, arrays, `Positive`, `Bounded` and `PhysicalInertia`.

        **Raises:** `ValueError` for leaves that are no numbers, or not finite.
        """
        leaves, structure = jax.tree.flatten(params, is_leaf=_is_parameter)
        if not leaves:
            raise ValueError(f"params are {params!r}; give at least one number")
        paths = [path for path, _ in jax.tree.leaves_with_path(params, is_leaf=_is_parameter)]
        names = []
        for path, leaf in zip(paths, leaves, strict=True):
            _check(path, leaf)
            for inner, part in jax.tree.leaves_with_path(leaf.value if isinstance(leaf, AbstractParameter) else leaf):
                names += _names((*path, *inner), jnp.shape(part))
        leaves: list[Array | AbstractParameter] = [
            leaf if isinstance(leaf, AbstractParameter) else jnp.asarray(leaf, float) for leaf in leaves
        ]
        leaf_names = [_names(path, ())[0] for path in paths]
        return FreeParameters(leaves, list(map(_scales, leaves)), structure, names, leaf_names)

    def _starts(self):
        free = [leaf.free if isinstance(leaf, AbstractParameter) else leaf for leaf in self.leaves]
        return [value / scale for value, scale in zip(free, self.scales, strict=True)]

    @property
    @jit_inline
    def start(self) -> Float[Array, " p"]:
        """z where the fit starts."""
        return ravel_pytree(self._starts())[0]

    def starts(self, values: Any) -> Float[Array, "n p"]:
        """z at several values of the parameters, which have an axis of that number before theirs.

        **Raises:** `ValueError` for values of another structure or shape.
        """
        shapes = [jax.tree.map(jnp.shape, getattr(leaf, "value", leaf)) for leaf in self.leaves]
        try:
            parts = [jax.tree.map(jnp.asarray, part) for part in self.structure.flatten_up_to(values)]
            counts = {jnp.shape(part)[0] for part in jax.tree.leaves(parts)}
            fits = len(counts) == 1 and [jax.tree.map(lambda x: x.shape[1:], part) for part in parts] == shapes
        except (IndexError, TypeError, ValueError):
            fits = False
        if not fits:
            raise ValueError(
                f"starts are {values!r}; give what params are, plain numbers in place of linkax.Positive and its like, "
                "each with the same first axis, one entry for each start"
            )

        return jax.vmap(self._of_values)(parts)

    @jit_inline
    def _of_values(self, values):
        """z of the values of the leaves, NaN where it is not between the ends."""
        leaves = [
            eqx.tree_at(lambda leaf: leaf.value, leaf, value) if _is_parameter(leaf) else value
            for leaf, value in zip(self.leaves, values, strict=True)
        ]
        z = eqx.tree_at(lambda free: free.leaves, self, leaves).start
        lower, upper = self.ends
        return jnp.where((z >= lower) & (z <= upper), z, jnp.nan)

    def _of_entries(self, of_leaf) -> Float[Array, " p"]:
        """A number for each entry of z."""
        each = [of_leaf(leaf) if _is_parameter(leaf) else jnp.inf for leaf in self.leaves]
        parts = [jnp.broadcast_to(jnp.asarray(x, float), s.shape) for x, s in zip(each, self.scales, strict=True)]
        return ravel_pytree(parts)[0]

    @property
    @jit_inline
    def ends(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Of each entry of z, minus and plus infinity where it has none."""
        return -self._of_entries(lambda leaf: -leaf.ends[0]), self._of_entries(lambda leaf: leaf.ends[1])

    @property
    @jit_inline
    def longest(self) -> Float[Array, " p"]:
        """Largest change of each entry of z in one step."""
        return self._of_entries(lambda leaf: leaf.longest)

    @jit_inline
    def magnitudes(self, z: Float[Array, " p"]) -> Float[Array, " p"]:
        """Of each entry of z, which a change of it is small or large against: of a logarithm at least one."""
        return jnp.maximum(jnp.abs(z), jnp.where(jnp.isfinite(self.longest), 1.0, 0.0))

    @jit_inline
    def room(self, z: Float[Array, " p"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Least and largest change of each entry of z in one step: not to an end, and no longer than the longest."""
        lower, upper = self.ends
        way = lambda apart: jnp.minimum(CLOSER * jnp.where(apart > NEAREST, apart, 0.0), self.longest)
        return -way(z - lower), way(upper - z)

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lower and upper bounds of all numbers that are `apart`, infinite where there is none."""
        lower, upper = self.ends
        return np.asarray(self.vector(lower)), np.asarray(self.vector(upper))

    def _parts(self, z) -> list[Any]:
        """z in the structure of the free numbers of the leaves."""
        restored: Any = ravel_pytree(self._starts())[1]
        return restored(z)

    def prior(self, z: Float[Array, " p"]) -> Float[Array, " k"]:
        """The residual of priors: what is normal beforehand, with standard deviation 1."""
        parts = [part for part, leaf in zip(self._parts(z), self.leaves, strict=True) if has_prior(leaf)]
        return ravel_pytree(parts)[0]

    @property
    def num_priors(self) -> int:
        """Number of entries of `prior`."""
        return sum(scale.size for scale, leaf in zip(self.scales, self.leaves, strict=True) if has_prior(leaf))

    @jit_inline
    def params(self, z: Float[Array, " p"]) -> Any:
        """The argument of the user's function, at z."""
        free = [part * scale for part, scale in zip(self._parts(z), self.scales, strict=True)]
        values = [
            leaf.value_of(x) if isinstance(leaf, AbstractParameter) else x
            for leaf, x in zip(self.leaves, free, strict=True)
        ]
        return jax.tree.unflatten(self.structure, values)

    def at(self, params: Any) -> Float[Array, " p"]:
        """z of numbers in the structure of `params`; NaN or infinite where they are out of bounds."""
        return self._of_values(self.structure.flatten_up_to(params))

    @jit_inline
    def vector(self, z: Float[Array, " p"]) -> Float[Array, " n"]:
        """All numbers of `params(z)`."""
        return ravel_pytree(self.params(z))[0]

    @property
    def free_names(self) -> list[str]:
        """Names of the entries of z: of one number each, or of a leaf whose numbers depend on several entries."""
        names, later = [], list(self.names)
        for of_leaf, leaf, scale in zip(self.leaf_names, self.leaves, self.scales, strict=True):
            size = _size(leaf)
            own, later = later[:size], later[size:]
            names += own if size == scale.size else [of_leaf] * scale.size
        return names

    @property
    def apart(self) -> Bool[np.ndarray, " n"]:
        """Whether each number of `vector` is a rising function of one entry of z alone."""
        sizes = [(_size(leaf), scale.size) for leaf, scale in zip(self.leaves, self.scales, strict=True)]
        return np.concatenate([np.full(numbers, numbers == free) for numbers, free in sizes])


def has_prior(leaf: Any) -> bool:
    """Whether the free numbers of a leaf have a prior."""
    return isinstance(leaf, AbstractParameter) and leaf.has_prior


def _is_parameter(node) -> bool:
    return isinstance(node, AbstractParameter)


def _size(leaf) -> int:
    """How many numbers the user's function gets of a leaf."""
    return sum(jnp.size(x) for x in jax.tree.leaves(getattr(leaf, "value", leaf)))


def _scales(leaf):
    """Units of the free numbers of a leaf."""
    if isinstance(leaf, AbstractParameter):
        return jnp.ones_like(leaf.free)
    return jnp.where(leaf == 0.0, 1.0, jnp.abs(leaf))


def _check(path, leaf):
    if isinstance(leaf, AbstractParameter):
        return
    name = _names(path, ())[0]
    what = f"parameter {name!r}"
    require(real(leaf, what), is_finite, what, "it must be finite")


def _names(path, shape) -> list[str]:
    name = ".".join(path_parts(path)) or "value"
    return [name + (f"[{', '.join(map(str, index))}]" if index else "") for index in np.ndindex(shape)]
