"""Stores of sweeps: whatever happens to their files, and however many processes use one, no number is wrong."""

import concurrent.futures
import itertools
import json
import multiprocessing
import os
import shutil
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

import linkax as lx
from linkax.studies.sweeps.sweep_program import SweepProgram
from linkax.studies.sweeps.sweep_store import LABELLED, SweepStore

MEMBERS, CHUNK = 10, 4  # the last chunk has two
PARAMS = {"a": np.linspace(0.1, 1.0, MEMBERS)}
COMPILE, OPEN = SweepProgram.compiled, SweepStore.opened


def waves(params):
    """In the second chunk numbers like those of files that are not there."""
    a = params["a"]
    empty = jnp.abs(a - 0.65) < 0.2
    return {"x": jnp.where(empty, jnp.nan, jnp.sin(a)), "steps": jnp.where(empty, 0, jnp.floor(100.0 * a).astype(int))}


class Kept(NamedTuple):
    """What a sweep found, the chunks that it ran, and its warnings."""

    found: lx.Sweep
    ran: set
    told: list


@pytest.fixture(scope="module")
def run():
    """A sweep of `waves` with a store; all of them share one program."""
    programs, ran = [], set()

    def compiled(function, *arguments):
        if function is not waves:
            return COMPILE(function, *arguments)
        if not programs:
            program = COMPILE(function, *arguments)
            noted = lambda values: ran.add(int(np.flatnonzero(values["a"][0] == PARAMS["a"])[0]) // CHUNK)
            programs.append(program._replace(run=lambda values: noted(values) or program.run(values)))
        return programs[0]

    def run(store):
        ran.clear()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = lx.sweep(waves, PARAMS, chunk=CHUNK, store=store, progress=False)
        return Kept(found, set(ran), [str(warning.message) for warning in told])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SweepProgram, "compiled", compiled)
        yield run


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """A store, and what a sweep found that wrote it."""
    store = tmp_path_factory.mktemp("whole") / "store"
    return store, run(store).found


def same(found, right):
    jax.tree.map(np.testing.assert_array_equal, found.output, right.output)
    np.testing.assert_array_equal(found.reasons, right.reasons)


def files(store):
    return {str(path.relative_to(store)): path for path in sorted(store.rglob("*")) if path.is_file()}


def contents(store):
    read = lambda path: json.loads(path.read_bytes()) if path.name == "zarr.json" else path.read_bytes()
    return {name: read(path) for name, path in files(store).items()}


def chunk_of(name):
    """The chunk that a file holds a part of, None for what is known without."""
    array, _, place = name.partition("/c/")
    return int(place.split("/")[0]) if place and array.startswith(("done", "output", "reason")) else None


def damages(content, random):
    """Ways in which a file can end: not there, cut short, or with a byte that is another."""
    yield None
    for length in (0, len(content) - 1, int(random.integers(1, len(content) - 1))):
        yield content[:length]
    for place in random.integers(len(content), size=10):
        yield content[:place] + bytes([content[place] ^ int(random.integers(1, 256))]) + content[place + 1 :]


def test_damaged_files(run, whole, tmp_path):
    """Only chunks with a file that is damaged are run again, and told; after that the store is as it was.

    Each way in each file; at once in at most one file of each chunk, and in one of those that are none of a chunk.
    """
    shutil.copytree(whole[0], tmp_path / "store")
    here, random, cases = files(tmp_path / "store"), np.random.default_rng(0), {0: [], 1: [], 2: [], None: []}
    raw, intact = {name: file.read_bytes() for name, file in here.items()}, contents(tmp_path / "store")
    for name, content in raw.items():
        cases[chunk_of(name)] += [(name, damaged) for damaged in damages(content, random)]
    assert sum(map(len, cases.values())) > 300
    for together in itertools.zip_longest(*cases.values()):
        case = dict(filter(None, together))
        for name, damaged in case.items():
            here[name].write_bytes(damaged or b"")
            if damaged is None:
                here[name].unlink()
        found, ran, told = run(tmp_path / "store")
        same(found, whole[1])
        assert ran <= {chunk_of(name) for name in case}, case
        # A chunk is not done where no file says so.
        lost = ran - {chunk_of(name) for name, damaged in case.items() if damaged is None and name.startswith("done")}
        members = sum(min(CHUNK, MEMBERS - CHUNK * chunk) for chunk in lost)
        told = [message for message in told if "are damaged" in message]
        assert all(f"{members} members" in message for message in told), (case, told)
        assert len(told) == bool(lost), (case, told)
        # What reads as before may stay as it is.
        spared = {name: intact[name] for name in case if chunk_of(name) not in (None, *ran)}
        assert contents(tmp_path / "store") | spared == intact, case
        for name in spared:
            here[name].write_bytes(raw[name])


