"""Coordinates and speeds of joints, by name and index."""

from typing import NamedTuple

import numpy as np


class Term(NamedTuple):
    """The name of a joint, and the index of one of its speeds from 0; None for its only one."""

    joint: str
    index: int | None


TermLike = str | tuple[str, int | None]  # a joint's name, or (name, index of its speed)


def term(entry: TermLike, what: str) -> Term:
    """Read a joint's name, or (name, index), as a user gives it; `what` names the element in errors."""
    joint, index = entry if isinstance(entry, tuple) and len(entry) == 2 else (entry, None)
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not isinstance(joint, str) or not (index is None or whole):
        raise ValueError(f"{what}: joint is {entry!r}; give the name of a joint, or (name, index of its speed)")
    return Term(joint, None if index is None else int(index))
