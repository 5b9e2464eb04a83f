"""Files of compiled code: each is whole, or not there."""

import hashlib
import uuid
from contextlib import suppress
from pathlib import Path

DIGEST = hashlib.sha256().digest_size
_folder: list[Path] = []


def keep_in(folder: Path | None) -> None:
    """Keep what is compiled in a folder from now on, or no longer."""
    _folder[:] = [] if folder is None else [folder]


def folder() -> Path | None:
    """Where what is compiled is kept, if it is."""
    return _folder[0] if _folder else None


def read(name: str) -> bytes | None:
    """A file of the folder; None where there is none, or a damaged one."""
    if not _folder:
        return None
    try:
        found = (_folder[0] / name).read_bytes()
    except OSError:
        return None
    if hashlib.sha256(found[DIGEST:]).digest() == found[:DIGEST]:
        return found[DIGEST:]
    remove(name)
    return None


def write(name: str, content: bytes) -> None:
    """Write a file of the folder, as far as there is one with room in it."""
    if not _folder:
        return
    part = _folder[0] / f".unfinished-{uuid.uuid4().hex}"
    with suppress(OSError):
        _folder[0].mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(hashlib.sha256(content).digest() + content)
            part.replace(_folder[0] / name)
        finally:
            part.unlink(missing_ok=True)


def remove(name: str) -> None:
    """Remove a file of the folder."""
    with suppress(OSError):
        (_folder[0] / name).unlink()
