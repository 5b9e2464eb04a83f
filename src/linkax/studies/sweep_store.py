"""Results of a sweep on disk, as they come."""

import contextlib
import json
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import zarr
from zarr.storage import MemoryStore

from linkax.studies.files import synced, writable_folder, written_whole
from linkax.studies.fingerprint import fingerprint
from linkax.studies.progress import path_parts

FORMAT = 2
LABELLED = ("", "member", "reason", "done")  # these say in their attributes which sweep they are of
LONGEST_NAME = 255  # bytes
NUMBERS = tuple("biufc")  # kinds of them that Zarr has


class SweepStore(NamedTuple):
    """A Zarr group: `member`, the members in the order of rows; `reason`; `output/…`, one array for each of the
    function's; `params/…`; and `done`, one number for each chunk, set once all of it is written: a checksum of it.

    Files can be damaged, and processes killed, or more than one at work. So what a sweep knows beforehand is written
    anew wherever it is not there as it should be; of the rest only chunks count that match their checksums.
    """

    path: Path
    sweep: str
    size: int
    done: zarr.Array
    arrays: tuple

    @staticmethod
    def folder(path) -> Path:
        """Where a store can be: a folder that may be written to, with nothing in it but perhaps a store."""
        path = Path(os.fspath(path))
        writable_folder(path, f"give another store than {str(path)!r}")
        if not _is_free(path) and not _identities(path):
            raise ValueError(f"store {str(path)!r} holds something else than a sweep; give another folder")
        return path

    @staticmethod
    def check(prefix, tree):
        """Whether each leaf of a tree can be an array on disk."""
        names = _names(prefix, tree)
        for name, (path, leaf) in zip(names, jax.tree.leaves_with_path(tree), strict=True):
            what = f"store: {prefix}{jax.tree_util.keystr(path)}"
            clashing = names.count(name) > 1 or any(other.startswith(name + "/") for other in names)
            if clashing or not all(map(_can_be_a_name, name.split("/"))):
                why = "another has that name" if clashing else "that is no name for an array"
                raise ValueError(f"{what} cannot be kept as {name!r}: {why}; use another key, or no store")
            if getattr(leaf.dtype, "kind", None) not in NUMBERS:
                raise ValueError(f"{what} has type {leaf.dtype}, unknown to Zarr; use float32 or int32, or no store")

    @staticmethod
    def opened(path, program, params, order, not_run) -> "SweepStore":
        """A new store, whose reasons are all `not_run`, or the one that is there.

        **Raises:** `ValueError` where it holds another sweep.
        """
        sweep = fingerprint(program.text, [*jax.tree.leaves(params), order])
        identity = dict(format=FORMAT, members=len(order), chunk=program.size, sweep=sweep)
        files = _known_files(identity, program, params, order, not_run)
        _claim(path, identity, files["zarr.json"])
        _mend(path, files)
        # A chunk that is not there is then none that is empty.
        with zarr.config.set({"array.write_empty_chunks": True}):
            group = zarr.open_group(path, mode="r+", use_consolidated=False)
            arrays = tuple(group[name] for name in ["reason", *_names("output", program.outputs[0])])
            done = group["done"]
            assert isinstance(done, zarr.Array)
            return SweepStore(path, sweep, program.size, done, arrays)

    def load(self, found) -> set:
        """Read what is there into (outputs, reasons); returns where the chunks begin that are done.

        **Warns:** of chunks that are damaged.
        """
        outputs, reasons = found
        whole, done, damaged = [reasons, *jax.tree.leaves(outputs)], set(), 0
        for start in range(0, len(reasons), self.size):
            part = slice(start, min(start + self.size, len(reasons)))
            try:
                pieces = self._read(start, part)
            except Exception:  # whatever a damaged file leads to
                damaged += part.stop - part.start
                continue
            if pieces is not None:
                done.add(start)
                for array, piece in zip(whole, pieces, strict=True):
                    array[part] = piece
        if damaged:
            told = f"{damaged} members are damaged, and are computed again"
            warnings.warn(f"store {str(self.path)!r}: {told}", stacklevel=4)
        return done

    def _read(self, start, part):
        """A chunk's arrays, or None where it is not done."""
        checksum = self.done[start // self.size]
        if checksum == 0:
            return None
        pieces = [array[part] for array in self.arrays]
        if checksum != self._checksum(start, pieces):
            raise ValueError("these are not the numbers that were written")
        return pieces

    def save(self, start, part, computed):
        """Write a chunk, and then that it is done."""
        outputs, reasons = computed
        pieces = [reasons, *jax.tree.leaves(outputs)]
        for array, piece in zip(self.arrays, pieces, strict=True):
            self._write(array, start, part, piece)
        self._write(self.done, start, start // self.size, self._checksum(start, pieces))

    def _write(self, array, start, part, piece):
        array[part] = piece
        if np.size(piece):
            chunk = (start // self.size, *[0] * (array.ndim - 1))
            synced(self.path / array.path / array.metadata.encode_chunk_key(chunk))

    def _checksum(self, start, pieces):
        """Never zero, in practice: of a chunk's sweep, place and numbers."""
        return np.uint64(int(fingerprint(f"{self.sweep} {start}", pieces)[:16], 16))


def _is_free(path) -> bool:
    """Hidden files, such as those that are being written, do not count."""
    return all(entry.name.startswith(".") for entry in path.iterdir())


def _identities(path) -> list[dict]:
    """Of which sweep the files of a store say that they are, as far as they can be read."""
    found = []
    for name in LABELLED:
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            attributes = json.loads((path / name / "zarr.json").read_bytes())["attributes"]
            found += [attributes] if attributes["sweep"] else []
    return found


def _claim(path, identity, content):
    """Make a folder that is free the store of a sweep; of processes that start at once, one does.

    **Raises:** `ValueError` where it is that of another.
    """
    if _is_free(path):
        with contextlib.suppress(FileExistsError), written_whole(path / "zarr.json", exclusive=True) as file:
            file.write_bytes(content)
    found = [{name: label.get(name) for name in identity} for label in _identities(path)] or [{}]
    if identity not in found:
        differs = ", ".join(name for name in identity if found[0].get(name) != identity[name])
        raise ValueError(
            f"store {str(path)!r} holds another sweep: its {differs} differ (function, numbers in it, parameters, "
            "chunk or versions have changed); give another folder, or remove this one"
        )


def _known_files(identity, program, params, order, not_run) -> dict[str, bytes]:
    """All that is in a store before a chunk is done, by where it is."""
    outputs, reason = program.outputs
    count, chunks = len(order), -(-len(order) // program.size)
    kept = {}
    group = zarr.create_group(MemoryStore(kept), attributes=identity)

    def add(name, dtype, fill_value, shape=(count,), size=program.size):
        labels = identity if name in LABELLED else {}
        sizes = (size, *(max(1, length) for length in shape[1:]))
        return group.create_array(
            name, shape=shape, chunks=sizes, dtype=dtype, fill_value=fill_value, attributes=labels
        )

    add("reason", reason.dtype, not_run)
    for name, info in zip(_names("output", outputs), jax.tree.leaves(outputs), strict=True):
        add(name, info.dtype, np.nan if np.issubdtype(info.dtype, np.inexact) else 0, (count, *info.shape[1:]))
    add("done", np.uint64, 0, (chunks,), 1)
    given = dict(zip(_names("params", params), jax.tree.leaves(params), strict=True)) | {"member": order}
    for name, array in given.items():
        add(name, array.dtype, 0, array.shape, count)[...] = np.asarray(array)
    return {key: value.to_bytes() for key, value in kept.items()}


def _mend(path, files):
    """Write what is not there, and what is there but not as it should be.

    **Warns:** of the latter.
    """
    damaged = []
    for name, content in files.items():
        file = path / name
        if file.is_file():
            found = file.read_bytes()
            if found == content or (file.name == "zarr.json" and _says(found, content)):
                continue
            damaged.append(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(file) as unfinished:
            unfinished.write_bytes(content)
    if damaged:
        warnings.warn(f"store {str(path)!r}: not as written, and restored: {', '.join(damaged)}", stacklevel=4)


def _says(found, content) -> bool:
    """Whether a document of JSON has all that another has; others may have added to it."""
    try:
        return _holds(json.loads(found), json.loads(content))
    except ValueError:
        return False


def _holds(found, wanted) -> bool:
    if isinstance(found, dict) and isinstance(wanted, dict):
        return all(key in found and _holds(found[key], wanted[key]) for key in wanted)
    return found == wanted


def _can_be_a_name(part) -> bool:
    """Of a folder, and of an array of Zarr."""
    reserved = part in ("", ".", "..", "zarr.json") or part.startswith("__") or "\\" in part
    return part.isprintable() and not reserved and len(part.encode()) <= LONGEST_NAME


def _names(prefix, tree: Any) -> list[str]:
    """Paths of a tree's leaves as names of arrays."""
    paths = [path for path, _ in jax.tree.leaves_with_path(tree)]
    return ["/".join([prefix, *path_parts(path)]) if path else f"{prefix}/value" for path in paths]
