"""Numbers behind the items of Equinox's enumerations, for batches, which have one in each member."""

from typing import Any

import equinox as eqx
import numpy as np
from equinox._enum import EnumerationItem
from jaxtyping import Int

from linkax.xla.arrays import Array


def code(item: eqx.Enumeration | EnumerationItem) -> Int[Array | np.integer, "..."]:
    """The number of an item, or the numbers of a batch."""
    return item._value


def item(numbers: Int[Array, "..."], enumeration: type[eqx.Enumeration]) -> EnumerationItem:
    """The item of a number, or of each of a batch."""
    return EnumerationItem(numbers, enumeration)  # pyright: ignore[reportCallIssue]


def is_item(node: Any, enumeration: type[eqx.Enumeration]) -> bool:
    """Whether something is an item of an enumeration, or a batch of such."""
    return isinstance(node, EnumerationItem) and node._enumeration is enumeration