def test_no_more_than_hidden_files_and_the_first(run, whole, tmp_path):
    """As a process leaves it that is killed while it makes a store."""
    store, right = whole
    (tmp_path / ".unfinished-1-zarr.json").write_text("{")
    for left in ([], ["zarr.json"], ["zarr.json", "output/zarr.json", "done/zarr.json"]):
        for name in left:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            shutil.copy(store / name, tmp_path / name)
        found, ran, told = run(tmp_path)
        same(found, right)
        assert ran == {0, 1, 2}
        assert not told
        for entry in set(tmp_path.iterdir()) - {tmp_path / ".unfinished-1-zarr.json"}:
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def test_what_others_add_stays(run, whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "store")
    file = tmp_path / "store" / "output" / "x" / "zarr.json"
    noted = json.loads(file.read_bytes()) | {"attributes": {"unit": "m"}}
    file.write_text(json.dumps(noted))
    found, ran, told = run(tmp_path / "store")
    same(found, whole[1])
    assert not ran
    assert not told
    assert json.loads(file.read_bytes()) == noted


def test_folders_beside_a_store_stay(run, tmp_path):
    mine = tmp_path / ".unfinished-store" / "mine.txt"
    mine.parent.mkdir()
    mine.write_text("kept")
    run(tmp_path / "store")
    assert mine.read_text() == "kept"


def test_stores_that_tell_nothing_or_something_else(run, whole, tmp_path):
    """None of them is changed."""
    for name, change in (
        ("something else", None),
        ("its format differ", lambda label: label | {"format": 1}),
        ("its sweep differ", lambda label: label | {"sweep": "another"}),
    ):
        store = tmp_path / name
        shutil.copytree(whole[0], store)
        for label in LABELLED:
            file = store / label / "zarr.json"
            known = json.loads(file.read_bytes())
            text = "<html>" if change is None else json.dumps(known | {"attributes": change(known["attributes"])})
            file.write_text(text)
        before = {name: path.read_bytes() for name, path in files(store).items()}
        refused(lambda store=store: run(store), "store", str(store), name)
        assert {name: path.read_bytes() for name, path in files(store).items()} == before


def test_all_is_on_disk_when_it_is_done(run, tmp_path, monkeypatch):
    synced, sync = set(), os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: synced.add(os.fstat(number).st_ino) or sync(number))
    run(tmp_path / "store")
    assert {path.stat().st_ino for path in files(tmp_path / "store").values()} <= synced


def never(*_):
    raise AssertionError("traced, or compiled")


def test_places_that_can_hold_no_store_are_named_before_anything_is_traced(tmp_path):
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine.txt").write_text("kept")
    bad = [tmp_path / "file", tmp_path / "file" / "below", tmp_path / "folder", tmp_path / (300 * "x"), "a\0b"]
    for store in [*bad, *(["/proc/store"] if Path("/proc").is_dir() else [])]:
        refused(lambda store=store: lx.sweep(never, PARAMS, store=store, progress=False), "store", repr(str(store)))
    assert (tmp_path / "file").read_text() == (tmp_path / "folder" / "mine.txt").read_text() == "kept"


NAMES = [
    [".."], ["../../evil"], ["."], [""], ["a/"], ["a//b"], ["a\\b"], ["zarr.json"], ["__a"], ["a\nb"], ["a\0b"],
    [300 * "x"], ["\ud800"], ["a", "a/b"], ["a", "a/b/c"], ["a/b", {"a": ["b"]}],
]  # fmt: skip


