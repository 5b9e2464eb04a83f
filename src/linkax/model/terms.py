"""Coordinates and speeds of joints, by name and index, and linear combinations of them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Number, number, require
from linkax.xla.arrays import Array, Scalar


class Term(NamedTuple):
    """The name of a joint, and the index of one of its speeds from 0; None for its only one."""

    joint: str
    index: int | None


TermLike = str | tuple[str, int | None]  # a joint's name, or (name, index of its speed)
CombinationLike = TermLike | Mapping[str, Number] | Mapping[TermLike, Number]  # one joint, or {joint: factor}


def term(entry: TermLike, what: str) -> Term:
    """Read a joint's name, or (name, index), as a user gives it; `what` names the element in errors."""
    joint, index = entry if isinstance(entry, tuple) and len(entry) == 2 else (entry, None)
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not isinstance(joint, str) or not (index is None or whole):
        raise ValueError(f"{what}: joint is {entry!r}; give the name of a joint, or (name, index of its speed)")
    return Term(joint, None if index is None else int(index))


class Combination(eqx.Module):
    """A linear combination of coordinates of joints, or of their speeds: Σ factor × that of a term."""

    terms: tuple[Term, ...] = eqx.field(static=True)
    factors: Float[Array, " n"]

    def __init__(self, entry: CombinationLike, what: str) -> None:
        """Read {joint: factor}, or one joint with the factor one; `what` names the entry in errors."""
        alone = isinstance(entry, str | tuple)
        if not alone and (not isinstance(entry, Mapping) or not entry):
            raise ValueError(f"{what} is {entry!r}; give {{joint: factor, ...}}, or the name of a joint")
        keys, factors = ([entry], [1.0]) if alone else (list(entry), list(entry.values()))
        self.terms = tuple(term(key, what) for key in keys)
        remedy = "all are zero; give a factor that is not zero"
        self.factors = require(number(factors, (len(keys),), what), lambda x: (x != 0.0).any(), what, remedy)

    def of(self, value: Callable[[Term], Number]) -> Scalar:
        """Combine a value of each term."""
        found: Any = 0.0
        for along, factor in zip(self.terms, self.factors, strict=True):
            found = found + factor * value(along)
        return found

    def largest(self, unit: Callable[[Term], Number]) -> Scalar:
        """Compute the largest change of it by one unit of a term."""
        pairs = zip(self.terms, self.factors, strict=True)
        return jnp.max(jnp.abs(jnp.stack([factor * unit(along) for along, factor in pairs])))
