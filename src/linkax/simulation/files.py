"""Files that are whole or not there, and where they can be."""

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


def writable_folder(path: Path, remedy: str) -> Path:
    """A folder, made where it is not there, and tried before work is done whose results are to go there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            return path
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"cannot write to folder {str(path)!r}: {reason}; {remedy}") from error


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path to write to, renamed to `path` once all went well, and removed otherwise."""
    unfinished = path.with_name(f".unfinished-{os.getpid()}-{path.name}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
