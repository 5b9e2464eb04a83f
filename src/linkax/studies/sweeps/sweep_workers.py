"""Compile and run the function of a sweep in processes that an engine of tasks starts.

What is sent is the function itself, which each worker compiles: `jax.export` cannot write linkax's kernels.
"""

import importlib
import os
import pickle
import platform
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import suppress
from importlib.metadata import version
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from linkax.studies.sweeps.sweep_program import SweepProgram
from linkax.xla.program_cache import cache_programs

MOST_PROGRAMS = 8  # that a worker keeps

_compiling = threading.Lock()
_programs: dict[Any, tuple[SweepProgram, threading.Semaphore]] = {}


class Work(NamedTuple):
    """What a worker needs to compile a program.

    - `pickled`: the function and the shapes of one member's params.
    - `setup`: versions and settings that have to be the same here and there.
    - `folder`: where the sender keeps compiled programs, None where it does not.
    """

    pickled: bytes
    setup: dict[str, Any]
    folder: str | None

    @staticmethod
    def of(function: Callable, one: Any) -> "Work":
        """Pickle a function, by cloudpickle where that is installed.

        **Raises:** `ValueError` for one that cannot be pickled.
        """
        return Work(_pickled(function, one), _setup(), _programs_folder())


class Refusal(NamedTuple):
    """Why a worker cannot run what it got.

    It is returned, since engines wrap what is raised in errors of their own, and may try it again.
    """

    why: str


def plan_sweep(work: Work, chunk: int, memory: int | float) -> tuple[int, str] | Refusal:
    """In a worker, compile for a chunk in no more than `memory`.

    **Returns:** the size of the chunk that fits, and the program's fingerprint.
    """
    if refusal := _refusal(work):
        return refusal
    with _compiling:
        found = _compiled(work, chunk, memory)
        if isinstance(found, Refusal):
            return found
        program, _ = _programs[work.pickled, found[0].size, float("inf")] = found
        return program.size, program.fingerprint


def sweep_chunk(work: Work, size: int, fingerprint: str, leaves: list[np.ndarray]) -> list[np.ndarray] | Refusal:
    """In a worker, compute a chunk of `size` members, on its first device.

    **Arguments:** `leaves`: the params' arrays.

    **Returns:** [reasons, *arrays of the output].
    """
    if refusal := _refusal(work):
        return refusal
    with _compiling:
        found = _compiled(work, size, float("inf"))
    if isinstance(found, Refusal):
        return found
    program, free = found
    if program.fingerprint != fingerprint:
        return Refusal(
            "it makes another program of the function than the first worker did; give all workers the same versions of "
            "the modules that the function imports"
        )
    one = pickle.loads(work.pickled)[1]
    with free:
        return as_leaves(program.run(jax.tree.unflatten(jax.tree.structure(one), leaves)))


def as_leaves(results: tuple[Any, Any]) -> list[np.ndarray]:
    """[reasons, *arrays of the output] of (output, reasons)."""
    output, reasons = results
    return [np.asarray(leaf) for leaf in (reasons, *jax.tree.leaves(output))]


def check_executor(executor: Any, devices: Any) -> None:
    """Check that an executor can run sweeps.

    **Raises:** `ValueError` where it cannot.
    """
    known: tuple[type, ...] = (Executor,)
    if "submitit" in sys.modules:  # whose executors are none of Python's
        known += (sys.modules["submitit"].Executor,)
    if not isinstance(executor, known):
        dasks = "; of a Dask client give client.get_executor()" if hasattr(executor, "get_executor") else ""
        raise ValueError(
            f"executor is {executor!r}; give a concurrent.futures.Executor, or one of submitit's, or None{dasks}"
        )
    if devices is not None:
        raise ValueError(f"devices are {devices!r}, and so is an executor given; remove one, as workers use their own")
    if jax.process_count() > 1:
        raise ValueError(
            f"executor is {executor!r} in a jax.distributed job of {jax.process_count()} processes; give none, as "
            "these share the members already"
        )
    context = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context is not None and context.get_start_method() == "fork":
        raise ValueError(
            f"executor is {executor!r} that forks this process, which stops for ever as JAX runs threads; give "
            'mp_context=multiprocessing.get_context("spawn")'
        )


def _pickled(function, one) -> bytes:
    try:
        dumps = importlib.import_module("cloudpickle").dumps
        remedy = "take it out of the function"
    except ImportError:
        dumps = pickle.dumps
        remedy = 'define the function in a module that workers can import, or pip install "linkax[cluster]"'
    try:
        return dumps((function, one))
    except Exception as error:  # of whatever is in it
        raise ValueError(f"function {function!r} cannot be sent to workers: {error}; {remedy}") from error


def _setup() -> dict[str, Any]:
    """Versions and settings that have to be the same in all processes."""
    python = ".".join(platform.python_version_tuple()[:2])
    versions = {name: version(name) for name in ("linkax", "jax", "jaxlib")}
    return {"python": python, **versions, "jax_enable_x64": cast(Any, jax.config).jax_enable_x64}


def _programs_folder() -> str | None:
    """Where this process keeps compiled programs."""
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    if not (folder and config.jax_enable_compilation_cache):
        return None
    return folder if "://" in folder else os.path.abspath(folder)


def _refusal(work) -> Refusal | None:
    """Why this process cannot run what it got, if so."""
    own = _setup()
    differ = [
        f"{name} {own.get(name)} instead of {value}" for name, value in work.setup.items() if own.get(name) != value
    ]
    return Refusal(f"it has {', '.join(differ)}; give workers what the sender has") if differ else None


def _compiled(work, chunk, memory) -> tuple[SweepProgram, threading.Semaphore] | Refusal:
    """The program, and how many threads may still run it."""
    asked = work.pickled, chunk, memory
    if asked in _programs:
        return _programs[asked]
    if work.folder and _programs_folder() is None:
        with suppress(ValueError):  # a folder that this machine does not have
            cache_programs(work.folder)
    try:
        function, one = pickle.loads(work.pickled)
    except Exception as error:
        return Refusal(
            f"it cannot read the function: {type(error).__name__}: {error}; workers must be able to import what the "
            "function imports"
        )
    program = SweepProgram.compiled(function, one, chunk, memory, jax.local_devices()[:1])
    while len(_programs) >= MOST_PROGRAMS:
        del _programs[next(iter(_programs))]
    found = _programs[asked] = program, threading.Semaphore(program.workers)
    return found
