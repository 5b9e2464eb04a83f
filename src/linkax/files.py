"""Write files so that each is whole or absent, and check that folders can be written to."""

import contextlib
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

UNFINISHED = ".unfinished-"


def writable_folder(path: Path, remedy: str) -> Path:
    """Make a folder where it does not exist, and check that it can be written to, before results are computed for it.

    **Raises:** `ValueError` where it cannot, which ends with the `remedy`.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path, prefix=UNFINISHED):
            return path
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot write to folder {str(path)!r}: {reason}; {remedy}") from error


@contextlib.contextmanager
def written_whole(path: Path, exclusive: bool = False) -> Iterator[Path]:
    """Yield a temporary path, and rename it to `path` once the file is on disk; remove it where the block fails.

    **Raises:** `FileExistsError` where `exclusive`, and another process was first.
    """
    # A name that no process has, on this machine or another.
    unfinished = path.with_name(_unfinished(f"{uuid.uuid4().hex}-{path.name}"))
    try:
        yield unfinished
        synced(unfinished)
        if exclusive:
            _place(unfinished, path)
        else:
            unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _place(unfinished, path):
    try:
        os.link(unfinished, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        unfinished.replace(path)


def synced(path: Path) -> None:
    """Wait until a file is on disk, where a loss of power cannot damage it."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files of this process, which is about to end."""
    for path in folder.glob(_unfinished("*")):
        path.unlink(missing_ok=True)


def _unfinished(name) -> str:
    return f"{UNFINISHED}{os.getpid()}-{name}"
