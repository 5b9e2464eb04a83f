"""Run the commands."""

import argparse
import sys
import warnings
from collections.abc import Callable

import linkax as lx
from linkax.cli.compare import run_compare
from linkax.cli.simulate import run_simulate

COMMANDS = {"simulate": run_simulate, "compare": run_compare}


def run(arguments: argparse.Namespace, at_interrupt: Callable[[Callable[[], str]], None]) -> int:
    """Run the command of a command line that was read.

    **Arguments:** `at_interrupt`: is called with what to do at Ctrl-C, which returns what was kept, in words.

    **Returns:** the exit code: 0, or 1 for a run that failed.

    **Raises:** `ValueError` or `OSError` for bad input.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"linkax: {message}", file=sys.stderr)
            return COMMANDS[arguments.command](arguments, at_interrupt)
    except lx.SimulationError as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
