"""Sweeps on engines of others: every member once, bit for bit, whatever happens to workers."""

import concurrent.futures
import importlib.util
import multiprocessing
import os
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from studies import sweep_job

import linkax as lx
from linkax.studies.sweeps.sweep_run import TRIES
from linkax.studies.sweeps.sweep_workers import Refusal, Work, plan_sweep, sweep_chunk

LIMIT = 120.0  # seconds
FREE = 10  # tasks that run before the gate opens
NUMBERS = jnp.linspace(0.1, 1.0, 10)
MEMBERS, CHUNK, LARGE = 120, 2, 60
BATCH = {"stiffness": jnp.linspace(0.5, 2.0, MEMBERS).at[3].set(jnp.nan)}


def oscillate(params):
    """A swing of a spring, by many small steps."""
    step = lambda _, state: (state[0] + 1e-3 * state[1], state[1] - 1e-3 * params["stiffness"] * jnp.sin(state[0]))
    position, speed = jax.lax.fori_loop(0, 1000, step, (1.0, 0.0))
    return {"position": position, "speed": speed}


def same(found, right):
    jax.tree.map(np.testing.assert_array_equal, found.output, right.output)
    np.testing.assert_array_equal(found.reasons, right.reasons)


def environment():
    """With the same linkax as here."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def noted(folder, number, task, *arguments):
    """In a worker, run a task, and note which it was and who ran it; all but the first wait until a gate opens."""
    deadline = time.monotonic() + LIMIT
    (folder / f"begun-{number}-{os.getpid()}").touch()
    while number > FREE and not (folder / "open").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    result = task(*arguments)
    (folder / f"ended-{number}-{os.getpid()}").touch()
    return result


class Noting(concurrent.futures.Executor):
    """An executor whose workers note what they run."""

    def __init__(self, inner, folder):
        self.inner, self.folder, self.sent = inner, folder, 0

    def submit(self, task, /, *arguments):
        self.sent += 1
        return self.inner.submit(noted, self.folder, self.sent, task, *arguments)

    def who(self, what):
        """Of the tasks that have begun or ended, the number of each and the processes."""
        return [tuple(map(int, path.name.split("-")[1:])) for path in self.folder.glob(f"{what}-*")]


class Cluster(NamedTuple):
    """A scheduler of Dask in this process, and worker processes of one thread."""

    client: object
    workers: list

    def join(self):
        command = [sys.executable, "-m", "distributed.cli.dask_worker", self.client.scheduler.address]
        options = ["--no-nanny", "--nthreads", "1", "--no-dashboard"]
        self.workers.append(subprocess.Popen([*command, *options], env=environment(), stderr=subprocess.DEVNULL))
        return self.workers[-1]


@pytest.fixture(scope="module")
def dask():
    distributed = pytest.importorskip("distributed")
    local = dict(n_workers=0, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://")
    with distributed.LocalCluster(**local) as scheduler, distributed.Client(scheduler) as client:
        cluster = Cluster(client, [])
        try:
            for _ in range(3):
                cluster.join()
            client.wait_for_workers(3, timeout=LIMIT)
            yield cluster
        finally:
            for worker in cluster.workers:
                worker.kill()
                worker.wait()


def until(condition):
    deadline = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
def test_dask_worker_killed_and_one_that_joins_late(dask, tmp_path):
    """After ten chunks all workers hold one more; one of them is killed, and the others wait for one that joins."""
    executor = Noting(dask.client.get_executor(), tmp_path)

    def disturb():
        until(lambda: len(executor.who("begun")) >= FREE + 3)
        dask.workers[0].kill()
        dask.workers[0].wait()
        late = dask.join()
        until(lambda: len(dask.client.scheduler_info()["workers"]) == 3)
        (tmp_path / "open").touch()
        return late.pid

    with concurrent.futures.ThreadPoolExecutor(1) as thread:
        late = thread.submit(disturb)
        found = lx.sweep(oscillate, BATCH, chunk=CHUNK, store=tmp_path / "store", executor=executor)
        late = late.result()
    ended = executor.who("ended")
    assert {number for number, _ in ended} == set(range(1, MEMBERS // CHUNK + 2))  # and a plan
    assert dask.workers[0].pid in {process for _, process in set(executor.who("begun")) - set(ended)}
    assert late in {process for _, process in ended}
    right = lx.sweep(oscillate, BATCH, chunk=CHUNK)
    assert list(right.failed) == [3]
    same(found, right)
    # To threads that go on from its store, there is nothing left to do.
    again = lx.sweep(oscillate, BATCH, chunk=CHUNK, store=tmp_path / "store")
    same(again, right)
    assert np.isnan(again.seconds_per_member)


def test_dask_tells_what_workers_cannot_do(dask):
    def rough(params):
        if os.getpid() != here:
            raise OSError("no such file on this machine")
        return params

    here = os.getpid()
    with pytest.raises(RuntimeError, match=f"could not be compiled: its task failed {TRIES} times.*no such file on"):
        lx.sweep(rough, NUMBERS, executor=dask.client.get_executor())


class Here(concurrent.futures.Executor):
    """Runs tasks at once, here; those whose numbers `fails` has fail."""

    def __init__(self, fails=()):
        self.fails, self.sent = fails, 0

    def submit(self, task, /, *arguments):
        self.sent += 1
        future = concurrent.futures.Future()
        if self.sent in self.fails:
            future.set_exception(MemoryError("lost"))
        else:
            future.set_result(task(*arguments))
        return future


def test_tasks_that_fail_are_tried_again():
    right = lx.sweep(jnp.sin, NUMBERS, chunk=2)
    engine = Here(fails=(1, 4, 8))  # the plan, a chunk, and the same again
    same(lx.sweep(jnp.sin, NUMBERS, chunk=2, executor=engine), right)
    assert engine.sent == 9


def test_members_whose_tasks_fail_again_and_again_are_named(tmp_path):
    engine = Here(fails=range(4, 100))
    with pytest.raises(RuntimeError, match=r"members 4 to 5 could not .* failed 3 times, .* by MemoryError: lost; .*"):
        lx.sweep(jnp.sin, NUMBERS, chunk=2, executor=engine, store=tmp_path)
    # What was computed before is kept.
    rest = Here()
    same(lx.sweep(jnp.sin, NUMBERS, chunk=2, executor=rest, store=tmp_path), lx.sweep(jnp.sin, NUMBERS, chunk=2))
    assert rest.sent == 1 + 3


def test_engines_that_take_no_more():
    pool = concurrent.futures.ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(RuntimeError, match=r"takes no more tasks, by RuntimeError: cannot schedule .* start another"):
        lx.sweep(jnp.sin, NUMBERS, executor=pool)


def test_chunks_fit_into_the_memory_of_workers_and_difficulty_runs_there_too():
    matrix = lambda x: jnp.eye(100) + x * jnp.sin(jnp.arange(1e4).reshape(100, 100))
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        found = lx.sweep(lambda x: matrix(x) @ matrix(x), NUMBERS, executor=pool, memory=2**20, difficulty=lambda x: x)
    np.testing.assert_allclose(found.output[3], matrix(NUMBERS[3]) @ matrix(NUMBERS[3]), rtol=1e-14)
    assert found.ok.all()


def test_workers_that_cannot_run_it_tell_why():
    work = Work.of(jnp.sin, jax.ShapeDtypeStruct((), float))
    size, fingerprint = plan_sweep(work, 2, 1e9)
    assert size == 2
    leaves = [np.arange(2.0)]
    for text, arguments in {
        "it has jax ": (work._replace(setup=work.setup | {"jax": "0.1"}), fingerprint),
        "cannot read the function: ": (work._replace(pickled=b"cno_such_module\nf\n."), fingerprint),
        "another program": (work, "another"),
    }.items():
        told = sweep_chunk(arguments[0], 2, arguments[1], leaves)
        assert isinstance(told, Refusal)
        assert text in told.why
    reasons, sines = sweep_chunk(work, 2, fingerprint, leaves)
    np.testing.assert_array_equal(reasons, 0)
    np.testing.assert_allclose(sines, np.sin(leaves[0]), rtol=1e-15)


def test_a_worker_that_refuses_ends_the_sweep():
    class Other(Here):
        def submit(self, task, work, /, *arguments):
            return super().submit(task, work._replace(setup=work.setup | {"linkax": "0.0.1"}), *arguments)

    with pytest.raises(RuntimeError, match=r"a worker refused it, it has linkax .* instead of 0\.0\.1; give workers"):
        lx.sweep(jnp.sin, NUMBERS, executor=Other())


def test_executors_that_cannot_be(monkeypatch):
    class Client:
        def get_executor(self):
            raise AssertionError

    sweep = lambda **options: lambda: lx.sweep(jnp.sin, NUMBERS, **options)
    refused(sweep(executor=Client()), "executor", "client.get_executor()")
    refused(sweep(executor=4), "executor is 4")
    fork = concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("fork"))
    refused(sweep(executor=fork), "executor", "fork", "spawn")
    refused(sweep(executor=Here(), devices=jax.devices()), "devices", "executor")
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    refused(sweep(executor=Here()), "executor", "jax.distributed job of 2 processes")


def test_functions_that_cannot_be_sent(monkeypatch):
    lock = threading.Lock()
    refused(lambda: lx.sweep(lambda x: (lock, x)[1], NUMBERS, executor=Here()), "function", "cannot be sent")
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    refused(lambda: lx.sweep(lambda x: x, NUMBERS, executor=Here()), "cannot be sent", "linkax[cluster]")
    same(lx.sweep(oscillate, BATCH, executor=Here()), lx.sweep(oscillate, BATCH))  # of a module


@pytest.fixture(scope="module")
def swung():
    """Pendulums in this process, as large chunks."""
    return lx.sweep(sweep_job.swing, sweep_job.batch(), chunk=LARGE)


@pytest.mark.slow
def test_pool_of_processes(swung):
    with concurrent.futures.ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        same(lx.sweep(sweep_job.swing, sweep_job.batch(), chunk=LARGE, executor=pool), swung)


def dying(x):
    """Ends the process that traces it, but for this one."""
    return x if os.environ.get("HERE") == str(os.getpid()) else os._exit(1)


@pytest.mark.slow
def test_pool_that_loses_a_process(monkeypatch):
    monkeypatch.setenv("HERE", str(os.getpid()))
    with (
        concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool,
        pytest.raises(RuntimeError, match=r"takes no more tasks, by BrokenProcessPool.* start another"),
    ):
        lx.sweep(dying, NUMBERS, executor=pool)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="submitit is not installed")
def test_jobs_of_submitit(swung, tmp_path):
    import submitit

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", environment()["PYTHONPATH"])
        executor = submitit.AutoExecutor(tmp_path, cluster="local")
        executor.update_parameters(timeout_min=4)
        same(lx.sweep(sweep_job.swing, sweep_job.batch(), chunk=LARGE, executor=executor), swung)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("mpi4py") is None, reason="mpi4py is not installed")
def test_processes_of_mpi(swung, tmp_path):
    launcher = shutil.which("mpiexec", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    if launcher is None:
        pytest.skip("no mpiexec is installed")
    job = [sweep_job.__file__, "-", str(tmp_path / "found.npz"), "mpi", str(LARGE)]
    command = [launcher, "-n", "3", sys.executable, "-m", "mpi4py.futures", *job]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    with np.load(tmp_path / "found.npz") as found:
        np.testing.assert_array_equal(found["angle"], swung.output["angle"])
        np.testing.assert_array_equal(found["reasons"], swung.reasons)
