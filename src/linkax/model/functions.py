"""Functions that users hand to a mechanism: laws of drives and forces."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from linkax.model.numbers import converted, number


class Law(eqx.Module):
    """A user's function as part of a mechanism: its numbers are traced, the rest is structure.

    Numbers are the arrays and floats in a function that is a pytree: an `equinox.Module`, or
    `jax.tree_util.Partial(function, numbers)`. A plain function is structure as a whole, so that
    another one, of the same text too, compiles anew.
    """

    numbers: tuple[Array, ...]
    structure: tuple = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    what: str = eqx.field(static=True)

    def __init__(self, function: Callable, shape, what: str):
        leaves, tree = jax.tree.flatten(function)
        is_number = [eqx.is_array(leaf) or isinstance(leaf, float) for leaf in leaves]
        self.numbers = tuple(jnp.asarray(leaf) for leaf, traced in zip(leaves, is_number, strict=True) if traced)
        rest = tuple(None if traced else leaf for leaf, traced in zip(leaves, is_number, strict=True))
        self.structure = (tree, tuple(is_number), rest)
        self.shape, self.what = shape, what

    def __call__(self, *arguments):
        tree, is_number, rest = self.structure
        numbers = iter(self.numbers)
        leaves = [next(numbers) if traced else leaf for traced, leaf in zip(is_number, rest, strict=True)]
        try:
            found = jax.tree.unflatten(tree, leaves)(*arguments)
        except Exception as error:
            raise ValueError(f"{self.what}: its function raises {raised(error)}") from error
        found = converted(found, f"{self.what}: what its function returns", jnp.asarray)
        if found.shape != self.shape:
            expected = "a single number" if self.shape == () else f"an array of shape {self.shape}"
            raise ValueError(f"{self.what}: its function returns shape {found.shape}; it must return {expected}")
        return found if jnp.issubdtype(found.dtype, jnp.floating) else 1.0 * found


def raised(error) -> str:
    """What a user's function raised, and what it is often due to."""
    first, *_ = str(error).split("\n")
    remedy = "make it of operations of jax.numpy, with jnp.where in place of if"
    return f"{type(error).__name__}: {first}; JAX traces it, so {remedy}"


def number_or_law(entry, shape: tuple[int, ...], what: str):
    """A traced number of the given shape, or a function that returns one."""
    return Law(entry, shape, what) if callable(entry) else number(entry, shape, what)


def evaluated(entry, *arguments):
    """A number, or what a `Law` says."""
    return entry(*arguments) if isinstance(entry, Law) else entry
