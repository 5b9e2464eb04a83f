"""Evaluate one function for many sets of parameters."""

import concurrent.futures
import itertools
import numbers
import os
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import ArrayLike

from linkax.model.numbers import real, require_type, whole_number
from linkax.simulation.integrate.results import REMARKS, WARNINGS
from linkax.simulation.read.solution import Solution
from linkax.studies.parameters import as_arrays
from linkax.studies.sweep_program import SweepProgram, is_struct
from linkax.studies.sweep_result import FINE, NOT_RUN, Sweep
from linkax.studies.sweep_store import SweepStore
from linkax.xla.enumerations import code, is_item, item
from linkax.xla.users_line import warn
from linkax.xla.waiting import Progress, compiling

DEFAULT_CHUNK = 256  # members on one device; larger chunks take no less time for each member
DEFAULT_MEMORY = 2**31  # bytes


def sweep(
    function: Callable,
    params: Any,
    *,
    chunk: int | None = None,
    memory: int | float = DEFAULT_MEMORY,
    devices: Sequence[Any] | None = None,
    difficulty: Callable | ArrayLike | Sequence[float] | None = None,
    store: str | os.PathLike | None = None,
    progress: bool | None = None,
) -> Sweep:
    """Evaluate a function for each set of parameters of a batch: compiled once, in chunks, on all devices.

    Members are independent: one that fails is marked, and changes no other. Why a member failed is known where the
    function returns a `Solution`, or a `solution.result` beside its outputs; else outputs that are not finite count as
    a failure. Where it returns a `Solution`, or `solution.remark()`, the sweep also tells what a single run would warn
    of.

    **Arguments:**

    - `function`: params -> arrays in any pytree, `Solution` included. A pure function that JAX can trace.
    - `params`: pytree of arrays with one leading axis of members.
    - `chunk`: number of members that one device computes together; by default 256, or fewer where they need more than
      `memory`.
    - `memory`: of each device, for one chunk [bytes].
    - `devices`: by default all devices of this process. A CPU is one device, and computes one chunk on each of its
      cores. In a job of several processes (`jax.distributed`) each computes its share, and all return the whole.
    - `difficulty`: (n,) numbers, or a function of params that returns one, such as the steps of a run at
      `linkax.DRAFT`. Members of like difficulty share a chunk, since a chunk takes as long as its slowest member.
    - `store`: a folder, in which results are kept as they come, in Zarr format. A sweep that was killed goes on from
      there; damaged results are computed again; the store of another function or other parameters is refused.
      Processes that run the same sweep may share it.
    - `progress`: whether to show a progress bar; by default where the output is a terminal.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` for params without a common leading axis, for a store of another sweep, and for a folder
    in which no store can be.

    **Warns:** of damage in a store, and (`AccuracyWarning`, `StiffnessWarning`) of the number of members with each
    remark, see `Sweep.remarks`.
    """
    require_type(function, Callable, "function", "give a function of one set of parameters")
    params = as_arrays(params, "params")
    count = _members(params)
    devices = _checked_devices(devices)
    _check_sizes(chunk, memory)
    folder = None
    if store is not None:
        folder = SweepStore.folder(require_type(store, str | os.PathLike, "store", "give the name of a folder"))
        SweepStore.check("params", params)
    with Progress(count, "member", progress) as line:
        one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), params)
        with compiling():
            shape = eqx.filter_eval_shape(function, one)
        if folder is not None:
            SweepStore.check("output", eqx.filter(shape, is_struct))
        order = _order(difficulty, params, count, dict(chunk=chunk, memory=memory, devices=devices))
        with compiling():
            program = SweepProgram.compiled(function, one, shape, chunk or min(DEFAULT_CHUNK, count), memory, devices)
        kept = None if folder is None else SweepStore.opened(folder, program, params, order, NOT_RUN)
        results, seconds, ran = _run(program, params, order, kept, line)
    arrays, reasons = results if jax.process_count() == 1 else _gathered(results)
    back = np.argsort(order)
    output = eqx.combine(jax.tree.map(lambda array: array[back], arrays), program.static)
    remarks = _remarks(output, count)
    for name, category in WARNINGS.items():
        if number := np.sum(code(remarks) == code(getattr(REMARKS, name))):
            told = f"{number} of {count} members: {REMARKS[getattr(REMARKS, name)]} Sweep.remarked tells which."
            warn(told, category)
    return Sweep(output, reasons[back], seconds / ran if ran else float("nan"), remarks)


def _check_sizes(chunk, memory: int | float):
    """Raise a ValueError for a chunk or memory that is no positive number."""
    if chunk is not None:
        whole_number(chunk, "chunk")
    if isinstance(memory, bool) or not isinstance(memory, numbers.Real) or not memory > 0:
        raise ValueError(f"memory is {memory!r}; it must be a positive number of bytes")


