"""Keep the results of a sweep on disk, chunk by chunk."""

import contextlib
import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from linkax.files import synced, writable_folder, written_whole
from linkax.studies.parameters.fingerprint import fingerprint
from linkax.studies.parameters.paths import path_parts
from linkax.studies.sweeps.sweep_program import Plan
from linkax.xla.users_line import warn

FORMAT = 2
LABELLED = ("", "member", "reason", "done")  # arrays whose attributes name the sweep
LONGEST_NAME = 255  # bytes
NUMBERS = tuple("biufc")  # kinds of numbers that Zarr has


class SweepStore(NamedTuple):
    """A Zarr group with the results of a sweep.

    It holds `member`: the members in the order of rows; `reason`; `output/…`: one array for each of the function's;
    `params/…`; and `done`: a checksum of each chunk, written once all of the chunk is.

    Files can be damaged, and processes killed, or several at work. So all that a sweep knows beforehand is written
    again wherever it is missing or wrong, and only chunks that match their checksums count as done.

    - `sweep`: fingerprint of the program, the parameters and the order. `size`: members in a chunk.
    - `done`, `arrays`: the array of checksums; `reason` and the outputs.
    """

    path: Path
    sweep: str
    size: int
    done: Any
    arrays: tuple

    @staticmethod
    def folder(path: str | os.PathLike) -> Path:
        """Make or check the folder of a store.

        **Raises:** `ValueError` where it cannot be written to, or holds something else than a store.
        """
        path = Path(os.fspath(path))
        writable_folder(path, f"give another store than {str(path)!r}")
        if not _is_free(path) and not _identities(path):
            raise ValueError(f"store {str(path)!r} holds something else than a sweep; give another folder")
        return path

    @staticmethod
    def check(prefix: str, tree: Any) -> None:
        """Raise a ValueError where a leaf of a tree cannot be an array on disk."""
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
    def opened(path: Path, plan: Plan, params: Any, order: np.ndarray, not_run: int) -> "SweepStore":
        """Open the store in a folder, or make a new one, whose reasons are all `not_run`.

        **Raises:** `ValueError` where the folder holds another sweep.
        """
        import zarr  # which takes its time, here and below

        sweep = fingerprint(plan.fingerprint, [*jax.tree.leaves(params), order])
        identity = dict(format=FORMAT, members=len(order), chunk=plan.size, sweep=sweep)
        files = _known_files(identity, plan, params, order, not_run)
        _claim(path, identity, files["zarr.json"])
        _mend(path, files)
        # A chunk that is not there is then none that is empty.
        with zarr.config.set({"array.write_empty_chunks": True}):
            group = zarr.open_group(path, mode="r+", use_consolidated=False)
            arrays = tuple(group[name] for name in ["reason", *_names("output", plan.outputs)])
            done = group["done"]
            assert isinstance(done, zarr.Array)
            return SweepStore(path, sweep, plan.size, done, arrays)

    def load(self, whole: list[np.ndarray]) -> set[int]:
        """Read the chunks that are done into [reasons, *outputs], and return the row at which each begins.

        **Warns:** of damaged chunks.
        """
        done, damaged, count = set(), 0, len(whole[0])
        for start in range(0, count, self.size):
            part = slice(start, min(start + self.size, count))
            try:
                pieces = self._read(start, part)
            except Exception:  # a damaged file can raise anything
                damaged += part.stop - part.start
                continue
            if pieces is not None:
                done.add(start)
                for array, piece in zip(whole, pieces, strict=True):
                    array[part] = piece
        if damaged:
            told = f"{damaged} members are damaged, and are computed again"
            warn(f"store {str(self.path)!r}: {told}")
        return done

    def _read(self, start, part):
        """The arrays of a chunk, or None where it is not done.

        **Raises:** `ValueError` where they do not match their checksum.
        """
        checksum = self.done[start // self.size]
        if checksum == 0:
            return None
        pieces = [array[part] for array in self.arrays]
        if checksum != self._checksum(start, pieces):
            raise ValueError("these are not the numbers that were written")
        return pieces

    def save(self, start: int, part: slice, pieces: list[np.ndarray]) -> None:
        """Write the reasons and outputs of a chunk, and then its checksum."""
        for array, piece in zip(self.arrays, pieces, strict=True):
            self._write(array, start, part, piece)
        self._write(self.done, start, start // self.size, self._checksum(start, pieces))

    def _write(self, array, start, part, piece):
        array[part] = piece
        if np.size(piece):
            chunk = (start // self.size, *[0] * (array.ndim - 1))
            synced(self.path / array.path / array.metadata.encode_chunk_key(chunk))

    def _checksum(self, start, pieces):
        """A checksum of a chunk's sweep, place and numbers; in practice never zero."""
        return np.uint64(int(fingerprint(f"{self.sweep} {start}", pieces)[:16], 16))


def _is_free(path) -> bool:
    """Whether a folder holds nothing but hidden files, such as unfinished ones."""
    return all(entry.name.startswith(".") for entry in path.iterdir())


def _identities(path) -> list[dict]:
    """The identities of sweeps in the attributes of a store's files, as far as they can be read."""
    identities = []
    for name in LABELLED:
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            attributes = json.loads((path / name / "zarr.json").read_bytes())["attributes"]
            identities += [attributes] if attributes["sweep"] else []
    return identities


def _claim(path, identity, content):
    """Mark a free folder as the store of a sweep; of processes that start at once, one does.

    **Raises:** `ValueError` where it is the store of another sweep.
    """
    if _is_free(path):
        with contextlib.suppress(FileExistsError), written_whole(path / "zarr.json", exclusive=True) as file:
            file.write_bytes(content)
    present = [{name: label.get(name) for name in identity} for label in _identities(path)] or [{}]
    if identity not in present:
        differs = ", ".join(name for name in identity if present[0].get(name) != identity[name])
        raise ValueError(
            f"store {str(path)!r} holds another sweep: its {differs} differ (function, numbers in it, parameters, "
            "chunk or versions have changed); give another folder, or remove this one"
        )


def _known_files(identity, plan, params, order, not_run) -> dict[str, bytes]:
    """{path in the store: content} of all that a store holds before any chunk is done."""
    import zarr
    from zarr.storage import MemoryStore

    count, chunks = len(order), -(-len(order) // plan.size)
    kept = {}
    group = zarr.create_group(MemoryStore(kept), attributes=identity)

    def add(name, dtype, fill_value, shape=(count,), size=plan.size):
        labels = identity if name in LABELLED else {}
        sizes = (size, *(max(1, length) for length in shape[1:]))
        return group.create_array(
            name, shape=shape, chunks=sizes, dtype=dtype, fill_value=fill_value, attributes=labels
        )

    add("reason", np.int8, not_run)
    for name, info in zip(_names("output", plan.outputs), jax.tree.leaves(plan.outputs), strict=True):
        add(name, info.dtype, np.nan if np.issubdtype(info.dtype, np.inexact) else 0, (count, *info.shape))
    add("done", np.uint64, 0, (chunks,), 1)
    inputs = dict(zip(_names("params", params), jax.tree.leaves(params), strict=True)) | {"member": order}
    for name, array in inputs.items():
        add(name, array.dtype, 0, array.shape, count)[...] = np.asarray(array)
    return {key: value.to_bytes() for key, value in kept.items()}


def _mend(path, files):
    """Write files that are missing, or whose content is wrong.

    **Warns:** of wrong ones.
    """
    damaged = []
    for name, content in files.items():
        file = path / name
        if file.is_file():
            present = file.read_bytes()
            if present == content or (file.name == "zarr.json" and _says(present, content)):
                continue
            damaged.append(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(file) as unfinished:
            unfinished.write_bytes(content)
    if damaged:
        warn(f"store {str(path)!r}: not as written, and restored: {', '.join(damaged)}")


def _says(present, content) -> bool:
    """Whether a JSON document holds all entries of another, and perhaps more."""
    try:
        return _holds(json.loads(present), json.loads(content))
    except ValueError:
        return False


def _holds(present, wanted) -> bool:
    if isinstance(present, dict) and isinstance(wanted, dict):
        return all(key in present and _holds(present[key], wanted[key]) for key in wanted)
    return present == wanted


def _can_be_a_name(part) -> bool:
    """Whether a part of a path can be the name of a folder, and of a Zarr array."""
    reserved = part in ("", ".", "..", "zarr.json") or part.startswith("__") or "\\" in part
    return part.isprintable() and not reserved and len(part.encode()) <= LONGEST_NAME


def _names(prefix, tree: Any) -> list[str]:
    """Names of arrays for a tree's leaves, by their paths."""
    paths = [path for path, _ in jax.tree.leaves_with_path(tree)]
    return ["/".join([prefix, *path_parts(path)]) if path else f"{prefix}/value" for path in paths]
