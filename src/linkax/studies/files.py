"""Files that are whole or not there, and where they can be."""

import contextlib
import os
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

UNFINISHED = ".unfinished-"


def writable_folder(path: Path, remedy: str) -> Path:
    """A folder, made where it is not there, and tried before work is done whose results are to go there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path, prefix=UNFINISHED):
            return path
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot write to folder {str(path)!r}: {reason}; {remedy}") from error


@contextlib.contextmanager
def written_whole(path: Path, exclusive: bool = False) -> Iterator[Path]:
    """A temporary path to write to, renamed to `path` once all went well and is on disk, and removed otherwise.

    **Raises:** `FileExistsError` where `exclusive`, and another process was first.
    """
    # A name that no other process has, on another machine neither.
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


def synced(path: Path):
    """Wait until a file is on disk, whatever happens to the power then."""
    with open(path, "rb+") as file:
        os.fsync(file.fileno())


def remove_unfinished(folder: Path):
    """Remove what this process was writing, where it is about to end."""
    for path in folder.glob(_unfinished("*")):
        path.unlink(missing_ok=True)


def _unfinished(name) -> str:
    return f"{UNFINISHED}{os.getpid()}-{name}"
