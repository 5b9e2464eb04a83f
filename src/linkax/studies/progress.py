"""What studies of many steps show: a bar, and names of numbers in trees."""

from tqdm import tqdm


def progress_bar(total: int, unit: str, progress: bool | None, **options) -> tqdm:
    """A bar that begins with compiling; `progress` None: where someone watches."""
    disable = None if progress is None else not progress
    return tqdm(total=total, desc="compiling", unit=unit, disable=disable, **options)


def path_parts(path) -> list[str]:
    """The keys, names and indices of a path in a pytree."""
    return [str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part)))) for part in path]
