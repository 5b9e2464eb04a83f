"""Which coordinate or speed of a joint an element acts along."""

from typing import NamedTuple

import numpy as np


class Term(NamedTuple):
    """A joint's name, and which of its speeds, counted from 0; None for the only one."""

    joint: str
    index: int | None


TermLike = str | tuple[str, int | None]  # a joint's name, or (name, index of its speed)


def term(entry: TermLike, what: str) -> Term:
    """A joint's name, or (name, index), as a user gives it; `what` names the element in errors."""
    joint, index = entry if isinstance(entry, tuple) and len(entry) == 2 else (entry, None)
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not isinstance(joint, str) or not (index is None or whole):
        raise ValueError(f"{what}: joint is {entry!r}; give the name of a joint, or (name, index of its speed)")
    return Term(joint, None if index is None else int(index))
