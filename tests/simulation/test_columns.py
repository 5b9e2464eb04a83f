"""A motion in tables and files that other tools read."""

import csv
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from pyarrow import parquet

import linkax as lx


@pytest.fixture(scope="module")
def solution():
    """A ball on a cart, of which nothing is at rest."""
    cart, ball = lx.box("cart, of two", [0.2, 0.1, 0.1], 1.0), lx.rod("ball", 0.5, 1.0, thickness=0.1)
    joints = [lx.Prismatic("guide", lx.GROUND, cart, axis="x"), lx.Spherical("socket", cart, ball.at("base"))]
    mechanism = lx.Mechanism([cart, ball], joints, [lx.Gravity([0.0, 0.0, -9.81])])
    state = lx.State(jnp.array([0.1, 1.0, 0.0, 0.0, 0.0]), jnp.array([0.3, 1.0, 0.2, -0.4]), mechanism.topology)
    return lx.simulate(mechanism, state, t1=0.2, saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 0.2, 5)))


NAMES = [
    "time", "joint.guide", "speed.guide", "joint.socket.w", "joint.socket.x", "joint.socket.y", "joint.socket.z",
    "speed.socket.0", "speed.socket.1", "speed.socket.2",
    *(f"position.{body}.{axis}" for body in ("cart, of two", "ball") for axis in "xyz"),
]  # fmt: skip


def expected(solution, name):
    kind, _, rest = name.partition(".")
    if kind == "time":
        return solution.ts
    if kind == "position":
        body, _, axis = rest.rpartition(".")
        return solution.position(body)[:, "xyz".index(axis)]
    read = solution.joint if kind == "joint" else solution.joint_speed
    joint, _, entry = rest.partition(".")
    values = np.asarray(read(joint)).reshape(5, -1)
    return values[:, 0 if not entry else "wxyz".index(entry) if entry in "wxyz" else int(entry)]


def check(solution, names, column):
    assert list(names) == NAMES
    for name in NAMES:
        assert np.array_equal(column(name), np.asarray(expected(solution, name)))


def test_a_file_of_csv_has_every_digit(solution, tmp_path):
    solution.save(tmp_path / "run.csv")
    with open(tmp_path / "run.csv", newline="") as file:
        names, *rows = csv.reader(file)
    found = np.array(rows, dtype=float)
    check(solution, names, lambda name: found[:, names.index(name)])
    record = lx.read_record(tmp_path / "run.csv", {"slide": "joint.guide"})
    assert np.array_equal(record["slide"].values, solution.joint("guide"))


def test_a_file_of_parquet_has_units(solution, tmp_path):
    solution.save(tmp_path / "run.parquet")
    table = parquet.read_table(tmp_path / "run.parquet")
    check(solution, table.column_names, lambda name: table.column(name).to_numpy())
    assert table.schema.field("speed.guide").metadata == {b"unit": b"m/s"}


def test_a_store_of_zarr_replaces_another(solution, tmp_path):
    for _ in range(2):
        solution.save(tmp_path / "run.zarr")
    group = zarr.open_group(tmp_path / "run.zarr", mode="r")
    assert sorted(group) == sorted(NAMES)
    assert np.array_equal(group["speed.socket.1"][:], solution.joint_speed("socket")[:, 1])
    assert group["joint.guide"].attrs["unit"] == "m"
    (tmp_path / "notes.zarr").mkdir()
    with pytest.raises(ValueError, match="no store of Zarr; give another path"):
        solution.save(tmp_path / "notes.zarr")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.zarr", "run.zarr"]


def test_a_dataframe_needs_pandas(solution, monkeypatch):
    frame = solution.to_dataframe()
    check(solution, frame.columns, lambda name: frame[name].to_numpy())
    assert frame.attrs["units"]["speed.socket.0"] == "rad/s"
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"needs pandas; pip install 'linkax\[records\]'"):
        solution.to_dataframe()


def test_what_is_no_table_is_refused(solution, tmp_path):
    with pytest.raises(ValueError, match=r"suffix '.xlsx'; known: .csv, .parquet, .zarr"):
        solution.save(tmp_path / "run.xlsx")
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]) if is_array(leaf) else leaf, solution)
    with pytest.raises(ValueError, match=r"a batch of shape \(2,\) is no table"):
        batch.save(tmp_path / "run.csv")


def is_array(leaf):
    return isinstance(leaf, jax.Array | np.ndarray)
