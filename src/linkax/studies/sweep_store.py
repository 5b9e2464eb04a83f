"""Results of a sweep on disk, as they come."""

import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import zarr
from jax.experimental import multihost_utils

from linkax.studies.identity import fingerprint
from linkax.studies.showing import path_parts

FORMAT = 1


class SweepStore(NamedTuple):
    """A Zarr group: `member`, the members in the order of rows; `reason`; `output/…`, one array for each of the
    function's; `params/…`; and `done`, one number for each chunk, set once all of it is written.
    """

    group: zarr.Group
    arrays: tuple
    size: int

    @staticmethod
    def opened(path, program, params, order, not_run) -> "SweepStore":
        """A new store, whose reasons are all `not_run`, or the one that is there.

        **Raises:** `ValueError` where it holds another sweep, or something else.
        """
        path, count = Path(os.fspath(path)), len(order)
        sweep = fingerprint(program.text, [*jax.tree.leaves(params), order])
        identity = dict(format=FORMAT, members=count, chunk=program.size, sweep=sweep)
        first = jax.process_index() == 0
        outputs, reason = program.outputs
        names = ["reason", *_names("output", outputs)]
        infos = [reason, *jax.tree.leaves(outputs)]
        if first and not (path / "zarr.json").exists():
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise ValueError(f"store {str(path)!r} holds something else than a sweep; give another folder")
            # Aside, and then moved in one piece: a store that is there is whole.
            aside = path.with_name(f".unfinished-{path.name}")
            group = zarr.open_group(aside, mode="w")
            for name, info in zip(names, infos, strict=True):
                fill = not_run if name == "reason" else np.nan if np.issubdtype(info.dtype, np.inexact) else 0
                group.create_array(
                    name,
                    shape=(count, *info.shape[1:]),
                    chunks=(program.size, *info.shape[1:]),
                    dtype=info.dtype,
                    fill_value=fill,
                )
            for name, leaf in zip(_names("params", params), jax.tree.leaves(params), strict=True):
                group.create_array(name, data=np.asarray(leaf))
            group.create_array("member", data=order)
            chunks = -(-count // program.size)
            group.create_array("done", shape=(chunks,), chunks=(1,), dtype=np.int8, fill_value=0)
            group.attrs.update(identity)
            aside.replace(path)
        _wait()
        group = zarr.open_group(path, mode="r+")
        other = {name: group.attrs.get(name) for name in identity}
        if other != identity:
            differs = ", ".join(name for name in identity if other[name] != identity[name])
            raise ValueError(
                f"store {str(path)!r} holds another sweep: its {differs} differ (function, numbers in it, parameters, "
                "chunk or versions have changed); give another folder, or remove this one"
            )
        return SweepStore(group, tuple(group[name] for name in names), program.size)

    def load(self, found) -> set:
        """Read what is there into (outputs, reasons); returns where the chunks begin that are done."""
        outputs, reasons = found
        starts = self.size * np.flatnonzero(self.group["done"][:])
        for whole, array in zip([reasons, *jax.tree.leaves(outputs)], self.arrays, strict=True):
            for start in starts:
                part = slice(start, min(start + self.size, len(whole)))
                whole[part] = array[part]
        return {int(start) for start in starts}

    def save(self, start, part, computed):
        """Write a chunk, and then that it is done."""
        outputs, reasons = computed
        for array, piece in zip(self.arrays, [reasons, *jax.tree.leaves(outputs)], strict=True):
            array[part] = piece
        self.group["done"][start // self.size] = 1


def _names(prefix, tree: Any) -> list[str]:
    """Paths of a tree's leaves as names of arrays."""
    paths = [path for path, _ in jax.tree.leaves_with_path(tree)]
    return ["/".join([prefix, *path_parts(path)]) if path else f"{prefix}/value" for path in paths]


def _wait():
    """For the process that makes the store."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("sweep store")
