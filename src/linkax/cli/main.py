"""Run the commands."""

import argparse
import sys
import warnings
from collections.abc import Callable
from typing import Any, cast

import jax

import linkax as lx
from linkax.cli.compare import run_compare
from linkax.cli.convert import run_convert
from linkax.cli.inspect import run_inspect
from linkax.cli.simulate import run_simulate
from linkax.cli.sweep import run_sweep
from linkax.xla.users_line import warn

COMMANDS = {
    "simulate": run_simulate,
    "inspect": run_inspect,
    "convert": run_convert,
    "compare": run_compare,
    "sweep": run_sweep,
}


def run(arguments: argparse.Namespace, at_interrupt: Callable[[Callable[[], str]], None]) -> int:
    """Run the command of a command line that was read.

    **Arguments:** `at_interrupt`: is called with what to do at Ctrl-C, which returns what was kept, in words.

    **Returns:** the exit code: 0, or 1 for a run that failed.

    **Raises:** `ValueError` or `OSError` for bad input.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"linkax: {message}", file=sys.stderr)
            _cache_programs()
            return COMMANDS[arguments.command](arguments, at_interrupt)
    except lx.SimulationError as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 1


def _cache_programs():
    """Keep compiled programs for the next command, unless the environment says otherwise."""
    if cast(Any, jax.config).jax_enable_compilation_cache:
        try:
            lx.cache_programs()
        except ValueError as error:
            warn(f"{error} by JAX_COMPILATION_CACHE_DIR")
