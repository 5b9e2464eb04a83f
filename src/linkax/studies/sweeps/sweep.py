"""Evaluate one function for many sets of parameters."""

import numbers
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
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
from linkax.studies.parameters.parameters import as_arrays
from linkax.studies.sweeps.sweep_program import Plan, SweepProgram, is_struct
from linkax.studies.sweeps.sweep_result import NOT_RUN, Sweep
from linkax.studies.sweeps.sweep_run import Threads, Workers, run_sweep
from linkax.studies.sweeps.sweep_store import SweepStore
from linkax.studies.sweeps.sweep_workers import Work, check_executor
from linkax.xla.enumerations import code, is_item, item
from linkax.xla.users_line import warn
from linkax.xla.waiting import Progress, compiling

DEFAULT_CHUNK = 256  # members on a CPU; larger chunks take no less time for each member
# Members on a graphics card: an H200 takes 0.7 s for 1000 crank-sliders, 1.4 for 10 000, 9.6 for 100 000.
CHUNK_OF_GRAPHICS_CARD = 16_384
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
    executor: Executor | Any = None,
) -> Sweep:
    """Evaluate a function for each set of parameters of a batch: compiled once, in chunks, on all devices or workers.

    Members are independent: one that fails is marked, and changes no other. Why a member failed is known where the
    function returns a `Solution`, or a `solution.result` beside its outputs; else outputs that are not finite count as
    a failure. Where it returns a `Solution`, or `solution.remark()`, the sweep also tells what a single run would warn
    of.

    **Arguments:**

    - `function`: params -> arrays in any pytree, `Solution` included. A pure function that JAX can trace.
    - `params`: pytree of arrays with one leading axis of members.
    - `chunk`: number of members that one device computes together; by default 256 on a CPU and by an executor, 16 384
      on other devices, or fewer where they need more than `memory`.
    - `memory`: of each device, for one chunk [bytes].
    - `devices`: by default all devices of this process. A CPU is one device, and computes one chunk on each of its
      cores. In a job of several processes (`jax.distributed`) each computes its share, and all return the whole.
    - `difficulty`: (n,) numbers, or a function of params that returns one, such as the steps of a run at
      `linkax.DRAFT`. Members of like difficulty share a chunk, since a chunk takes as long as its slowest member.
    - `store`: a folder, in which results are kept as they come, in Zarr format. A sweep that was killed goes on from
      there; damaged results are computed again; the store of another function or other parameters is refused.
      Processes that run the same sweep may share it.
    - `progress`: whether to show a progress bar; by default where the output is a terminal.
    - `executor`: any `concurrent.futures.Executor` that starts no process by fork, such as Dask's
      `client.get_executor()` or mpi4py's `MPIPoolExecutor`, or one of submitit's. Its workers compute one chunk in each
      task, on the first device of their process, and compile once each; all of them share the folder of
      `linkax.cache_programs`. What lost workers had goes to others, and workers may join. Numbers are bit for bit those
      of one process with the same chunk, on a like machine. The function is sent by cloudpickle, where that is
      installed.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` for params without a common leading axis, for a store of another sweep, for a folder in
    which no store can be, and for an executor that cannot run it. `RuntimeError` for a task that fails three times,
    which names its members, and for workers with other versions; a store keeps what has been computed.

    **Warns:** of damage in a store, and (`AccuracyWarning`, `StiffnessWarning`) of the number of members with each
    remark, see `Sweep.remarks`.
    """
    require_type(function, Callable, "function", "give a function of one set of parameters")
    params = as_arrays(params, "params")
    count = _members(params)
    if executor is not None:
        check_executor(executor, devices)
    options = dict(chunk=chunk, memory=memory, devices=devices, executor=executor)
    devices = _checked_devices(devices)
    _check_sizes(chunk, memory)
    folder = None
    if store is not None:
        folder = SweepStore.folder(require_type(store, str | os.PathLike, "store", "give the name of a folder"))
        SweepStore.check("params", params)
    with Progress(count, "member", progress) as line:
        one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), params)
        work = None if executor is None else Work.of(function, one)
        with compiling():
            shape = eqx.filter_eval_shape(function, one)
        outputs, static = eqx.partition(shape, is_struct)
        if folder is not None:
            SweepStore.check("output", outputs)
        order = _order(difficulty, params, count, options)
        on_cpu = executor is not None or devices[0].platform == "cpu"
        chunk = chunk or min(DEFAULT_CHUNK if on_cpu else CHUNK_OF_GRAPHICS_CARD, count)
        with compiling():
            if work is None:
                program = SweepProgram.compiled(function, one, chunk, memory, devices)
                engine, size, fingerprint = Threads(program), program.size, program.fingerprint
            else:
                engine, size, fingerprint = Workers.planned(executor, work, chunk, memory)
        plan = Plan(size, outputs, fingerprint)
        kept = None if folder is None else SweepStore.opened(folder, plan, params, order, NOT_RUN)
        arrays, seconds, ran = run_sweep(engine, plan, params, order, kept, line)
    back = np.argsort(order)
    reasons, *leaves = (array[back] for array in (arrays if jax.process_count() == 1 else _gathered(arrays)))
    output = eqx.combine(jax.tree.unflatten(jax.tree.structure(outputs), leaves), static)
    remarks = _remarks(output, count)
    for name, category in WARNINGS.items():
        if number := np.sum(code(remarks) == code(getattr(REMARKS, name))):
            told = f"{number} of {count} members: {REMARKS[getattr(REMARKS, name)]} Sweep.remarked tells which."
            warn(told, category)
    return Sweep(output, reasons, seconds / ran if ran else float("nan"), remarks)


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


def _gathered(arrays):
    """Gather the results of all processes in each of them."""
    stacked, owns = multihost_utils.process_allgather((arrays, arrays[0] != NOT_RUN))
    whose = np.argmax(owns, axis=0)
    return [array[whose, np.arange(len(whose))] for array in stacked]
