"""Progress bars of studies, and names of the numbers in pytrees."""

from collections.abc import Iterable
from typing import Any


def progress_bar(total: int, unit: str, progress: bool | None, **options: Any) -> Any:
    """A progress bar that begins with compiling; with `progress` None it shows only in a terminal."""
    from tqdm import tqdm

    disable = None if progress is None else not progress
    return tqdm(total=total, desc="compiling", unit=unit, disable=disable, **options)


def path_parts(path: Iterable[Any]) -> list[str]:
    """The keys, names and indices of a path in a pytree."""
    return [str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path]
