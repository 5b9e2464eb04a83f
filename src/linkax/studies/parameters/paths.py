"""Names of the numbers in pytrees."""

from collections.abc import Iterable
from typing import Any


def path_parts(path: Iterable[Any]) -> list[str]:
    """The keys, names and indices of a path in a pytree."""
    return [str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path]
