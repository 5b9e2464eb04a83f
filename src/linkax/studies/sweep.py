"""One function over many sets of parameters."""

import concurrent.futures
import itertools
import numbers
import os
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, PartitionSpec

from linkax.model.numbers import real, require_type, whole_number
from linkax.simulation.integrate.results import ENDED_WELL, KNOWN_RESULTS, REMARKS, RESULTS, WARNINGS
from linkax.simulation.read.solution import Solution
from linkax.studies.parameters import as_arrays
from linkax.studies.progress import progress_bar
from linkax.studies.sweep_store import SweepStore
from linkax.xla.enumerations import code, is_item, item

DEFAULT_CHUNK = 256  # members on one device: more take no less time each
DEFAULT_MEMORY = 2**31  # bytes
REASONS = (*KNOWN_RESULTS, "failed", "not_finite_output", "not_run")
FINE = [REASONS.index(name) for name in ENDED_WELL]
NOT_FINITE_OUTPUT, NOT_RUN = (REASONS.index(name) for name in ("not_finite_output", "not_run"))
EXPLANATIONS = {
    "failed": "failed",
    "not_finite_output": "The function returned numbers that are not finite, and no solution or result that tells why.",
    "not_run": "This member has not been run.",
}


class Sweep(NamedTuple):
    """What a function returned for each member of a batch.

    - `output`: as the function returns it, arrays with a leading axis of members. In members that failed it is what
      they left.
    - `reasons`: index into `linkax.studies.sweep.REASONS` of how each member ended, (n,).
    - `seconds_per_member`: wall time, compilation left out [s]; not a number where nothing was left to run.
    - `remarks`: a `linkax.REMARKS` of each member, (n,): what a run by itself would warn of, as far as the function
      returns a `Solution`, or `solution.remark()`.
    """

    output: Any
    reasons: np.ndarray
    seconds_per_member: float
    remarks: REMARKS

    @property
    def ok(self) -> np.ndarray:
        """Which members went well, (n,)."""
        return np.isin(self.reasons, FINE)

    @property
    def failed(self) -> dict[int, str]:
        """{member: why it failed}."""
        return {int(member): self.reason(member) for member in np.flatnonzero(~self.ok)}

    def reason(self, member: int) -> str:
        """How a member ended, in words."""
        name = REASONS[self.reasons[member]]
        return EXPLANATIONS[name] if name in EXPLANATIONS else RESULTS[getattr(RESULTS, name)]

    @property
    def remarked(self) -> dict[int, str]:
        """{member: what there is to say of it}."""
        each = lambda member: REMARKS[jax.tree.map(lambda values: np.asarray(values[member]), self.remarks)]
        return {int(member): each(member) for member in np.flatnonzero(code(self.remarks))}

    def count(self) -> dict[str, int]:
        """How many members ended in which way: {name of a result: number}."""
        return {name: int(np.sum(self.reasons == index)) for index, name in enumerate(REASONS) if index in self.reasons}


def sweep(
    function: Callable,
    params: Any,
    *,
    chunk: int | None = None,
    memory: float = DEFAULT_MEMORY,
    devices: list | None = None,
    difficulty: Callable | np.ndarray | None = None,
    store: str | os.PathLike | None = None,
    progress: bool | None = None,
) -> Sweep:
    """Evaluate a function for every set of parameters of a batch: compiled once, in chunks, on all devices.

    Members are independent: one that fails is marked and changes no other. A function that returns a `Solution`, or
    a `solution.result` beside what it computes, says why; of others numbers that are not finite count as a failure.
    One that returns a `Solution`, or `solution.remark()`, also says what a single run would have warned of.

    **Arguments:**

    - `function`: params -> arrays in any pytree, `Solution` included. A pure function that JAX can trace.
    - `params`: pytree of arrays with one leading axis of members.
    - `chunk`: members that one device computes together; default 256, or fewer where they need more than `memory`.
    - `memory`: of each device, for one chunk [bytes].
    - `devices`: default all of this process. A CPU counts as one, and computes one chunk on each of its cores. In a job
      of several processes (`jax.distributed`) each computes its share, and all return the whole.
    - `difficulty`: numbers (n,), or a function of params that gives one, such as the steps of a run at `linkax.DRAFT`.
      Members of like difficulty share a chunk: a chunk takes as long as its slowest member.
    - `store`: a folder, in which results are kept as they come, in Zarr format. A sweep that was killed goes on from
      there, and what has been damaged is computed again; one of another function or other parameters is refused.
      Processes that run the same sweep may share it.
    - `progress`: show a bar; default: where someone watches.

    **Raises:** `ValueError` for a batch that is none, for a store of another sweep, and for one that cannot be there.

    **Warns:** of what is damaged in a store, and (`AccuracyWarning`, `StiffnessWarning`) of how many members there is
    something to say, see `Sweep.remarks`.
    """
    require_type(function, Callable, "function", "give a function of one set of parameters")
    params = as_arrays(params, "params")
    count = _members(params)
    devices = list(jax.local_devices()) if devices is None else _checked_devices(devices)
    if chunk is not None:
        whole_number(chunk, "chunk")
    if isinstance(memory, bool) or not isinstance(memory, numbers.Real) or not memory > 0:
        raise ValueError(f"memory is {memory!r}; it must be a positive number of bytes")
    if store is not None:
        store = SweepStore.folder(require_type(store, str | os.PathLike, "store", "give the name of a folder"))
        SweepStore.check("params", params)
    with progress_bar(count, "member", progress, smoothing=0.05) as bar:
        one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), params)
        shape = eqx.filter_eval_shape(function, one)
        if store is not None:
            SweepStore.check("output", eqx.filter(shape, _is_struct))
        order = _order(difficulty, params, count, dict(chunk=chunk, memory=memory, devices=devices))
        program = _Program.compiled(function, one, shape, chunk or min(DEFAULT_CHUNK, count), memory, devices)
        bar.set_description("sweeping")
        kept = None if store is None else SweepStore.opened(store, program, params, order, NOT_RUN)
        found, seconds, ran = _run(program, params, order, kept, bar)
    arrays, reasons = found if jax.process_count() == 1 else _gathered(found)
    back = np.argsort(order)
    output = eqx.combine(jax.tree.map(lambda array: array[back], arrays), program.static)
    remarks = _remarks(output, count)
    for name, category in WARNINGS.items():
        if number := np.sum(code(remarks) == code(getattr(REMARKS, name))):
            told = f"{number} of {count} members: {REMARKS[getattr(REMARKS, name)]} Sweep.remarked tells which."
            warnings.warn(told, category, stacklevel=2)
    return Sweep(output, reasons[back], seconds / ran if ran else float("nan"), remarks)


