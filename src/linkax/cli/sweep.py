"""The command `linkax sweep STUDY.py`, which evaluates the function of a file for all of its parameters."""

import argparse
import json
import os
import sys
import traceback
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np

import linkax as lx
from linkax.cli.options import AtInterrupt
from linkax.cli.report import finite
from linkax.files import writable_folder
from linkax.optional import needed
from linkax.xla.enumerations import code

NEEDED = {"function": "a function of one member's params", "params": "arrays with one entry for each member"}
OPTIONS = ("chunk", "memory", "difficulty")  # of `linkax.sweep`, that a study may give
MODULE = "linkax_study"  # the name of a study file while it runs


def run_sweep(arguments: argparse.Namespace, at_interrupt: AtInterrupt) -> int:
    """Run the study, keep its results in a store, print how its members ended, and return the exit code."""
    with _errors_in(arguments.study):
        study = _study(arguments.study)
    store = _store(arguments)
    at_interrupt(lambda: f"what was computed is in {store}, --resume goes on from there")
    options = getattr(study, "options", {})
    with _executor(arguments.scheduler, study) as executor:
        try:
            with _errors_in(arguments.study):
                found = lx.sweep(study.function, study.params, store=store, progress=True, executor=executor, **options)
        except RuntimeError as error:  # of workers
            raise lx.SimulationError(f"{error}; --resume goes on from {store}") from error
    if arguments.json:
        described = {
            "study": str(arguments.study),
            "members": len(found.reasons),
            "ended": found.count(),
            "remarked": int(np.count_nonzero(code(found.remarks))),
            "seconds_per_member": finite(found.seconds_per_member),
            "store": str(store),
        }
        print(json.dumps(described, allow_nan=False))
    else:
        print(f"{found}\nwritten: {store}")
    return 0


def _store(arguments) -> Path:
    """The folder of the store: a new one, or where asked one to go on from.

    **Raises:** `ValueError` for one that cannot be written to, or that holds something while nobody asked to go on.
    """
    store = Path("linkax-out", f"{arguments.study.stem}.zarr") if arguments.out is None else arguments.out
    writable_folder(store, "give another by --out")
    if not arguments.resume and any(not entry.name.startswith(".") for entry in store.iterdir()):
        raise ValueError(
            f"--out {str(store)!r} is not empty; go on with its sweep by --resume, or give another folder by --out"
        )
    return store


def _study(path: Path) -> ModuleType:
    """Run a study file, beside whose modules it may import.

    **Raises:** `ValueError` for a file that is none.
    """
    spec = spec_from_file_location(MODULE, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"study {str(path)!r} is no Python file; give the name of one, such as lengths.py")
    study = sys.modules[MODULE] = module_from_spec(spec)
    sys.path.insert(0, str(path.absolute().parent))
    spec.loader.exec_module(study)
    if lacking := [f"{name}, {what}" for name, what in NEEDED.items() if not hasattr(study, name)]:
        raise ValueError(f"study {str(path)!r} lacks {'; and '.join(lacking)}; define it in the file")
    options = getattr(study, "options", {})
    if not isinstance(options, dict) or not set(options) <= set(OPTIONS):
        known = ", ".join(map(repr, OPTIONS))
        raise ValueError(f"study {str(path)!r} has options {options!r}; give a dictionary with some of {known}")
    return study


@contextmanager
def _errors_in(path: Path) -> Iterator[None]:
    """Tell errors that arise in a study file with its line.

    **Raises:** `ValueError` for these.
    """
    file = os.path.abspath(path)
    try:
        yield
    except Exception as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        if isinstance(error, SyntaxError) and error.filename == file:
            lines = [error.lineno]
        if not lines:
            raise
        told = f"study {str(path)!r}, line {lines[-1]}: {type(error).__name__}: {error}; correct the file"
        raise ValueError(told) from error


@contextmanager
def _executor(scheduler: str | None, study: ModuleType) -> Iterator[Executor | None]:
    """An executor of the Dask scheduler at an address, whose workers need not have the study file; None for none.

    **Raises:** `ValueError` where none answers, or Dask is not installed.
    """
    if scheduler is None:
        yield None
        return
    need = f"--scheduler {scheduler!r} needs Dask"
    distributed, cloudpickle = (needed(name, need, "cluster", ValueError) for name in ("distributed", "cloudpickle"))
    cloudpickle.register_pickle_by_value(study)
    try:
        client = distributed.Client(scheduler)
    except Exception as error:  # of many kinds, by address
        remedy = "start one by `dask scheduler`, which tells its address, and workers by `dask worker ADDRESS`"
        raise ValueError(f"--scheduler {scheduler!r}: none answers: {error}; {remedy}") from error
    with client:
        told = f"{len(client.ncores())} workers so far; dashboard: {client.dashboard_link}"
        print(f"linkax: {told}", file=sys.stderr, flush=True)
        yield client.get_executor()
