"""Run the chunks of a sweep, in threads of this process or as tasks of an engine, and take results as they come."""

import concurrent.futures
import itertools
import queue
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from contextlib import closing, nullcontext
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils

from linkax.studies.sweeps.sweep_program import Plan, SweepProgram
from linkax.studies.sweeps.sweep_result import FINE, NOT_RUN
from linkax.studies.sweeps.sweep_store import SweepStore
from linkax.studies.sweeps.sweep_workers import Refusal, Work, as_leaves, plan_sweep, sweep_chunk
from linkax.xla.waiting import Progress

MOST_TASKS = 4096  # that an engine holds at once: enough for workers that join
TRIES = 3  # of a task that fails, since it can be its worker that does
POLL = 0.2  # how often to ask jobs that tell nothing by themselves [s]
Results = Generator[tuple[int, list[np.ndarray]], None, None]  # where a chunk begins, [reasons, *arrays of the output]


class Chunks(NamedTuple):
    """Members in the order in which they run, as chunks of equal size; the last one repeats a member."""

    params: Any
    order: np.ndarray
    size: int

    def members(self, start: int) -> np.ndarray:
        """The members of the chunk that begins at a row."""
        return self.order[np.minimum(np.arange(start, start + self.size), len(self.order) - 1)]

    def values(self, start: int) -> Any:
        """Params of these members."""
        members = self.members(start)
        return jax.tree.map(lambda leaf: leaf[members], self.params)


class Threads(NamedTuple):
    """Threads of this process, which run chunks."""

    program: SweepProgram

    def run(self, chunks: Chunks, starts: Iterable[int]) -> Results:
        """At most one chunk waits for each thread."""
        compute = lambda start: (start, as_leaves(self.program.run(chunks.values(start))))
        workers = self.program.workers
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            left, running = iter(starts), set()
            while True:
                running |= {pool.submit(compute, start) for start in itertools.islice(left, 2 * workers - len(running))}
                if not running:
                    return
                finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
                for future in finished:
                    yield future.result()


class Workers(NamedTuple):
    """Processes of an engine, of which a `concurrent.futures.Executor` or submitit's takes tasks."""

    executor: Any
    work: Work
    fingerprint: str

    @staticmethod
    def planned(executor: Any, work: Work, chunk: int, memory: int | float) -> "tuple[Workers, int, str]":
        """Have one of them compile, and return the engine, the size of a chunk, and the program's fingerprint."""
        described = lambda _: "the function could not be compiled"
        with closing(_results(executor, plan_sweep, lambda _: (work, chunk, memory), [None], described)) as results:
            _, (size, fingerprint) = next(results)
        return Workers(executor, work, fingerprint), size, fingerprint

    def run(self, chunks: Chunks, starts: Iterable[int]) -> Results:
        """A task for each chunk."""
        arguments = lambda start: (self.work, chunks.size, self.fingerprint, jax.tree.leaves(chunks.values(start)))
        described = lambda start: f"members {_named(chunks.members(start))} could not be computed"
        return _results(self.executor, sweep_chunk, arguments, starts, described)


def run_sweep(
    engine: Threads | Workers, plan: Plan, params: Any, order: np.ndarray, kept: SweepStore | None, line: Progress
) -> tuple[list[np.ndarray], float, int]:
    """Run the chunks that no store holds.

    **Returns:** [reasons, *arrays of the output] in the order of running, the time that it took [s], and the number of
    members that ran.
    """
    count = len(order)
    own = range(0, count, plan.size)[jax.process_index() :: jax.process_count()]
    reasons = np.full(count, NOT_RUN, np.int8)
    whole = [reasons, *(np.zeros((count, *info.shape), info.dtype) for info in jax.tree.leaves(plan.outputs))]
    done = set() if kept is None else kept.load(whole)
    chunks = Chunks(jax.tree.map(np.asarray, params), order, plan.size)
    failed = int(np.sum(~np.isin(reasons, [*FINE, NOT_RUN])))
    finished = sum(min(plan.size, count - start) for start in done)
    began, ran = time.perf_counter(), 0
    with closing(engine.run(chunks, [start for start in own if start not in done])) as results:
        for start, computed in results:
            part = slice(start, min(start + plan.size, count))
            pieces = [array[: part.stop - start] for array in computed]
            for array, piece in zip(whole, pieces, strict=True):
                array[part] = piece
            if kept is not None:
                kept.save(start, part, pieces)
            ran += part.stop - start
            failed += int(np.sum(~np.isin(reasons[part], FINE)))
            line.tell("sweeping", finished + ran, f", {failed} failed" if failed else "")
    elapsed = time.perf_counter() - began
    if kept is not None and jax.process_count() > 1:
        multihost_utils.sync_global_devices("sweep")
    return whole, elapsed, ran


def _results(
    executor: Any,
    task: Callable,
    arguments: Callable[[Any], tuple],
    items: Iterable[Any],
    described: Callable[[Any], str],
) -> Generator[tuple[Any, Any], None, None]:
    """Yield each item with the result of its task, once, as they come; tasks that fail are sent again.

    Engines run again what a lost worker had; what they give up is what fails here.

    **Raises:** `RuntimeError` for a task that fails `TRIES` times or is refused, and for an engine that takes no more.
    """
    left, again, tries, running, ended = iter(items), deque(), Counter(), {}, queue.SimpleQueue()
    try:
        while True:
            sent = [*again, *itertools.islice(left, MOST_TASKS - len(running) - len(again))]
            again.clear()
            futures = _submitted(executor, task, map(arguments, sent)) if sent else []
            for item, future in zip(sent, futures, strict=True):
                running[future] = item
                if hasattr(future, "add_done_callback"):
                    future.add_done_callback(ended.put)
            if not running:
                return
            future = _ended(running, ended)
            item = running.pop(future)
            try:
                result = future.result()
            except Exception as error:
                tries[item] += 1
                if tries[item] == TRIES:
                    raise RuntimeError(
                        f"{described(item)}: its task failed {TRIES} times, the last time by {type(error).__name__}: "
                        f"{error}; see what the workers tell, and give a smaller chunk where they ran out of memory"
                    ) from error
                again.append(item)
                continue
            if isinstance(result, Refusal):
                raise RuntimeError(f"{described(item)}: a worker refused it, {result.why}")
            yield item, result
    finally:
        for future in running:
            future.cancel()


def _submitted(executor, task, arguments) -> list[Any]:
    """Futures of tasks, or submitit's jobs, which go out together as an array."""
    try:
        with executor.batch() if hasattr(executor, "batch") else nullcontext():
            return [executor.submit(task, *each) for each in arguments]
    except Exception as error:
        raise RuntimeError(
            f"executor {executor!r} takes no more tasks, by {type(error).__name__}: {error}; start another one, and "
            "give the store of this sweep, if it has one, to go on from there"
        ) from error


def _ended(running, ended) -> Any:
    """The next future that ends."""
    if hasattr(next(iter(running)), "add_done_callback"):
        return ended.get()
    while True:
        for job in running:
            if job.done():
                return job
        time.sleep(POLL)


def _named(members) -> str:
    """Members of a chunk, in few words."""
    members = list(dict.fromkeys(members.tolist()))
    if members == list(range(members[0], members[-1] + 1)):
        return f"{members[0]} to {members[-1]}"
    return ", ".join(map(str, members[:5])) + (", ..." if len(members) > 5 else "")
