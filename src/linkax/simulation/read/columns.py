"""A motion as a table of named columns: in memory, and in files that other tools read."""

import importlib
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from linkax.files import UNFINISHED, written_whole
from linkax.optional import needed
from linkax.simulation.read.kinematics import Kinematics

AXES = ("x", "y", "z")
QUATERNION = ("w", "x", "y", "z")
SUFFIXES = (".csv", ".parquet", ".zarr")
PARQUET = "a file of Parquet needs pyarrow"


def columns(solution: Kinematics) -> dict[str, tuple[np.ndarray, str]]:
    """The columns of a motion by name, each with its unit: see `Solution.to_dataframe`.

    **Raises:** `ValueError` for a batch, and for a motion of which nothing was saved.
    """
    ts: Any = solution.ts
    if solution.q is None:
        raise ValueError("the solution has what a function of saveat saved, and no coordinates; save without fn")
    if np.ndim(ts) != 1:
        member = "jax.tree.map(lambda x: x[0], solution)"
        raise ValueError(f"a batch of shape {np.shape(ts)[:-1]} is no table; take a member, such as {member}")
    reached = np.isfinite(np.asarray(ts))
    topology = solution.mechanism.topology
    found = {"time": (np.asarray(ts)[reached], "s")}
    for name, kind in zip(topology.coordinates, topology.joint_types, strict=False):
        units = kind.speed_units
        parts = [(str(index), unit) for index, unit in enumerate(units)]
        of_turn = [(letter, "") for letter in QUATERNION] if kind.has_quaternion else parts[:3]
        read = (
            (f"joint.{name}", solution.joint, [*of_turn, *parts[3:]], ""),
            (f"speed.{name}", solution.joint_speed, parts, "/s"),
        )
        for label, of, entries, rate in read if units else ():
            values = np.asarray(of(name))[reached].reshape(int(reached.sum()), -1)
            for column, (entry, unit) in zip(values.T, entries, strict=True):
                found[label if len(entries) == 1 else f"{label}.{entry}"] = column, unit + rate
    for name in topology.bodies:
        place = np.asarray(solution.position(name))[reached]
        found |= {f"position.{name}.{axis}": (place[:, index], "m") for index, axis in enumerate(AXES)}
    return found


def to_dataframe(solution: Kinematics) -> Any:
    """The columns as a pandas.DataFrame, with their units in `attrs`."""
    found = columns(solution)
    pandas: Any = needed("pandas", "a DataFrame needs pandas", "records")
    frame = pandas.DataFrame({name: values for name, (values, _) in found.items()})
    frame.attrs["units"] = {name: unit for name, (_, unit) in found.items()}
    return frame


def save(solution: Kinematics, path: str | os.PathLike[str]) -> None:
    """Write the columns to a file whose suffix says how."""
    path, found = Path(path), columns(solution)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{str(path)!r} has suffix {path.suffix!r}; known: {', '.join(SUFFIXES)}")
    if path.suffix == ".zarr":
        _zarr(path, found)
        return
    with written_whole(path) as unfinished:
        (_csv if path.suffix == ".csv" else _parquet)(unfinished, found)


def _csv(path, found):
    rows = np.stack([values for values, _ in found.values()], axis=1)
    header = ",".join(map(_quoted, found))
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=header, comments="", encoding="utf-8")


def _quoted(name):
    return '"' + name.replace('"', '""') + '"' if any(letter in name for letter in ',"\n') else name


def _parquet(path, found):
    arrow, parquet = (needed(module, PARQUET, "records") for module in ("pyarrow", "pyarrow.parquet"))
    fields = [arrow.field(name, arrow.float64(), metadata={"unit": unit}) for name, (_, unit) in found.items()]
    arrays = [arrow.array(np.asarray(values, dtype=float)) for values, _ in found.values()]
    parquet.write_table(arrow.Table.from_arrays(arrays, schema=arrow.schema(fields)), path)


def _zarr(path, found):
    """A group with an array for each column, which appears at once, in place of another group."""
    zarr: Any = importlib.import_module("zarr")
    if path.exists() and not (path / "zarr.json").is_file():
        raise ValueError(f"{str(path)!r} is there, and no store of Zarr; give another path")
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=UNFINISHED) as folder:
        unfinished = Path(folder) / path.name
        group = zarr.open_group(unfinished, mode="w")
        for name, (values, unit) in found.items():
            array = group.create_array(name, data=np.asarray(values, dtype=float))
            array.attrs["unit"] = unit
        if path.exists():
            path.rename(Path(folder) / "before")
        unfinished.rename(path)
