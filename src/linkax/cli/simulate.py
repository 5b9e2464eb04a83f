"""`linkax simulate SCENE`: one run, its trajectory and its pictures."""

import json
import sys

import numpy as np

from linkax.cli.options import (
    RunOptions,
    add_run_options,
    at_interrupt_in,
    end_progress,
    output_folder,
    progress,
    steps_in_words,
    write_json,
)
from linkax.cli.progress_run import simulate_in_segments
from linkax.cli.report import states, summary, trajectory
from linkax.formulations.named import TANGENT_SPACE, formulation
from linkax.simulation.explain.diagnosis import cause
from linkax.studies.files import written_whole

INTERVALS = 1000
SHOWN = 5
PART = ("trajectory-interrupted.npz", "summary-interrupted.json")
WORTH_TELLING = 0.05  # distance from a singular configuration


def add_command(commands):
    """Add the command to the parser."""
    parser = commands.add_parser("simulate", help="simulate a scene and write its trajectory and pictures")
    parser.set_defaults(command=_simulate)
    add_run_options(parser)
    parser.add_argument("--formulation", default=TANGENT_SPACE, metavar="NAME", help="see `linkax compare --help`")


def _simulate(arguments):
    asked, chosen = RunOptions(arguments), formulation(arguments.formulation)
    settings = asked.display_name | {"formulation": arguments.formulation}
    out = output_folder(arguments.out, asked.scene.name, settings, ("summary.json", PART[1]))
    at_interrupt_in(out)
    state = asked.initial(asked.mechanism)
    run = simulate_in_segments(
        asked.mechanism,
        state,
        t1=asked.t1,
        accuracy=asked.accuracy,
        solver=asked.solver,
        formulation=chosen,
        step=arguments.dt,
        intervals=INTERVALS,
        report=progress,
        keep=lambda solution: at_interrupt_in(out, keeping(out, settings, solution)),
    )
    progress("reading results", None)
    found = settings | summary(run, asked.points)
    with written_whole(out / "trajectory.npz") as path:
        np.savez(path, **trajectory(run.solution, asked.points))
    write_json(out / "summary.json", found)
    files = [out / "trajectory.npz", out / "summary.json"]
    at_interrupt_in(out, lambda: f"the results are in {out}")
    for name in PART:
        (out / name).unlink(missing_ok=True)
    if not arguments.no_plots:
        progress("drawing", None)
        from linkax.plotting.pictures import write_pictures  # matplotlib takes its time

        files += write_pictures(run.solution, asked.points, out)
    end_progress()
    print(json.dumps(found, allow_nan=False) if arguments.json else _for_people(found, files))
    if found["result"] == "successful":
        return 0
    stopped = f"the run stopped at t = {found['t_end']:.6g} s: {found['message']}{cause(run.solution)}"
    print(f"linkax: {stopped}", file=sys.stderr)
    return 1


def keeping(out, settings, solution):
    """What writes the motion of an interrupted run, apart from the results of a whole one."""
    reached, t_end = states(solution), float(solution.t_end)

    def keep():
        with written_whole(out / PART[0]) as path:
            np.savez(path, **reached)
        write_json(out / PART[1], settings | {"result": "interrupted", "t_end": t_end})
        return f"the motion until t = {t_end:.6g} s is in {out / PART[0]}"

    return keep


def _for_people(found, files):
    final = [f"  {name:<22}{', '.join(f'{part:.9g}' for part in place)} m" for name, place in found["final"].items()]
    lines = [
        f"{found['scene']} {found['variant']}, {found['t1']:g} s, {found['formulation']}, {found['solver']}, "
        + steps_in_words(found),
        f"  result                {found['result']}",
        f"  steps                 {found['steps']} ({found['rejected_steps']} of them rejected)",
        f"  compile time          {found['compile_s']:.2f} s",
        f"  run time              {1e3 * found['run_s']:.1f} ms{'' if found['optimised'] else ', not optimised'}",
        f"  position violation    {found['position_violation']:.1e} of the loop's length",
        f"  velocity violation    {found['velocity_violation']:.1e} of the largest speed",
        f"  acceleration violation {found['acceleration_violation']:.1e} of the largest acceleration",
        f"  energy change         {found['energy_error']:.1e} of the largest kinetic energy",
        f"  independent loop rows {found['rank_min']} to {found['rank_max']}",
        *_of_singular_configurations(found),
        *final,
        "written: " + ", ".join(map(str, files)),
    ]
    return "\n".join(lines)


def _of_singular_configurations(found):
    """Lines on singular configurations, where the run came close to one."""
    lines = []
    if found["passages"]:
        count, times = len(found["passages"]), ", ".join(f"{time:.6g}" for time in found["passages"][:SHOWN])
        more = "" if count <= SHOWN else ", ..."
        lines.append(f"  singular passages     {count}, at {times}{more} s")
    elif found["singularity_distance"] < WORTH_TELLING:
        lines.append(f"  singular configuration as near as {found['singularity_distance']:.1e} (1 is far)")
    if lines and found["digits_lost"] is not None:
        lines.append(f"  digits lost to that   {found['digits_lost']:.1f} of 16")
    return lines
