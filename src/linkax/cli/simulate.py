"""The command `linkax simulate SCENE`, which writes the trajectory and the pictures of one run."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from linkax.cli.options import (
    AtInterrupt,
    RunOptions,
    at_interrupt_in,
    end_progress,
    output_folder,
    progress,
    steps_in_words,
    write_json,
)
from linkax.cli.progress_run import simulate_in_segments
from linkax.cli.report import states, summary, trajectory
from linkax.files import written_whole
from linkax.formulations.named import formulation
from linkax.simulation.explain.diagnosis import cause
from linkax.simulation.read.solution import Solution

INTERVALS = 1000
SHOWN = 5  # times of passages that are printed
PART = ("trajectory-interrupted.npz", "summary-interrupted.json")
WORTH_TELLING = 0.05  # distance from a singular configuration below which it is printed


def run_simulate(arguments: argparse.Namespace, at_interrupt: AtInterrupt) -> int:
    """Simulate, write the files, print a summary, and return the exit code."""
    asked, chosen = RunOptions(arguments), formulation(arguments.formulation)
    settings = asked.described | {"formulation": arguments.formulation}
    out = output_folder(arguments.out, asked.folder, settings, ("summary.json", PART[1]))
    at_interrupt_in(at_interrupt, out)
    run = simulate_in_segments(
        asked.mechanism,
        asked.initial(asked.mechanism),
        t1=asked.t1,
        accuracy=asked.accuracy,
        solver=asked.solver,
        formulation=chosen,
        step=arguments.dt,
        intervals=INTERVALS,
        report=progress,
        keep=lambda solution: at_interrupt_in(at_interrupt, out, keeping(out, settings, solution)),
    )
    progress("reading results", None)
    described = settings | summary(run, asked.points)
    arrays: dict[str, Any] = {**trajectory(run.solution, asked.points)}
    with written_whole(out / "trajectory.npz") as path:
        np.savez(path, **arrays)
    write_json(out / "summary.json", described)
    files = [out / "trajectory.npz", out / "summary.json"]
    at_interrupt_in(at_interrupt, out, lambda: f"the results are in {out}")
    for name in PART:
        (out / name).unlink(missing_ok=True)
    if not arguments.no_plots:
        progress("drawing", None)
        from linkax.plot.pictures import write_pictures  # matplotlib takes its time

        files += write_pictures(run.solution, asked.points, out)
    end_progress()
    print(json.dumps(described, allow_nan=False) if arguments.json else _for_people(described, files))
    if described["result"] == "successful":
        return 0
    stopped = f"the run stopped at t = {described['t_end']:.6g} s: {described['message']}{cause(run.solution)}"
    print(f"linkax: {stopped}", file=sys.stderr)
    return 1


def keeping(out: Path, settings: dict[str, Any], solution: Solution) -> Callable[[], str]:
    """A function that writes the motion of an interrupted run, to other files than a whole one, and tells where."""
    reached: dict[str, Any] = {**states(solution)}
    t_end = float(solution.t_end)

    def keep():
        with written_whole(out / PART[0]) as path:
            np.savez(path, **reached)
        write_json(out / PART[1], settings | {"result": "interrupted", "t_end": t_end})
        return f"the motion until t = {t_end:.6g} s is in {out / PART[0]}"

    return keep


def _for_people(run, files) -> str:
    """The summary in words."""
    final = [f"  {name:<22}{', '.join(f'{part:.9g}' for part in place)} m" for name, place in run["final"].items()]
    lines = [
        f"{run['scene']} {run['variant']}, {run['t1']:g} s, {run['formulation']}, {run['solver']}, "
        + steps_in_words(run),
        f"  result                {run['result']}",
        f"  steps                 {run['steps']} ({run['rejected_steps']} of them rejected)",
        f"  compile time          {run['compile_s']:.2f} s",
        f"  run time              {1e3 * run['run_s']:.1f} ms",
        f"  position violation    {run['position_violation']:.1e} of the loop's length",
        f"  velocity violation    {run['velocity_violation']:.1e} of the largest speed",
        f"  acceleration violation {run['acceleration_violation']:.1e} of the largest acceleration",
        f"  energy unaccounted for {run['energy_unaccounted']:.1e} of the largest kinetic energy",
        *(f"  work                  {done:.6g} J of {name}" for name, done in run["work"].items() if done),
        f"  independent loop rows {run['rank_min']} to {run['rank_max']}",
        *_of_singular_configurations(run),
        *final,
        "written: " + ", ".join(map(str, files)),
    ]
    return "\n".join(lines)


def _of_singular_configurations(run):
    """Lines on singular configurations, where the run came near one."""
    lines = []
    if run["passages"]:
        count, times = len(run["passages"]), ", ".join(f"{time:.6g}" for time in run["passages"][:SHOWN])
        more = "" if count <= SHOWN else ", ..."
        lines.append(f"  singular passages     {count}, at {times}{more} s")
    elif run["singularity_distance"] < WORTH_TELLING:
        lines.append(f"  singular configuration as near as {run['singularity_distance']:.1e} (1 is far)")
    if lines and run["digits_lost"] is not None:
        lines.append(f"  digits lost to that   {run['digits_lost']:.1f} of 16")
    return lines
