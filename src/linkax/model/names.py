"""Names of elements: checked, and found among those that are known."""

from collections.abc import Sequence
from typing import Any


def find(name: Any, names: Sequence[str], what: str) -> int:
    """Find the index of a name among those of bodies, joints or others.

    **Raises:** `ValueError` that lists the known names.
    """
    if not isinstance(name, str) or name not in names:
        raise ValueError(f"unknown {what} {name!r}; known: {', '.join(map(repr, names)) or 'none'}")
    return names.index(name)


def optional_name(name: Any, kind: str) -> str | None:
    """Check the name of a force element, which may have none."""
    if name is not None and (not isinstance(name, str) or not name):
        raise ValueError(f"{kind}: name is {name!r}; give a non-empty string, or None")
    return name
