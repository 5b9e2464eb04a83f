"""Records of measurements, each channel with times of its own."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from linkax.model.names import ByName
from linkax.model.numbers import number_in, one_of, positive, real, require_type
from linkax.optional import needed
from linkax.simulation.read.columns import PARQUET
from linkax.tables import Rows, Table, count, numbers, printed_as
from linkax.xla.arrays import Array

REACH = 10  # of the filter to either side, in samples that are kept
EVEN = 1e-3  # of the mean time between samples: how far equal ones may differ


class Channel(NamedTuple):
    """What one instrument told.

    - `ts`: times of the samples, rising, (n,) [s].
    - `values`: (n,) or (n, k); NaN where a sample is missing.
    """

    ts: Float[Array, "..."]
    values: Float[Array, "..."]


def _table(record: "Record") -> Table:
    rows = []
    for name, (ts, values) in record.channels.items():
        missing = int(np.sum(np.isnan(np.asarray(values))))
        rows.append((name, count(ts.shape[-1], "sample"), f"{numbers(ts, 's')}", str(missing or "")))
    return Table("Record", [Rows(("channel", "samples", "times", "missing"), rows, "channels")])


@printed_as(_table)
class Record(eqx.Module):
    """What instruments told, by channels with times of their own.

    **Arguments:** `channels`: {name: (ts, values)}: times (n,) [s], and values (n,) or (n, k), where NaN is a missing
    sample. `record["name"]` is a channel as `ts` and `values`.

    **Raises:** `ValueError` for times that are not finite or do not rise, values of other shapes or infinite, and a
    channel without a sample.
    """

    channels: dict[str, Channel]

    def __init__(self, channels: Mapping[str, tuple[ArrayLike | Sequence, ArrayLike | Sequence] | Channel]) -> None:
        require_type(channels, Mapping, "channels of a record", "give {name: (times, values)}")
        if not channels:
            raise ValueError("a record has no channels; give {name: (times, values)}")
        self.channels = ByName({name: _channel(name, entry) for name, entry in channels.items()}, "channel")

    def __getitem__(self, name: str) -> Channel:
        return self.channels[name]

    def between(self, start: float, end: float) -> "Record":
        """The samples from `start` to `end` [s].

        **Raises:** `ValueError` where a channel has none there.
        """

        def part(name, ts, values):
            inside = (ts >= start) & (ts <= end)
            if not np.any(inside):
                raise ValueError(
                    f"channel {name!r} has no sample from {start} s to {end} s; it has {ts[0]} to {ts[-1]}"
                )
            return Channel(ts[inside], values[inside])

        return Record({name: part(name, *channel) for name, channel in self.channels.items()})

    def resampled(self, spacing: float, by: Literal["mean", "filter"] = "mean") -> "Record":
        """Fewer samples, `spacing` [s] apart, without what is too fast for them.

        - "mean": of the samples in each interval of that length, at the mean of their times; missing samples do not
          count, and an interval without samples gives none. Independent noise falls with the root of their number; a
          motion with acceleration a is off by up to a × spacing² / 24.
        - "filter": a low-pass filter of finite impulse response, without delay, then each k-th sample
          (`scipy.signal.decimate`). Needs equal times, a whole k, and no missing samples. The first ten and the last
          ten are left out, which it would mix with what was not recorded.

        Channels that are no faster than this stay as they are.

        **Raises:** `ValueError` where that cannot be done, naming the channel.
        """
        spacing = float(positive(spacing, "spacing [s]"))
        reduce = {"mean": _means, "filter": _filtered}[one_of(by, ("mean", "filter"), "by")]
        slow = lambda ts: len(ts) < 2 or np.min(np.diff(ts)) >= spacing * (1.0 - EVEN)
        return Record(
            {
                name: (ts, values) if slow(ts) else reduce(name, ts, values, spacing)
                for name, (ts, values) in self.channels.items()
            }
        )


def _channel(name, entry) -> Channel:
    what = f"channel {name!r}"
    if not isinstance(name, str) or not name:
        raise ValueError(f"a channel's name is {name!r}; give a text")
    if not isinstance(entry, tuple | list) or len(entry) != 2:
        raise ValueError(f"{what} is {entry!r}; give (times, values)")
    ts, values = (
        np.array(real(part, f"{what}: {part_of}")) for part, part_of in zip(entry, Channel._fields, strict=True)
    )
    if ts.ndim != 1 or values.ndim not in (1, 2) or len(values) != len(ts) or values.size == 0:
        raise ValueError(
            f"{what} has times of shape {ts.shape} and values of shape {values.shape}; give (n,), and (n,) or (n, k)"
        )
    if not np.all(np.isfinite(ts)):
        where = int(np.flatnonzero(~np.isfinite(ts))[0])
        raise ValueError(f"{what}: time of sample {where} is {ts[where]}; leave out samples without time")
    falls = np.flatnonzero(np.diff(ts) <= 0.0)
    if len(falls):
        where = int(falls[0]) + 1
        raise ValueError(
            f"{what}: time of sample {where} is {ts[where]} s, and that before {ts[where - 1]} s; sort the samples, "
            "and leave out those that come twice"
        )
    if np.any(np.isinf(values)):
        where = int(np.flatnonzero(np.isinf(values).reshape(len(values), -1).any(axis=1))[0])
        raise ValueError(f"{what}: sample {where} is infinite; give NaN where a sample is missing")
    empty = np.isnan(values).all(axis=0)
    if np.any(empty):
        of = f" of component {int(np.flatnonzero(empty)[0])}" if values.ndim == 2 else ""
        raise ValueError(f"{what}: all samples{of} are missing; leave it out")
    return Channel(ts, values)


def _means(name, ts, values, spacing):
    bins = np.floor((ts - ts[0]) / spacing * (1.0 + 1e-12)).astype(int)
    used, bins = np.unique(bins, return_inverse=True)
    columns = values.reshape(len(values), -1)
    there = ~np.isnan(columns)
    # A bin's time is that of its samples; where components miss different ones, that of all of its samples.
    seen = np.any(there, axis=1)
    sums = lambda weights: np.stack([np.bincount(bins, column, len(used)) for column in weights.T], axis=1)
    counts, seen_counts = sums(there.astype(float)), np.bincount(bins, seen.astype(float), len(used))
    left = seen_counts > 0.0
    with np.errstate(invalid="ignore"):
        means = sums(np.where(there, columns, 0.0)) / np.where(counts > 0.0, counts, np.nan)
    times = np.bincount(bins, np.where(seen, ts, 0.0), len(used))[left] / seen_counts[left]
    return times, means[left].reshape(-1, *values.shape[1:])


def _filtered(name, ts, values, spacing):
    from scipy.signal import decimate  # SciPy takes its time

    steps = np.diff(ts)
    mean = float(np.mean(steps))
    factor = round(spacing / mean)
    if np.max(np.abs(steps - mean)) > EVEN * mean:
        raise ValueError(
            f"channel {name!r} has unequal times, {steps.min():.6g} to {steps.max():.6g} s apart; by='mean'"
        )
    if abs(factor * mean - spacing) > EVEN * mean:
        raise ValueError(f"spacing is {spacing} s, channel {name!r} has samples {mean:.6g} s apart; give a multiple")
    if np.any(np.isnan(values)):
        raise ValueError(f"channel {name!r} has missing samples, which a filter cannot bridge; by='mean'")
    found = decimate(values, factor, ftype="fir", axis=0, zero_phase=True)
    if len(found) <= 2 * REACH:
        raise ValueError(
            f"channel {name!r} has {len(found)} samples at that spacing, and the filter needs {REACH} on either side "
            "of each; by='mean'"
        )
    return ts[::factor][REACH:-REACH], found[REACH:-REACH]


def read_record(
    path: str | os.PathLike,
    channels: Mapping[str, str | Sequence[str]],
    *,
    time: str | Mapping[str, str] = "time",
    unit: float = 1.0,
) -> Record:
    """Read a record from a file of columns: CSV with a line of names, or Parquet (`.parquet`), which needs pyarrow.

    Empty cells, "nan" and nulls are missing samples; a row in which all columns of a channel are empty is no sample of
    that channel, so that channels of different rates may share a file.

    **Arguments:**

    - `path`: of the file.
    - `channels`: {channel: column, or columns of its components}.
    - `time`: the column of times, or {channel: column}.
    - `unit`: of the times [s], such as 1e-3 for milliseconds.

    **Returns:** a `Record`.

    **Raises:** `ValueError` for a file that cannot be read, unknown columns, cells that are no numbers with their line,
    and as `Record` does; `ImportError` for Parquet without pyarrow.
    """
    path = Path(require_type(path, str | os.PathLike, "path", "give the name of a file"))
    require_type(channels, Mapping, "channels", "give {channel: column}")
    columns_of = {name: [given] if isinstance(given, str) else list(given) for name, given in channels.items()}
    time_of = {name: time if isinstance(time, str) else ByName(time, "channel")[name] for name in channels}
    asked = list(dict.fromkeys([*time_of.values(), *(column for each in columns_of.values() for column in each)]))
    read = _read_parquet if path.suffix.lower() in (".parquet", ".pq") else _read_csv
    try:
        columns = read(path, asked)
    except OSError as error:
        raise ValueError(f"cannot read {str(path)!r}: {error.strerror or error}") from error
    found = {}
    for name, each in columns_of.items():
        ts, values = columns[time_of[name]], np.stack([columns[column] for column in each], axis=1)
        empty = np.isnan(values).all(axis=1)
        if np.all(empty):
            raise ValueError(f"channel {name!r}: column {each[0]!r} of {str(path)!r} is empty; leave the channel out")
        values = values[:, 0] if isinstance(channels[name], str) else values
        found[name] = ts[~empty] * float(unit), values[~empty]
    return Record(found)


def _places(path, names: Iterable[str], asked) -> list[int]:
    """Where the columns are."""
    names = list(names)
    for name in asked:
        if names.count(name) != 1:
            some = ", ".join(map(repr, names[:20]))
            times = "is not a column" if name not in names else "is the name of several columns"
            raise ValueError(f"{name!r} {times} of {str(path)!r}; it has {some}")
    return [names.index(name) for name in asked]


def _read_csv(path, asked) -> dict[str, np.ndarray]:
    with open(path, newline="", encoding="utf-8-sig") as file:
        lines = csv.reader(file)
        head = [name.strip() for name in next(lines, [])]
        places, cells = _places(path, head, asked), []
        for row in lines:
            if not row:
                continue
            if len(row) != len(head):
                raise ValueError(
                    f"line {lines.line_num} of {str(path)!r} has {len(row)} cells, and {len(head)} columns have a name"
                )
            cells.append([_cell(row[place], path, lines.line_num, head[place]) for place in places])
    columns = np.array(cells, float).reshape(-1, len(asked)).T
    return dict(zip(asked, columns, strict=True))


def _cell(text, path, line, column) -> float:
    try:
        return number_in(text) if text.strip() else np.nan
    except ValueError:
        raise ValueError(
            f"line {line} of {str(path)!r}, column {column!r}: {text!r} is no number; leave the cell of a missing "
            "sample empty"
        ) from None


def _read_parquet(path, asked) -> dict[str, np.ndarray]:
    arrow, parquet = (needed(module, PARQUET, "records") for module in ("pyarrow", "pyarrow.parquet"))
    try:
        with parquet.ParquetFile(path) as file:
            _places(path, file.schema_arrow.names, asked)
            table = file.read(columns=asked)
    except arrow.ArrowInvalid as error:
        raise ValueError(f"{str(path)!r} is no file of Parquet: {error}") from error
    found = {}
    for name in asked:
        try:
            found[name] = table.column(name).cast("double").to_numpy()
        except (arrow.ArrowInvalid, arrow.ArrowNotImplementedError) as error:
            raise ValueError(
                f"column {name!r} of {str(path)!r} has no numbers, but {table.schema.field(name).type}"
            ) from error
    return found