def _remarks(output, count) -> REMARKS:
    """Of each member the first that its output holds, or that applies to a solution in it."""
    is_remark = lambda node: is_item(node, REMARKS)
    is_told = lambda node: is_remark(node) or isinstance(node, Solution)
    told = [node for node in jax.tree.leaves(output, is_leaf=is_told) if is_told(node)]
    values = [code(node if is_remark(node) else node.remark()).reshape(count, -1) for node in told]
    values = np.concatenate([*values, np.zeros((count, 1), np.int32)], axis=1)
    return item(values[np.arange(count), np.argmax(values != 0, axis=1)], REMARKS)


def _is_struct(leaf):
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _members(params) -> int:
    sizes = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(params)}
    if len(sizes) != 1 or sizes == {()} or sizes == {(0,)}:
        shapes = {jax.tree_util.keystr(path): jnp.shape(leaf) for path, leaf in jax.tree.leaves_with_path(params)}
        raise ValueError(f"params have shapes {shapes}; give every array the same leading axis, one entry per member")
    return sizes.pop()[0]


def _checked_devices(devices):
    devices = list(devices) if isinstance(devices, Iterable) else [devices]
    if not devices or not all(isinstance(device, jax.Device) for device in devices):
        raise ValueError(f"devices are {devices!r}; give a list of jax.local_devices(), or None for all of them")
    if len(set(devices)) < len(devices):
        raise ValueError(f"devices are {devices!r}; give each of them once")
    return devices


def _order(difficulty, params, count, options):
    """In which order members run: the difficult ones first."""
    if difficulty is None:
        return np.arange(count)
    if callable(difficulty):
        difficulty = sweep(difficulty, params, progress=False, **options).output
    difficulty = np.asarray(real(difficulty, "difficulty"))
    if difficulty.shape != (count,):
        raise ValueError(f"difficulty has shape {difficulty.shape}; give one number for each of {count} members")
    return np.argsort(-np.nan_to_num(difficulty, nan=np.inf), kind="stable")


def _is_result(node):
    return is_item(node, RESULTS)


