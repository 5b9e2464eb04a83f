"""What the commands share: options, how they are read, and a line on what happens now."""

import argparse
import itertools
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import diffrax

import linkax as lx
from linkax.scenes import scene
from linkax.simulation.integrate.default_solver import default_solver
from linkax.simulation.integrate.runge_kutta import RungeKutta4
from linkax.studies.files import remove_unfinished, writable_folder, written_whole
from linkax_command import at_interrupt

PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}
OF_DIFFRAX = ("Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno5")
SOLVERS = {name.lower(): getattr(diffrax, name) for name in OF_DIFFRAX} | {"rk4": RungeKutta4}


def add_run_options(parser):
    """The scene, its parameters, and how it is integrated."""
    parser.add_argument("scene", metavar="SCENE", help="a scene of `linkax list`")
    parser.add_argument("--variant", help="a variant of the scene (default: its first)")
    parser.add_argument("--t1", type=positive, metavar="S", help="end time [s]")
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="NAME=VALUE", help="a parameter")
    parser.add_argument("--preset", default="balanced", type=one_of(PRESETS), help=f"{', '.join(PRESETS)}")
    parser.add_argument("--rtol", type=positive, metavar="X", help="tolerance of a step, instead of the preset's")
    solvers = f"{', '.join(SOLVERS)} (default: dopri8, or kvaerno5 for damped beams)"
    parser.add_argument("--solver", type=one_of(SOLVERS), help=solvers)
    parser.add_argument("--dt", type=positive, metavar="S", help="fixed steps [s], instead of ones that adapt")
    parser.add_argument("--out", type=_path, metavar="DIR", help="folder for the files (default: under linkax-out)")
    parser.add_argument("--no-plots", action="store_true", help="write no pictures")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


class RunOptions:
    """What the options of `add_run_options` ask for."""

    def __init__(self, arguments):
        if arguments.solver == "rk4" and arguments.dt is None:
            raise ValueError("--solver rk4 estimates no error; give its steps by --dt")
        self.scene = scene(arguments.scene)
        self.variant = self.scene.default_variant if arguments.variant is None else arguments.variant
        self.parameters = self.scene.settings(self.variant, _changes(arguments.changes))
        self.t1 = self.scene.duration(self.variant) if arguments.t1 is None else arguments.t1
        self.accuracy = PRESETS[arguments.preset] if arguments.rtol is None else lx.Accuracy(rtol=arguments.rtol)
        self.mechanism = self.scene.mechanism(self.parameters)
        asked = arguments.solver
        if asked is None:
            self.solver = default_solver(self.mechanism, None if arguments.dt else self.accuracy.rtol, self.t1)
        else:
            self.solver = SOLVERS[asked]()
        self.points = self.scene.points(self.parameters)
        self.display_name = {
            "scene": self.scene.name,
            "variant": self.variant,
            "t1": self.t1,
            "preset": arguments.preset if arguments.rtol is None and arguments.dt is None else None,
            "rtol": float(self.accuracy.rtol) if arguments.dt is None else None,
            "step": arguments.dt,
            "solver": next(name for name, kind in SOLVERS.items() if type(self.solver) is kind),
            "parameters": {name: float(entry) for name, entry in self.parameters.items()},
        }

    def initial(self, mechanism):
        """The start, assembled."""
        progress("assembling", None)
        return self.scene.initial(mechanism, self.parameters)


def positive(text):
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive, finite number")
    return number


def one_of(choices):
    def read(text):
        if text.lower() not in choices:
            raise argparse.ArgumentTypeError(f"unknown {text!r}; known: {', '.join(choices)}")
        return text.lower()

    return read


def _path(text):
    if not text:
        raise argparse.ArgumentTypeError("'' is no folder; give its name")
    return Path(text)


def output_folder(asked: Path | None, prefix: str, settings: dict, files) -> Path:
    """The folder asked for, or one under linkax-out that holds no results of other settings; tried before the run.

    `files`: of JSON, that tell the settings of the results in a folder.
    """
    found = _free_folder(prefix, settings, files) if asked is None else asked
    writable_folder(found, "give another by --out")
    other = _other_setting(found, settings, files)
    if other is None:
        return found
    raise ValueError(
        f"--out {str(found)!r} holds results of another run, {other}; give another folder, or remove this one"
    )


def _free_folder(prefix, settings, files):
    """linkax-out/SCENE, -VARIANT where that is not the default, or the first of SCENE-2, ... without other results."""
    variant = settings["variant"]
    name = prefix + ("" if variant == scene(settings["scene"]).default_variant else f"-{variant}")
    names = itertools.chain([name], (f"{name}-{count}" for count in itertools.count(2)))
    folders = map(Path("linkax-out").joinpath, names)
    return next(folder for folder in folders if _other_setting(folder, settings, files) is None)


def _other_setting(folder, settings, files) -> str | None:
    """How the results in a folder differ in what was asked for."""
    for path in map(folder.joinpath, files):
        try:
            kept = dict(json.loads(path.read_text()))
        except OSError:
            continue
        except (TypeError, ValueError):
            return f"and {path.name} cannot be read"
        for name, value in settings.items():
            if kept.get(name) != value:
                return f"with {name} {kept.get(name)!r} instead of {value!r}"
    return None


def write_json(path: Path, described):
    """Write a file of one JSON object."""
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(described, indent=2, allow_nan=False) + "\n")


def at_interrupt_in(folder: Path, keep: Callable[[], str] = lambda: ""):
    """Have Ctrl-C leave whole files alone in a folder, and `keep` what has been computed, see `at_interrupt`."""

    def leave():
        remove_unfinished(folder)
        return keep()

    at_interrupt(leave)


def _changes(assignments):
    changes = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ValueError(f"--set {assignment!r} has no '='; write --set NAME=VALUE")
        changes[name.strip()] = value.strip()
    return changes


def progress(phase, fraction):
    """Tell a person what happens now; on one line where the terminal allows it."""
    text = phase if fraction is None else f"{phase} {100 * fraction:.0f} %"
    if sys.stderr.isatty():
        print(f"\r{text:<60}", end="", file=sys.stderr, flush=True)
    elif fraction is None or fraction == 0.0:
        print(f"{phase} ...", file=sys.stderr, flush=True)


def end_progress():
    """Clear the line on what happens now."""
    if sys.stderr.isatty():
        print("\r" + 60 * " " + "\r", end="", file=sys.stderr)


def steps_in_words(described) -> str:
    """How the run steps, for people."""
    if described["step"] is not None:
        return f"fixed steps of {described['step']:g} s"
    preset = "" if described["preset"] is None else f"{described['preset']}, "
    return f"{preset}rtol {described['rtol']:g}"
