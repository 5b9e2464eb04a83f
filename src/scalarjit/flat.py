"""A pytree as its arrays and one static object, through which JAX goes at once.

A mechanism has hundreds of nodes. JAX and Equinox go through all of them whenever it is handed to a program, which
takes longer than a short run.
"""

from functools import cached_property
from typing import Any, Generic, TypeVar

import jax
import numpy as np
from jax.tree_util import register_pytree_node_class

Tree = TypeVar("Tree")


def is_array(leaf: Any) -> bool:
    """Whether a leaf is an array of JAX or NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


class Structure:
    """What is static: the leaves that are no arrays, how they make a tree, what was noted; compared quickest first."""

    def __init__(self, others: tuple[Any, ...], treedef: Any, noted: Any) -> None:
        self.others, self.treedef, self.noted = others, treedef, noted

    @cached_property
    def _hash(self):
        return hash((self.others, self.treedef, self.noted))

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other or not isinstance(other, Structure):
            return self is other
        same = self._hash == other._hash and self.noted == other.noted
        return same and self.treedef == other.treedef and self.others == other.others


@register_pytree_node_class
class Flat(Generic[Tree]):
    """A pytree whose children are the arrays of another, its `tree`.

    `noted`: what is kept with it, static and hashable, whatever a transformation does to the arrays.
    """

    def __init__(self, arrays: tuple[Any, ...], structure: Structure) -> None:
        self.arrays, self._structure = arrays, structure

    @staticmethod
    def of(tree: Tree, noted: Any = None) -> "Flat[Tree]":
        """All arrays of a tree, NumPy's too; other leaves are static, as to `equinox.filter_jit`."""
        leaves, treedef = jax.tree.flatten(tree)
        others = tuple(None if is_array(leaf) else leaf for leaf in leaves)
        return Flat(tuple(filter(is_array, leaves)), Structure(others, treedef, noted))

    @cached_property
    def tree(self) -> Tree:
        """The tree."""
        arrays = iter(self.arrays)
        # Of leaves, None is none: what is None in `others` is an array's place.
        leaves = [next(arrays) if other is None else other for other in self._structure.others]
        return jax.tree.unflatten(self._structure.treedef, leaves)

    @property
    def noted(self) -> Any:
        """What was noted when it was made."""
        return self._structure.noted

    def tree_flatten(self) -> tuple[tuple[Any, ...], Structure]:
        """For JAX."""
        return self.arrays, self._structure

    @classmethod
    def tree_unflatten(cls, structure: Structure, arrays: Any) -> "Flat[Tree]":
        """For JAX."""
        return cls(tuple(arrays), structure)

    def __repr__(self) -> str:
        return repr(self.tree)

    def __reduce__(self) -> Any:
        # JAX does not pickle structures of classes.
        return Flat.of, (self.tree, self.noted)