def _member(function):
    """A function's arrays, and how the member ended, as an index into `REASONS`."""

    def run(params):
        output = function(params)
        arrays, _ = eqx.partition(output, eqx.is_array)
        results = [node for node in jax.tree.leaves(output, is_leaf=_is_result) if _is_result(node)]
        numbers = [leaf for leaf in jax.tree.leaves(arrays) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
        # Beside a result, what has not been reached may be infinite.
        spoiled = jnp.isnan if results else lambda leaf: jnp.logical_not(jnp.isfinite(leaf))
        spoilt = jnp.array([jnp.any(spoiled(leaf)) for leaf in numbers]).any()
        reasons = jnp.concatenate([*(jnp.ravel(_reason(result)) for result in results), jnp.zeros(1, jnp.int8)])
        failed = jnp.logical_not(jnp.isin(reasons, jnp.array(FINE)))
        # The first that failed, else the first.
        reason = reasons[jnp.argmax(failed)]
        return arrays, jnp.where(spoilt & jnp.logical_not(jnp.any(failed)), NOT_FINITE_OUTPUT, reason).astype(jnp.int8)

    return run


def _reason(result):
    found = jnp.full(jnp.shape(code(result)), REASONS.index("failed"), jnp.int8)
    for index, name in enumerate(KNOWN_RESULTS):
        found = jnp.where(result == getattr(RESULTS, name), index, found).astype(jnp.int8)
    return found


class _Program(NamedTuple):
    """The compiled function, of `size` members at once.

    - `outputs`: shapes of its arrays. `static`: what of the output is no array.
    - `text`: of the program, the same for the same function.
    """

    run: Callable
    size: int
    outputs: Any
    static: Any
    text: str

    @property
    def workers(self) -> int:
        """How many chunks are computed at once.

        Calls of LAPACK for batches, from programs that run at once on a CPU, may wait for each other for ever
        (jaxlib 0.10: they wait for threads of the pool that they run in). linkax makes none, see `linkax.xla.tracing`.
        """
        if jax.default_backend() != "cpu":
            return 2  # one is computed while the results of another are copied
        return 1 if _calls_lapack_for_batches(self.text) else _cores()

    @staticmethod
    def compiled(function, one, shape, chunk, memory, devices) -> "_Program":
        """For parameters like `one`, of one member, and an output like `shape`."""
        static = eqx.partition(shape, _is_struct)[1]
        while True:
            size = chunk * len(devices)
            batch = jax.tree.map(lambda leaf, size=size: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), one)
            with jax.default_device(devices[0]):
                lowered = jax.jit(_spread(jax.vmap(_member(function)), devices)).lower(batch)
                text = lowered.as_text()
                if len(devices) > 1 and devices[0].platform == "cpu" and _calls_lapack_for_batches(text):
                    devices = devices[:1]
                    continue
                run = lowered.compile()
            used = _memory(run)
            if used <= memory or chunk == 1:
                return _Program(run, size, lowered.out_info, static, text)
            chunk = max(1, int(0.9 * chunk * memory / used))


def _spread(mapped, devices):
    """A function of a batch, each part of it on a device of its own that waits for no other."""
    if len(devices) == 1:
        return mapped
    members = PartitionSpec("members")
    mesh = Mesh(np.array(devices), ("members",))
    return jax.shard_map(mapped, mesh=mesh, in_specs=(members,), out_specs=members, check_vma=False)


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def _calls_lapack_for_batches(text) -> bool:
    calls = (line for line in text.splitlines() if "@lapack_" in line or "@blas_" in line)
    return any('num_batch_dims = "0"' not in line for line in calls)


def _memory(compiled) -> int:
    """Bytes that a program takes on one device, as far as the compiler tells."""
    found = compiled.memory_analysis()
    if found is None:
        return 0
    return found.temp_size_in_bytes + found.argument_size_in_bytes + found.output_size_in_bytes


def _run(program, params, order, kept, bar):
    """Outputs and reasons in the order of running, the seconds that it took, and how many members ran."""
    count = len(order)
    starts = range(0, count, program.size)
    own = starts[jax.process_index() :: jax.process_count()]
    found = jax.tree.map(lambda info: np.zeros((count, *info.shape[1:]), info.dtype), program.outputs)
    reasons = found[1]
    reasons[:] = NOT_RUN
    done = set() if kept is None else kept.load(found)
    params = jax.tree.map(np.asarray, params)

    def compute(start):
        members = order[np.minimum(np.arange(start, start + program.size), count - 1)]
        values = jax.tree.map(lambda leaf: leaf[members], params)
        return start, jax.tree.map(np.asarray, program.run(values))

    failed = int(np.sum(~np.isin(reasons, [*FINE, NOT_RUN])))
    bar.update(sum(min(program.size, count - start) for start in done))
    left = [start for start in own if start not in done]
    began, ran = time.perf_counter(), 0
    for start, computed in _in_parallel(compute, left, program.workers):
        part = slice(start, min(start + program.size, count))
        computed = jax.tree.map(lambda array, part=part: array[: part.stop - part.start], computed)
        for whole, piece in zip(jax.tree.leaves(found), jax.tree.leaves(computed), strict=True):
            whole[part] = piece
        if kept is not None:
            kept.save(start, part, computed)
        ran += part.stop - part.start
        bar.update(part.stop - part.start)
        failed += int(np.sum(~np.isin(reasons[part], FINE)))
        bar.set_postfix(failed=failed)
    elapsed = time.perf_counter() - began
    if kept is not None and jax.process_count() > 1:
        multihost_utils.sync_global_devices("sweep")
    return found, elapsed, ran


def _in_parallel(compute, items, workers):
    """Results as they come, of so many threads; at most one chunk waits for each."""
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        queue, running = iter(items), set()
        while True:
            running |= {pool.submit(compute, item) for item in itertools.islice(queue, 2 * workers - len(running))}
            if not running:
                return
            finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                yield future.result()


def _gathered(found):
    """What each process found, put together in all of them."""
    own = found[1] != NOT_RUN
    everyone = multihost_utils.process_allgather((found, own))
    (arrays, reasons), by = everyone
    whose = np.argmax(by, axis=0)
    pick = lambda stacked: stacked[whose, np.arange(len(whose))]
    return jax.tree.map(pick, arrays), pick(reasons)
