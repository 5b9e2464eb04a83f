"""Sweeps on a Dask cluster of this machine: whether they survive it, and what it costs.

- `lost`: three workers, one killed and one that joins: bit for bit the result of one process, no chunk lost or doubled.
- `overhead`: of chunks through Dask, against threads of one process: as many threads, same chunks, by turns.
- `starts`: from nothing to the first results of a function that takes nothing to compile: one process, two of
  `jax.distributed`, or two workers of Dask; and what a second sweep takes.

The others sweep crank-sliders, `--members N` (default 10 000). `--rounds N` (default 5). Programs are kept in a folder.
"""

import argparse
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np

CASES = ("lost", "overhead", "starts")
CHUNKS_BEFORE = 5  # of a sweep, before a worker is killed
FEW = 512  # members of a sweep that only starts
LIMIT = 600.0  # s


def params(members):
    generator = np.random.default_rng(0)
    return {"rod": generator.uniform(1.5, 3.0, members), "rod_mass": generator.uniform(0.5, 2.0, members)}


def little(x):
    """A member that takes next to nothing to compile."""
    return 2.0 * x


@contextmanager
def scheduler():
    """A scheduler of Dask in this process, and its client."""
    import distributed

    local = dict(n_workers=0, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://")
    with distributed.LocalCluster(**local) as cluster, distributed.Client(cluster) as client:
        yield cluster.scheduler, client


def started(client, threads) -> subprocess.Popen:
    """A worker."""
    command = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address, "--no-nanny"]
    options = ["--nthreads", str(threads), "--no-dashboard", "--name", f"worker-{time.monotonic_ns()}"]
    return subprocess.Popen([*command, *options], stderr=subprocess.DEVNULL)


def lost(members, _):
    from distributed.diagnostics.plugin import SchedulerPlugin

    import linkax as lx
    from benchmarks.sweep import member
    from linkax.studies.sweeps.sweep_result import NOT_RUN
    from linkax.studies.sweeps.sweep_store import SweepStore

    class Who(SchedulerPlugin):
        """Counts chunks by the workers that computed them."""

        def transition(self, key, start, finish, *_, worker=None, **__):
            if (start, finish) == ("processing", "memory") and str(key).startswith("sweep_chunk"):
                by[worker] += 1

    by: Counter = Counter()
    saved, save, happened = Counter(), SweepStore.save, {}

    def counted(store, start, part, pieces):
        saved[start] += 1
        save(store, start, part, pieces)

    def disturb():
        while len(saved) < CHUNKS_BEFORE:
            time.sleep(0.001)
        for worker in workers:  # until another has joined, however fast they are
            worker.send_signal(signal.SIGSTOP)
        happened["chunks_before"] = len(saved)
        workers.append(started(client, 1))
        client.wait_for_workers(4, timeout=LIMIT)
        workers[0].kill()
        workers[0].wait()
        for worker in workers[1:3]:
            worker.send_signal(signal.SIGCONT)

    with tempfile.TemporaryDirectory() as folder, scheduler() as (central, client):
        central.add_plugin(Who())
        workers = [started(client, 1) for _ in range(3)]
        SweepStore.save = counted
        try:
            client.wait_for_workers(3, timeout=LIMIT)
            thread = threading.Thread(target=disturb)
            thread.start()
            began = time.perf_counter()
            on_dask = lx.sweep(member, params(members), store=folder, executor=client.get_executor())
            took = time.perf_counter() - began
            thread.join()
        finally:
            SweepStore.save = save
            for worker in workers:
                worker.kill()
                worker.wait()
    one = lx.sweep(member, params(members))
    equal = [np.array_equal(on_dask.output[name], one.output[name], equal_nan=True) for name in ("slider", "steps")]
    return {
        "members": members,
        "chunks": len(saved),
        **happened,
        "chunks_of_each_worker": sorted(by.values()),
        "bit_for_bit": all(equal) and np.array_equal(on_dask.reasons, one.reasons),
        "members_not_run": int(np.sum(on_dask.reasons == NOT_RUN)),
        "chunks_doubled": sum(saved.values()) - len(saved),
        "ended": on_dask.count(),
        "wall_s": took,
    }


