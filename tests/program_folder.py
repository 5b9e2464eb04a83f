"""The folder in which compiled programs are kept for the next run of the tests, which then takes half of the time."""

import hashlib
import os
from contextlib import suppress
from pathlib import Path

import jaxlib

from linkax.xla.program_cache import users_folder
from scalarjit.descriptions import of_processor

MOST_BYTES = 2**30  # a run of all fast tests writes a tenth of that


def program_folder() -> Path:
    """In the user's folder for caches, one for each version of jaxlib, flags of XLA, and processor."""
    around = jaxlib.__version__, os.environ.get("XLA_FLAGS"), of_processor()
    return users_folder() / "tests" / hashlib.sha256(repr(around).encode()).hexdigest()[:16]


def forget_oldest(folder: Path, most: int = MOST_BYTES) -> None:
    """Remove the files of a folder, and of those beside it, that were read longest ago, beyond so many bytes.

    `jax_compilation_cache_max_size` does that too, but goes through all files whenever it writes one.
    """
    found = []
    for path in folder.parent.glob("*/*"):
        with suppress(FileNotFoundError):  # which another run has just removed
            status = path.stat()
            found.append((max(status.st_atime, status.st_mtime), status.st_size, path))
    kept = 0
    for _, size, path in sorted(found, reverse=True):
        kept += size
        if kept > most:
            path.unlink(missing_ok=True)