def tree(keys, leaf):
    """Of nested dictionaries."""
    branches = {name: tree(inner, leaf) for key in keys if isinstance(key, dict) for name, inner in key.items()}
    return {key: leaf for key in keys if isinstance(key, str)} | branches


@pytest.mark.parametrize("keys", NAMES, ids=ascii)
def test_names_that_can_be_no_arrays_are_named_before_anything_is_compiled(keys, tmp_path, monkeypatch):
    monkeypatch.setattr(SweepProgram, "compiled", never)
    (tmp_path / "a").mkdir()
    store = tmp_path / "a" / "store"
    outputs = lambda params: tree(keys, params["a"])
    refused(lambda: lx.sweep(outputs, PARAMS, store=store, difficulty=outputs, progress=False), "store", "output[")
    refused(lambda: lx.sweep(len, tree(keys, PARAMS["a"]), store=store, progress=False), "store", "params[")
    assert not files(tmp_path)


def test_types_unknown_to_zarr_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(SweepProgram, "compiled", never)
    for kind in (lambda a: a.astype(jnp.bfloat16), lambda a: jax.random.key(3)):
        refused(lambda kind=kind: lx.sweep(kind, PARAMS["a"], store=tmp_path, progress=False), "store", "output")


def test_all_kinds_of_numbers_come_back(tmp_path):
    def kinds(a):
        some = {"empty": jnp.zeros((0, 2)), "negative": jnp.full(2, -0.0), "spoilt": -jnp.nan * a, "yes": a > 0.5}
        return some | {"complex": jnp.nan * 1j * a, "half": a.astype(jnp.float16), "count": jnp.int8(3), "a/b": a}

    first, again = (lx.sweep(kinds, PARAMS["a"], chunk=CHUNK, store=tmp_path, progress=False) for _ in range(2))
    assert np.isnan(again.seconds_per_member)
    for one, other in zip(jax.tree.leaves(first.output), jax.tree.leaves(again.output), strict=True):
        assert one.dtype == other.dtype
        assert one.tobytes() == other.tobytes()


def begin(barrier):
    """Let the processes of a pool open each store in the same moment."""

    def opened(*arguments):
        barrier.wait(60.0)
        return OPEN(*arguments)

    warnings.simplefilter("error")
    SweepStore.opened = staticmethod(opened)


def race(stores, factor):
    """What a process finds that shares its stores with another; the error's text where it is refused."""
    found = []
    for store in stores:
        try:
            found.append(
                lx.sweep(lambda a: factor * jnp.sin(a), PARAMS["a"], chunk=1, store=store, progress=False).output
            )
        except ValueError as error:
            found.append(str(error))
    return found


@pytest.fixture(scope="module")
def both():
    """Runs `race` in two processes at once."""
    context = multiprocessing.get_context("spawn")
    barrier = (context.Barrier(2),)
    with concurrent.futures.ProcessPoolExecutor(2, context, initializer=begin, initargs=barrier) as pool:
        yield lambda stores, *factors: [task.result() for task in [pool.submit(race, stores, x) for x in factors]]


@pytest.mark.slow
def test_two_processes_that_share_stores(both, tmp_path):
    stores = [tmp_path / str(number) for number in range(20)]
    for found in both(stores, 1.0, 1.0):
        np.testing.assert_array_equal(found, len(stores) * [np.sin(PARAMS["a"])])
    for store in stores:
        again = lx.sweep(lambda a: 1.0 * jnp.sin(a), PARAMS["a"], chunk=1, store=store, progress=False)
        np.testing.assert_array_equal(again.output, np.sin(PARAMS["a"]))
        assert np.isnan(again.seconds_per_member)


@pytest.mark.slow
def test_two_sweeps_do_not_share_a_store(both, tmp_path):
    """Of those that start at once, one has it, and the other is refused."""
    stores = [tmp_path / str(number) for number in range(5)]
    for one, other in zip(*both(stores, 1.0, 2.0), strict=True):
        told, (found, factor) = (one, (other, 2.0)) if isinstance(one, str) else (other, (one, 1.0))
        assert "holds another sweep" in told
        np.testing.assert_array_equal(found, factor * np.sin(PARAMS["a"]))