def overhead(members, rounds):
    import equinox as eqx
    import jax
    import psutil

    from benchmarks.sweep import member
    from linkax.studies.sweeps.sweep import DEFAULT_CHUNK, DEFAULT_MEMORY
    from linkax.studies.sweeps.sweep_program import Plan, SweepProgram, is_struct
    from linkax.studies.sweeps.sweep_run import Threads, Workers, run_sweep
    from linkax.studies.sweeps.sweep_workers import Work
    from linkax.xla.waiting import Progress

    given = params(members)
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((), leaf.dtype), given)
    outputs = eqx.filter(eqx.filter_eval_shape(member, one), is_struct)
    chunk = min(DEFAULT_CHUNK, members)
    program = SweepProgram.compiled(member, one, chunk, DEFAULT_MEMORY, jax.local_devices()[:1])
    with scheduler() as (_, client):
        worker = started(client, program.workers)
        try:
            client.wait_for_workers(1, timeout=LIMIT)
            workers, size, _ = Workers.planned(client.get_executor(), Work.of(member, one), chunk, DEFAULT_MEMORY)
            assert size == program.size
            plan = Plan(size, outputs, program.fingerprint)
            process = psutil.Process(worker.pid)

            def busy():
                """Time of the processor, here and in the worker."""
                times = process.cpu_times()
                return np.array([time.process_time(), times.user + times.system])

            def timed(engine):
                before, quiet = busy(), Progress(members, "member", False)
                _, wall, _ = run_sweep(engine, plan, given, np.arange(members), None, quiet)
                here, there = busy() - before
                return wall, here + there, here

            engines = {"threads": Threads(program), "dask": workers}
            found = {name: [] for name in engines}
            for number in range(rounds + 1):
                for name, engine in list(engines.items())[:: 1 if number % 2 else -1]:
                    times = timed(engine)
                    if number:  # the first one warms up
                        found[name].append(times)
        finally:
            worker.kill()
            worker.wait()
    ratios = np.array(found["dask"]) / np.array(found["threads"])
    spread = lambda values: [round(float(value), 4) for value in np.quantile(values, (0.0, 0.5, 1.0))]
    return {
        "members": members,
        "chunks": -(-members // size),
        "threads": program.workers,
        "rounds": rounds,
        "wall_s": {name: spread(np.array(times)[:, 0]) for name, times in found.items()},
        "processor_s": {name: spread(np.array(times)[:, 1]) for name, times in found.items()},
        "processor_s_of_scheduler_and_client": spread(np.array(found["dask"])[:, 2]),
        "wall_ratio": spread(ratios[:, 0]),
        "processor_ratio": spread(ratios[:, 1]),
        "load_beside": os.getloadavg()[0],
    }


def job(kind, *place):
    """In a process of its own: begin as `kind`, sweep twice, and print what each took [s]."""
    began = time.perf_counter()
    import jax

    import linkax as lx

    told, executor = {"import": time.perf_counter() - began}, None
    if kind == "jax.distributed":
        process, port = map(int, place)
        jax.distributed.initialize(f"localhost:{port}", 2, process)
    if kind == "dask":
        import distributed

        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        executor = distributed.Client(cluster).get_executor()
    told["engine"] = time.perf_counter() - began - told["import"]
    for name in ("first_sweep", "second_sweep"):
        before = time.perf_counter()
        lx.sweep(little, np.arange(1.0 * FEW), executor=executor)
        told[name] = time.perf_counter() - before
    told["all"] = time.perf_counter() - began
    print(json.dumps(told), flush=True)
    if kind == "dask":
        cluster.close()


def starts(_, rounds):
    def run(kind):
        with socket.socket() as listener:
            listener.bind(("localhost", 0))
            port = str(listener.getsockname()[1])
        places = [["0", port], ["1", port]] if kind == "jax.distributed" else [[]]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "benchmarks.cluster", "job", kind]
        pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        jobs = [subprocess.Popen([*command, *place], **pipes) for place in places]
        told, *_ = [json.loads(job.communicate(timeout=LIMIT)[0].splitlines()[-1]) for job in jobs]
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return told | {"processor": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}

    kinds, found = ("one process", "jax.distributed", "dask"), {}
    for _ in range(rounds):
        for kind in kinds:
            found.setdefault(kind, []).append(run(kind))
    medians = {
        kind: {name: round(float(np.median([each[name] for each in several])), 2) for name in several[0]}
        for kind, several in found.items()
    }
    return {"members": FEW, "rounds": rounds, "median_s": medians, "load_beside": os.getloadavg()[0]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--members", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        # Of this process and of all that it starts.
        os.environ |= {"JAX_COMPILATION_CACHE_DIR": folder, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path[1:]])
        print(json.dumps(globals()[arguments.case](arguments.members, arguments.rounds)))


if __name__ == "__main__":
    if sys.argv[1:2] == ["job"]:
        job(*sys.argv[2:])
    else:
        main()
