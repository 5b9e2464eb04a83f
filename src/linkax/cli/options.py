"""What the commands share: options, output folders, and a line that shows the progress."""

import argparse
import itertools
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, SupportsFloat, cast

import diffrax

import linkax as lx
from linkax.files import remove_unfinished, writable_folder, written_whole
from linkax.scenes import Scene, scene
from linkax.simulation.integrate.default_solver import default_solver
from linkax.simulation.integrate.rosenbrock import Rodas5P
from linkax.simulation.integrate.runge_kutta import RungeKutta4
from linkax.xla.waiting import end_line, is_watched, tell

OF_DIFFRAX = ("Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno5")
SOLVERS = {name.lower(): getattr(diffrax, name) for name in OF_DIFFRAX} | {
    "rodas5p": Rodas5P,
    "rk4": RungeKutta4,
}
AtInterrupt = Callable[[Callable[[], str]], None]


class RunOptions:
    """The run that a command line asks for.

    - `scene`, `variant`, `parameters`: see `linkax.scenes.scene.Scene`.
    - `t1`: end time [s]. `accuracy`, `solver`: see `linkax.simulate`.
    - `points`: {name: (body, frame of the body or None for its centre of mass)}.
    - `described`: all of it as JSON holds it.
    """

    scene: Scene
    variant: str
    parameters: dict[str, object]
    t1: float
    accuracy: lx.Accuracy
    mechanism: lx.Mechanism
    solver: diffrax.AbstractSolver
    points: dict[str, tuple[str, str | None]]
    described: dict[str, Any]

    def __init__(self, arguments: argparse.Namespace) -> None:
        if arguments.solver == "rk4" and arguments.dt is None:
            raise ValueError("--solver rk4 estimates no error; give its steps by --dt")
        self.scene = scene(arguments.scene)
        self.variant = self.scene.default_variant if arguments.variant is None else arguments.variant
        self.parameters = self.scene.settings(self.variant, _changes(arguments.changes))
        self.t1 = self.scene.duration(self.variant) if arguments.t1 is None else arguments.t1
        self.accuracy = (
            getattr(lx, arguments.preset.upper()) if arguments.rtol is None else lx.Accuracy(rtol=arguments.rtol)
        )
        self.mechanism = self.scene.mechanism(self.parameters)
        if arguments.solver is None:
            self.solver = default_solver(self.mechanism, None if arguments.dt else self.accuracy.rtol, self.t1)
        else:
            self.solver = SOLVERS[arguments.solver]()
        self.points = self.scene.points(self.parameters)
        self.described = {
            "scene": self.scene.name,
            "variant": self.variant,
            "t1": self.t1,
            "preset": arguments.preset if arguments.rtol is None and arguments.dt is None else None,
            "rtol": float(self.accuracy.rtol) if arguments.dt is None else None,
            "step": arguments.dt,
            "solver": next(name for name, kind in SOLVERS.items() if type(self.solver) is kind),
            "parameters": {name: float(cast(SupportsFloat, entry)) for name, entry in self.parameters.items()},
        }

    def initial(self, mechanism: lx.Mechanism) -> lx.State:
        """Assemble the initial state.

        **Raises:** `AssemblyError` with what can be done from the command line.
        """
        progress("assembling", None)
        try:
            return self.scene.initial(mechanism, self.parameters)
        except lx.AssemblyError as error:
            what, _, _ = str(error).rpartition("; ")
            given = ", ".join(f"{name}={self.parameters[name]:g}" for name in self.scene.parameters)
            remedy = f"change some of the parameters of scene {self.scene.name!r} by --set NAME=VALUE: {given}"
            raise lx.AssemblyError(f"{what}; {remedy}") from error


def output_folder(asked: Path | None, prefix: str, settings: dict[str, Any], files: Iterable[str]) -> Path:
    """The folder asked for, or one under linkax-out without results of other settings; checked before the run.

    **Arguments:** `prefix`: of the default folder's name. `files`: JSON files with the settings of a folder's results.

    **Raises:** `ValueError` for a folder that cannot be written to, or holds results of other settings.
    """
    folder = _free_folder(prefix, settings, files) if asked is None else asked
    writable_folder(folder, "give another by --out")
    other = _other_setting(folder, settings, files)
    if other is None:
        return folder
    raise ValueError(
        f"--out {str(folder)!r} holds results of another run, {other}; give another folder, or remove this one"
    )


def _free_folder(prefix, settings, files):
    """linkax-out/SCENE, with -VARIANT where that is not the default, and -2, ... where others hold other results."""
    variant = settings["variant"]
    name = prefix + ("" if variant == scene(settings["scene"]).default_variant else f"-{variant}")
    names = itertools.chain([name], (f"{name}-{count}" for count in itertools.count(2)))
    folders = map(Path("linkax-out").joinpath, names)
    return next(folder for folder in folders if _other_setting(folder, settings, files) is None)


def _other_setting(folder, settings, files) -> str | None:
    """The first setting in which the results in a folder differ, in words, or None."""
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


def write_json(path: Path, described: dict[str, Any]) -> None:
    """Write one JSON object to a file."""
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(described, indent=2, allow_nan=False) + "\n")


def at_interrupt_in(at_interrupt: AtInterrupt, folder: Path, keep: Callable[[], str] = lambda: "") -> None:
    """At Ctrl-C, remove unfinished files from a folder, and call `keep`, see `linkax.cli.main.run`."""

    def leave():
        remove_unfinished(folder)
        return keep()

    at_interrupt(leave)


def _changes(assignments) -> dict[str, str]:
    """{name: value} of NAME=VALUE."""
    changes = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals:
            raise ValueError(f"--set {assignment!r} has no '='; write --set NAME=VALUE")
        changes[name.strip()] = value.strip()
    return changes


def progress(phase: str, fraction: float | None) -> None:
    """Show the current phase, and the fraction done where it is known; in a terminal on one line."""
    if is_watched():
        tell(phase if fraction is None else f"{phase} {100 * fraction:.0f} %")
    elif fraction is None or fraction == 0.0:
        print(f"{phase} ...", file=sys.stderr, flush=True)


def end_progress() -> None:
    """Clear the line that shows the progress."""
    if is_watched():
        end_line()


def steps_in_words(described: dict[str, Any]) -> str:
    """How a run steps, in words."""
    if described["step"] is not None:
        return f"fixed steps of {described['step']:g} s"
    preset = "" if described["preset"] is None else f"{described['preset']}, "
    return f"{preset}rtol {described['rtol']:g}"
