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
from linkax.cli.machine_scene import machine_scene
from linkax.files import remove_unfinished, writable_folder, written_whole
from linkax.model.numbers import number_in
from linkax.scenes import SCENES, Scene, scene
from linkax.simulation.integrate.default_solver import default_solver
from linkax.simulation.integrate.rosenbrock import Rodas5P
from linkax.simulation.integrate.runge_kutta import RungeKutta4
from linkax.xla.waiting import end_line, is_watched, tell

OF_DIFFRAX = ("Tsit5", "Dopri5", "Dopri8", "Kvaerno3", "Kvaerno5")
SOLVERS = {name.lower(): getattr(diffrax, name) for name in OF_DIFFRAX} | {
    "rodas5p": Rodas5P,
    "rk4": RungeKutta4,
}
MOST_NAMES = 12  # of parameters in a message
AtInterrupt = Callable[[Callable[[], str]], None]


class RunOptions:
    """The run that a command line asks for.

    - `scene`, `variant`, `parameters`: see `linkax.scenes.scene.Scene`.
    - `is_of_file`: whether it is that of a file of a machine.
    - `t1`: end time [s]. `accuracy`, `solver`: see `linkax.simulate`.
    - `points`: {name: (body, frame of the body or None for its centre of mass)}.
    - `described`: all of it as JSON holds it.
    """

    scene: Scene
    is_of_file: bool
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
        self.scene, self.is_of_file = asked_scene(arguments), is_file(arguments.scene)
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
            "parameters": {name: float(cast(SupportsFloat, entry)) for name, entry in self._told().items()},
        }
        if self.is_of_file:
            self.described |= {
                "file": arguments.scene,
                "hold": _changes(arguments.hold, "0"),
                "ignore": _ignored(arguments),
            }

    def _told(self):
        """The parameters of a scene; of a file, which may have hundreds, those that are changed."""
        known = self.scene.parameters if self.is_of_file else {}
        return {name: entry for name, entry in self.parameters.items() if known.get(name) != entry}

    @property
    def folder(self) -> str:
        """The name of a folder for its results: that of the scene, with -VARIANT where that is not the default."""
        is_default = self.variant == self.scene.default_variant
        return self.scene.name if is_default else f"{self.scene.name}-{self.variant}"

    def initial(self, mechanism: lx.Mechanism) -> lx.State:
        """Assemble the initial state.

        **Raises:** `AssemblyError` with what can be done from the command line.
        """
        progress("assembling", None)
        try:
            return self.scene.initial(mechanism, self.parameters)
        except lx.AssemblyError as error:
            what, _, _ = str(error).rpartition("; ")
            given = ", ".join(f"{name}={self.parameters[name]:g}" for name in [*self.scene.parameters][:MOST_NAMES])
            remedy = f"change some of the parameters of scene {self.scene.name!r} by --set NAME=VALUE: {given}"
            raise lx.AssemblyError(f"{what}; {remedy}") from error


def is_file(name: str) -> bool:
    """Whether a command line names a file of a machine, and not a scene."""
    return name not in SCENES


def asked_scene(arguments: argparse.Namespace) -> Scene:
    """The scene that a command line names, or that of a file of a machine.

    **Raises:** `ValueError` for what belongs to files beside the name of a scene.
    """
    if is_file(arguments.scene):
        hold = {joint: _coordinate(joint, text) for joint, text in _changes(arguments.hold, "0").items()}
        return machine_scene(loaded(arguments), arguments.variant, hold)
    for option, given in (("--hold", arguments.hold), ("--ignore", arguments.ignore)):
        if given:
            raise ValueError(f"{option} is for files of machines, and {arguments.scene!r} is a scene; leave it out")
    return scene(arguments.scene)


def loaded(arguments: argparse.Namespace) -> lx.Machine:
    """Read the machine from the file that a command line names."""
    return lx.load(arguments.scene, ignore=_ignored(arguments), base=arguments.base, folders=arguments.folders)


def _ignored(arguments) -> list[str]:
    return ["contact", *arguments.ignore]


def _coordinate(joint, text) -> float:
    try:
        return number_in(text)
    except ValueError as error:
        raise ValueError(f"--hold {joint}={text!r} is no number; write --hold JOINT=VALUE [rad or m]") from error


def output_folder(asked: Path | None, name: str, settings: dict[str, Any], files: Iterable[str]) -> Path:
    """The folder asked for, or one under linkax-out without results of other settings; checked before the run.

    **Arguments:** `name`: of the default folder. `files`: JSON files with the settings of a folder's results.

    **Raises:** `ValueError` for a folder that cannot be written to, or holds results of other settings.
    """
    folder = _free_folder(name, settings, files) if asked is None else asked
    writable_folder(folder, "give another by --out")
    other = _other_setting(folder, settings, files)
    if other is None:
        return folder
    raise ValueError(
        f"--out {str(folder)!r} holds results of another run, {other}; give another folder, or remove this one"
    )


def _free_folder(name, settings, files):
    """linkax-out/NAME, with -2, ... where others hold other results."""
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


def _changes(assignments, default: str | None = None) -> dict[str, str]:
    """{name: value} of NAME=VALUE; of NAME alone the default, where there is one."""
    changes = {}
    for assignment in assignments:
        name, equals, value = assignment.partition("=")
        if not equals and default is not None:
            value = default
        elif not equals:
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