def _remarks(output, count) -> REMARKS:
    """Of each member, the first remark in its output, or of a solution in it."""
    is_remark = lambda node: is_item(node, REMARKS)
    has_remark = lambda node: is_remark(node) or isinstance(node, Solution)
    nodes = [node for node in jax.tree.leaves(output, is_leaf=has_remark) if has_remark(node)]
    values = [code(node if is_remark(node) else node.remark()).reshape(count, -1) for node in nodes]
    values = np.concatenate([*values, np.zeros((count, 1), np.int32)], axis=1)
    return cast(REMARKS, item(values[np.arange(count), np.argmax(values != 0, axis=1)], REMARKS))


def _members(params) -> int:
    """The number of members of a batch."""
    sizes = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(params)}
    if len(sizes) != 1 or sizes == {()} or sizes == {(0,)}:
        shapes = {jax.tree_util.keystr(path): jnp.shape(leaf) for path, leaf in jax.tree.leaves_with_path(params)}
        raise ValueError(f"params have shapes {shapes}; give every array the same leading axis, one entry per member")
    return sizes.pop()[0]


def _checked_devices(devices) -> list:
    """The devices, by default all of this process."""
    if devices is None:
        return list(jax.local_devices())
    devices = list(devices) if isinstance(devices, Iterable) else [devices]
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise ValueError(f"devices are {devices!r}; give a list of jax.local_devices(), or None for all of them")
    if len(set(devices)) < len(devices):
        raise ValueError(f"devices are {devices!r}; give each of them once")
    return devices


def _order(difficulty, params, count, options):
    """The order in which members run: the difficult ones first."""
    if difficulty is None:
        return np.arange(count)
    if callable(difficulty):
        difficulty = sweep(difficulty, params, progress=False, **options).output
    difficulty = np.asarray(real(difficulty, "difficulty"))
    if difficulty.shape != (count,):
        raise ValueError(f"difficulty has shape {difficulty.shape}; give one number for each of {count} members")
    return np.argsort(-np.nan_to_num(difficulty, nan=np.inf), kind="stable")


def _run(program, params, order, kept, line):
    """(outputs, reasons) in the order of running, the time that it took [s], and the number of members that ran."""
    count = len(order)
    starts = range(0, count, program.size)
    own = starts[jax.process_index() :: jax.process_count()]
    results = jax.tree.map(lambda info: np.zeros((count, *info.shape[1:]), info.dtype), program.outputs)
    reasons = results[1]
    reasons[:] = NOT_RUN
    done = set() if kept is None else kept.load(results)
    params = jax.tree.map(np.asarray, params)

    def compute(start):
        members = order[np.minimum(np.arange(start, start + program.size), count - 1)]
        values = jax.tree.map(lambda leaf: leaf[members], params)
        return start, jax.tree.map(np.asarray, program.run(values))

    failed = int(np.sum(~np.isin(reasons, [*FINE, NOT_RUN])))
    finished = sum(min(program.size, count - start) for start in done)
    left = [start for start in own if start not in done]
    began, ran = time.perf_counter(), 0
    for start, computed in _in_parallel(compute, left, program.workers):
        part = slice(start, min(start + program.size, count))
        computed = jax.tree.map(lambda array, part=part: array[: part.stop - part.start], computed)
        for whole, piece in zip(jax.tree.leaves(results), jax.tree.leaves(computed), strict=True):
            whole[part] = piece
        if kept is not None:
            kept.save(start, part, computed)
        ran += part.stop - part.start
        failed += int(np.sum(~np.isin(reasons[part], FINE)))
        line.tell("sweeping", finished + ran, f", {failed} failed" if failed else "")
    elapsed = time.perf_counter() - began
    if kept is not None and jax.process_count() > 1:
        multihost_utils.sync_global_devices("sweep")
    return results, elapsed, ran


def _in_parallel(compute, items, workers):
    """Yield results of a number of threads as they come; at most one chunk waits for each thread."""
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        queue, running = iter(items), set()
        while True:
            running |= {pool.submit(compute, item) for item in itertools.islice(queue, 2 * workers - len(running))}
            if not running:
                return
            finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                yield future.result()


def _gathered(results):
    """Gather the results of all processes in each of them."""
    own = results[1] != NOT_RUN
    (arrays, reasons), owns = multihost_utils.process_allgather((results, own))
    whose = np.argmax(owns, axis=0)
    pick = lambda stacked: stacked[whose, np.arange(len(whose))]
    return jax.tree.map(pick, arrays), pick(reasons)
