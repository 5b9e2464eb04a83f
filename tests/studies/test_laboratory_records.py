"""Records: read as written, refused where they make no sense, resampled as they say."""

import re
import sys

import numpy as np
import pytest

import linkax as lx

TEXT = """time,angle,x,y
0.0,1.0,0.1,0.2
0.1,,0.3,
0.2,2.0,,
0.3,nan,0.5,0.6
"""


def same(channel, ts, values):
    np.testing.assert_array_equal(channel.ts, ts)
    np.testing.assert_array_equal(channel.values, values)


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_files_with_channels_of_different_rates(tmp_path, kind):
    path = tmp_path / f"run.{kind}"
    if kind == "csv":
        path.write_text(TEXT)
    else:
        arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        columns = {"time": [0.0, 0.1, 0.2, 0.3], "angle": [1.0, None, 2.0, None]}
        columns |= {"x": [0.1, 0.3, None, 0.5], "y": [0.2, None, None, 0.6], "text": list("abcd")}
        parquet.write_table(arrow.table(columns), path)
        with pytest.raises(ValueError, match=r"column 'text' of .* has no numbers, but string"):
            lx.read_record(path, {"angle": "text"})
    record = lx.read_record(path, {"angle": "angle", "camera": ["x", "y"]})
    same(record["angle"], [0.0, 0.2], [1.0, 2.0])
    same(record["camera"], [0.0, 0.1, 0.3], [[0.1, 0.2], [0.3, np.nan], [0.5, 0.6]])
    late = lx.read_record(path, {"camera": ["y"]}, time={"camera": "time"}, unit=1e-3)
    same(late["camera"], [0.0, 0.3e-3], [[0.2], [0.6]])
    assert "camera   3 samples  0 to 0.3 s  1" in repr(record)


BAD_FILES = {
    "an underscore": ("time,angle\n0,1\n1,1_5\n", r"line 3 of .*, column 'angle': '1_5' is no number"),
    "other digits": ("time,angle\n0,1\n1,١\n", r"line 3 of .*, column 'angle': '١' is no number"),
    "a word": ("time,angle\n0,1\n1,one\n", r"line 3 of .*, column 'angle': 'one' is no number; leave the cell"),
    "no such column": ("time,angel\n0,1\n", "'angle' is not a column of .*; it has 'time', 'angel'"),
    "twice": ("time,angle,angle\n0,1,1\n", "'angle' is the name of several columns"),
    "a short line": ("time,angle\n0,1\n1\n", "line 3 of .* has 1 cells, and 2 columns have a name"),
    "nothing": ("", "'time' is not a column"),
    "only empty cells": ("time,angle\n0,\n1,\n", "channel 'angle': column 'angle' of .* is empty"),
    "no time": ("time,angle\n0,1\n,2\n", "channel 'angle': time of sample 1 is nan; leave out"),
    "time that stands": ("time,angle\n0,1\n0,2\n", "'angle': time of sample 1 is 0.0 s, and that before 0.0 s; sort"),
    "infinity": ("time,angle\n0,inf\n1,2\n", "channel 'angle': sample 0 is infinite; give NaN"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_named(tmp_path, case):
    text, told = BAD_FILES[case]
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=told):
        lx.read_record(path, {"angle": "angle"})


def test_files_that_are_none_are_named(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"cannot read '.*none\.csv': No such file"):
        lx.read_record(tmp_path / "none.csv", {"angle": "angle"})
    path = tmp_path / "run.parquet"
    path.write_text(TEXT)
    if pytest.importorskip("pyarrow"):
        with pytest.raises(ValueError, match=r"is no file of Parquet"):
            lx.read_record(path, {"angle": "angle"})
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ImportError, match=re.escape("pip install 'linkax[records]'")):
        lx.read_record(path, {"angle": "angle"})


