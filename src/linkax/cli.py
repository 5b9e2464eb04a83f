"""The command line: `linkax list`, `linkax simulate SCENE`."""

import argparse
import json
import math
import sys
from pathlib import Path

import diffrax
import numpy as np

import linkax as lx
from linkax.scenes import SCENES, scene
from linkax.simulation.files import written_whole
from linkax.simulation.report import summary, trajectory
from linkax.simulation.segments import simulate_in_segments

PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}
SOLVERS = {name.lower(): getattr(diffrax, name) for name in ("Tsit5", "Dopri5", "Dopri8")}
INTERVALS = 1000
SHOWN = 5
WORTH_TELLING = 0.05  # distance from a singular configuration


class _Parser(argparse.ArgumentParser):
    """One line on what is wrong, and no dump of the usage."""

    def error(self, message):
        raise ValueError(f"{message}; see `{self.prog} --help`")


def main(argv=None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a run that failed, 2 for bad input."""
    try:
        arguments = _parser().parse_args(argv)
        return arguments.command(arguments)
    except BrokenPipeError:  # whoever read the output, such as `head`, has had enough
        sys.stderr.close()
        return 0
    except (ValueError, OSError) as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _parser():
    parser = _Parser(prog="linkax", description="Simulate mechanisms with closed loops.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the scenes, their variants and parameters")
    listing.set_defaults(command=_list)
    run = commands.add_parser("simulate", help="simulate a scene and write its trajectory and pictures")
    run.set_defaults(command=_simulate)
    run.add_argument("scene", metavar="SCENE", help="a scene of `linkax list`")
    run.add_argument("--variant", help="a variant of the scene (default: its first)")
    run.add_argument("--t1", type=_positive, metavar="S", help="end time [s]")
    run.add_argument("--set", dest="changes", action="append", default=[], metavar="NAME=VALUE", help="a parameter")
    run.add_argument("--preset", default="balanced", type=_one_of(PRESETS), help=f"{', '.join(PRESETS)}")
    run.add_argument("--rtol", type=_positive, metavar="X", help="tolerance of a step, instead of the preset's")
    run.add_argument("--solver", default="dopri8", type=_one_of(SOLVERS), help=f"{', '.join(SOLVERS)}")
    run.add_argument("--out", type=Path, metavar="DIR", help="folder for the files (default: linkax-out/SCENE)")
    run.add_argument("--no-plots", action="store_true", help="write no pictures")
    run.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    return parser


def _positive(text):
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive, finite number")
    return number


def _one_of(choices):
    def read(text):
        if text.lower() not in choices:
            raise argparse.ArgumentTypeError(f"unknown {text!r}; known: {', '.join(choices)}")
        return text.lower()

    return read


def _list(arguments):
    for found in SCENES.values():
        print(f"{found.name}: {found.summary}")
        for name, variant in found.variants.items():
            default = " (default)" if name == found.default_variant else ""
            print(f"    variant {name}{default}: {variant.summary}")
        for name, default in found.parameters.items():
            print(f"    {name} = {default:g}: {found.meanings[name]}")
    return 0


def _changes(assignments):
    changes = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ValueError(f"--set {assignment!r} has no '='; write --set NAME=VALUE")
        changes[name.strip()] = value.strip()
    return changes


def _progress(phase, fraction):
    """Tell a person what happens now; on one line where the terminal allows it."""
    text = phase if fraction is None else f"{phase} {100 * fraction:.0f} %"
    if sys.stderr.isatty():
        print(f"\r{text:<60}", end="", file=sys.stderr, flush=True)
    elif fraction is None or fraction == 0.0:
        print(f"{phase} ...", file=sys.stderr, flush=True)


def _simulate(arguments):
    chosen = scene(arguments.scene)
    variant = chosen.default_variant if arguments.variant is None else arguments.variant
    parameters = chosen.settings(variant, _changes(arguments.changes))
    t1 = chosen.duration(variant) if arguments.t1 is None else arguments.t1
    accuracy = PRESETS[arguments.preset] if arguments.rtol is None else lx.Accuracy(rtol=arguments.rtol)
    mechanism, points = chosen.mechanism(parameters), chosen.points(parameters)
    out = Path("linkax-out") / chosen.name if arguments.out is None else arguments.out
    out.mkdir(parents=True, exist_ok=True)

    _progress("assembling", None)
    state = chosen.initial(mechanism, parameters)
    run = simulate_in_segments(
        mechanism,
        state,
        t1=t1,
        accuracy=accuracy,
        solver=SOLVERS[arguments.solver](),
        intervals=INTERVALS,
        report=_progress,
    )
    _progress("reading results", None)
    found = {
        "scene": chosen.name,
        "variant": variant,
        "t1": t1,
        "preset": arguments.preset,
        "rtol": float(accuracy.rtol),
        "solver": arguments.solver,
        "parameters": {name: float(entry) for name, entry in parameters.items()},
    } | summary(run, points)
    with written_whole(out / "trajectory.npz") as path:
        np.savez(path, **trajectory(run.solution, points))
    with written_whole(out / "summary.json") as path:
        path.write_text(json.dumps(found, indent=2, allow_nan=False) + "\n")
    files = [out / "trajectory.npz", out / "summary.json"]
    if not arguments.no_plots:
        _progress("drawing", None)
        from linkax.plotting.pictures import write_pictures  # matplotlib takes its time

        files += write_pictures(run.solution, points, out)
    if sys.stderr.isatty():
        print("\r" + 60 * " " + "\r", end="", file=sys.stderr)
    print(json.dumps(found, allow_nan=False) if arguments.json else _for_people(found, files))
    if found["result"] == "successful":
        return 0
    print(f"linkax: the run stopped at t = {found['t_end']:.6g} s: {found['message']}", file=sys.stderr)
    return 1


def _for_people(found, files):
    final = [f"  {name:<22}{', '.join(f'{part:.9g}' for part in place)} m" for name, place in found["final"].items()]
    lines = [
        f"{found['scene']} {found['variant']}, {found['t1']:g} s, {found['preset']} (rtol {found['rtol']:g})",
        f"  result                {found['result']}",
        f"  steps                 {found['steps']} ({found['rejected_steps']} of them rejected)",
        f"  compile time          {found['compile_s']:.2f} s",
        f"  run time              {1e3 * found['run_s']:.1f} ms",
        f"  position violation    {found['position_violation']:.1e} of the loop's length",
        f"  velocity violation    {found['velocity_violation']:.1e} of the largest speed",
        f"  acceleration violation {found['acceleration_violation']:.1e} of the largest acceleration",
        f"  energy error          {found['energy_error']:.1e} of the largest kinetic energy",
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
    if lines:
        lines.append(f"  digits lost to that   {found['digits_lost']:.1f} of 16")
    return lines
