"""The command `linkax convert IN OUT`: a machine from a file, written as MJCF."""

import argparse

import linkax as lx
from linkax.cli.machine_scene import machine_scene
from linkax.cli.options import AtInterrupt, end_progress, loaded, progress

SUFFIX = ".xml"


def run_convert(arguments: argparse.Namespace, at_interrupt: AtInterrupt) -> int:
    """Load a machine, close its loops, write it with that start, and return the exit code."""
    if arguments.target.suffix != SUFFIX:
        raise ValueError(
            f"{str(arguments.target)!r} has suffix {arguments.target.suffix!r}; MJCF is written to {SUFFIX}"
        )
    scene = machine_scene(loaded(arguments), arguments.variant)
    mechanism = scene.mechanism(scene.settings(arguments.variant))
    progress("assembling", None)
    state = scene.initial(mechanism, {})
    lx.to_mjcf(mechanism, arguments.target, state=state, ignore=arguments.leave)
    end_progress()
    print(f"written: {arguments.target}")
    return 0