BAD_RECORDS = {
    "no channels": ({}, "has no channels"),
    "a name": ({"": ([0.0], [1.0])}, "a channel's name is ''"),
    "values alone": ({"a": [1.0, 2.0, 3.0]}, r"channel 'a' is \[1\.0, 2\.0, 3\.0\]; give \(times, values\)"),
    "lengths": ({"a": ([0.0, 1.0], [1.0])}, r"times of shape \(2,\) and values of shape \(1,\)"),
    "a text": ({"a": ([0.0, 1.0], ["x", "y"])}, "channel 'a': values is"),
    "all missing": ({"a": ([0.0, 1.0], [[1.0, np.nan], [2.0, np.nan]])}, "'a': all samples of component 1 are"),
}


@pytest.mark.parametrize("case", BAD_RECORDS)
def test_bad_records_are_named(case):
    channels, told = BAD_RECORDS[case]
    with pytest.raises(ValueError, match=told):
        lx.Record(channels)


def test_means_of_intervals():
    """Of a line at the mean of times; with missing samples left out, and noise less by the root of their number."""
    ts = np.sort(np.random.default_rng(0).uniform(0.0, 10.0, 5000))
    values = np.stack([2.0 * ts + 1.0, np.random.default_rng(1).normal(size=5000)], axis=1)
    values[::7] = np.nan
    found = lx.Record({"a": (ts, values), "slow": ([0.0, 1.0], [1.0, 2.0])}).resampled(0.5)
    assert len(found["a"].ts) == 20
    np.testing.assert_allclose(found["a"].values[:, 0], 2.0 * found["a"].ts + 1.0, rtol=1e-12)
    assert 0.03 < np.std(found["a"].values[:, 1]) < 0.11  # 1 / sqrt(214) = 0.07
    same(found["slow"], [0.0, 1.0], [1.0, 2.0])
    gap = lx.Record({"a": ([0.0, 0.1, 0.9, 1.0, 1.1], [1.0, 3.0, np.nan, 5.0, np.nan])}).resampled(0.5)
    same(gap["a"], [0.05, 1.0], [2.0, 5.0])


def test_a_filter_takes_out_what_is_too_fast():
    ts = np.linspace(0.0, 10.0, 1001)
    slow, fast = np.sin(2.0 * np.pi * 0.5 * ts), np.sin(2.0 * np.pi * 23.0 * ts)
    found = lx.Record({"a": (ts, slow + fast)}).resampled(0.1, by="filter")["a"]
    np.testing.assert_allclose(found.ts, ts[100:-100:10])
    np.testing.assert_allclose(found.values, slow[100:-100:10], atol=2e-2)
    level = lx.Record({"a": (ts, 1.0 + 0.1 * ts)}).resampled(0.1, by="filter")["a"]
    np.testing.assert_allclose(level.values, 1.0 + 0.1 * level.ts, rtol=1e-9)
    with pytest.raises(ValueError, match="has 20 samples at that spacing"):
        lx.Record({"a": (ts[:200], slow[:200])}).resampled(0.1, by="filter")
    aliased = (slow + fast)[::10]
    assert np.max(np.abs(aliased - slow[::10])) > 0.9
    for channel, told in (
        ((ts[:-1] + 0.003 * (np.arange(1000) % 2), slow[:-1]), "unequal times"),
        ((ts, np.where(ts == 5.0, np.nan, slow)), "missing samples"),
    ):
        with pytest.raises(ValueError, match=told):
            lx.Record({"a": channel}).resampled(0.1, by="filter")
    with pytest.raises(ValueError, match=r"samples 0\.01 s apart; give a multiple"):
        lx.Record({"a": (ts, slow)}).resampled(0.025, by="filter")
    with pytest.raises(ValueError, match="by is 'spline'; known: 'mean', 'filter'"):
        lx.Record({"a": (ts, slow)}).resampled(0.1, by="spline")


def test_part_of_a_record():
    record = lx.Record({"a": ([0.0, 1.0, 2.0], [1.0, 2.0, 3.0])})
    same(record.between(0.5, 2.0)["a"], [1.0, 2.0], [2.0, 3.0])
    with pytest.raises(ValueError, match=r"channel 'a' has no sample from 3\.0 s to 4\.0 s; it has 0\.0 to 2\.0"):
        record.between(3.0, 4.0)
    with pytest.raises(KeyError, match="unknown channel 'b'; known: 'a'"):
        record["b"]
