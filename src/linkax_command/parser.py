"""What the command line can be asked, and what scenes there are; nothing here waits for JAX."""

import argparse
import math
import sys
import tomllib
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn, cast

COMMANDS = ("list", "simulate", "inspect", "convert", "compare", "sweep")
PRESETS = ("draft", "balanced", "precise")
SOLVERS = ("tsit5", "dopri5", "dopri8", "kvaerno3", "kvaerno5", "rodas5p", "rk4")
EQUAL = ("tolerance", "cost")
FORMULATIONS = (
    "A NAME is tangent-space (the paper's), or one of lagrange-multipliers, lagrange-multipliers-block, "
    "augmented-lagrangian, moore-penrose-svd, moore-penrose-gram-schmidt, udwadia-kalaba, projection-operator, with "
    "+baumgarte added, and +partitioning or +projection."
)
STUDY = (
    "STUDY.py defines `function`, of one member's params, and `params`, arrays with one entry for each member, as "
    "linkax.sweep takes them; and perhaps `options`, a dictionary with some of its chunk, memory and difficulty."
)


FILES = "a file of a machine: MJCF, SDF, URDF, USD"
KINDS = 'a kind of thing in the file to leave out, such as "limit" or "actuator"'


class _Parser(argparse.ArgumentParser):
    """A parser that tells an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see `{self.prog} --help`")


class _Version(argparse.Action):
    """Print versions, which takes a moment to find."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        from importlib.metadata import version

        print(", ".join(f"{name} {version(name)}" for name in ("linkax", "jax", "diffrax", "equinox")))
        parser.exit()


def parsed(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read a command line, by default that of this process; its `command` is one of `COMMANDS`.

    **Raises:** `ValueError` for one that makes no sense.
    """
    argv = sys.argv[1:] if argv is None else argv
    parser = _Parser(prog="linkax", description="Simulate mechanisms with closed loops.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print versions")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    commands.add_parser("list", help="the scenes, their variants and parameters")
    simulate = commands.add_parser("simulate", help="simulate a scene and write its trajectory and pictures")
    _add_run_options(simulate)
    simulate.add_argument("--formulation", default="tangent-space", metavar="NAME", help="see `linkax compare --help`")
    inspect = commands.add_parser(
        "inspect", help="tell what a file of a machine has, how it moves, and what is left out"
    )
    inspect.add_argument("scene", metavar="FILE", type=_scene, help=FILES)
    inspect.add_argument("--variant", metavar="START", help="a start that the file names (default: as drawn)")
    _add_file_options(inspect)
    inspect.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    convert = commands.add_parser("convert", help="write the machine of a file as MJCF, for MuJoCo")
    convert.add_argument("scene", metavar="IN", type=_scene, help=FILES)
    convert.add_argument("target", metavar="OUT", type=_path, help="the file to write, with suffix .xml")
    convert.add_argument("--variant", metavar="START", help="a start that the file names (default: as drawn)")
    _add_file_options(convert)
    leave = "an element that MuJoCo does not have, by name or type, to leave out of OUT"
    convert.add_argument("--leave", action="append", default=[], metavar="NAME", help=leave)
    compare = commands.add_parser(
        "compare",
        help="integrate a scene by all formulations, and compare errors, violations and cost",
        epilog=FORMULATIONS,
    )
    _add_run_options(compare)
    names = "formulations, separated by commas (default: sixteen, about two minutes, most of it compiling)"
    compare.add_argument("--formulations", metavar="NAME,...", help=names)
    equal = "tolerance: each at the same tolerance or step; cost: each in no more run time than the paper's needs"
    compare.add_argument("--equal", default="tolerance", type=_one_of(EQUAL), metavar="WHAT", help=equal)
    compare.add_argument("--bound", type=_positive, metavar="M", help="an error above it [m] counts as diverged")
    compare.add_argument(
        "--all-rows", action="store_true", help="with the loop rows too that no motion changes, which linkax leaves out"
    )
    sweep = commands.add_parser(
        "sweep",
        help="evaluate the function of a Python file for all of its parameters, and keep the results",
        epilog=STUDY,
    )
    _add_sweep_options(sweep)
    if argv and not argv[0].startswith("-") and argv[0] not in COMMANDS:  # of which argparse has no more to say
        parser.error(_unknown(argv[0], COMMANDS, "command "))
    return parser.parse_args(argv)


def print_scenes() -> int:
    """Print the scenes, their variants and parameters, and return the exit code."""
    for name, scene in _scenes().items():
        print(f"{name}: {scene['summary']}")
        for index, (variant, described) in enumerate(scene["variants"].items()):
            print(f"    variant {variant}{'' if index else ' (default)'}: {described['summary']}")
        for parameter, (default, meaning) in scene["parameters"].items():
            print(f"    {parameter} = {default:g}: {meaning}")
    return 0


@cache
def _scenes() -> dict[str, dict[str, Any]]:
    """What describes the scenes, by their names."""
    folder = Path(cast(Any, find_spec("linkax")).origin).parent / "scenes"
    return tomllib.loads((folder / "scenes.toml").read_text(encoding="utf-8"))


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a run: the scene, its parameters, and how it is integrated."""
    parser.add_argument("scene", metavar="SCENE", type=_scene, help=f"a scene of `linkax list`, or {FILES}")
    parser.add_argument("--variant", help="a variant of the scene (default: its first), or a start of the file")
    parser.add_argument("--t1", type=_positive, metavar="S", help="end time [s]")
    parser.add_argument("--set", dest="changes", action="append", default=[], metavar="NAME=VALUE", help="a parameter")
    hold = "hold a joint of the file by a motor, at a coordinate [rad or m], by default as drawn"
    parser.add_argument("--hold", action="append", default=[], metavar="JOINT[=VALUE]", help=hold)
    _add_file_options(parser)
    parser.add_argument("--preset", default="balanced", type=_one_of(PRESETS), help=f"{', '.join(PRESETS)}")
    parser.add_argument("--rtol", type=_positive, metavar="X", help="tolerance of a step, instead of the preset's")
    solvers = f"{', '.join(SOLVERS)} (default: dopri8, or rodas5p for damped beams)"
    parser.add_argument("--solver", type=_one_of(SOLVERS), help=solvers)
    parser.add_argument("--dt", type=_positive, metavar="S", help="fixed steps [s], instead of ones that adapt")
    parser.add_argument("--out", type=_path, metavar="DIR", help="folder for the files (default: under linkax-out)")
    parser.add_argument("--no-plots", action="store_true", help="write no pictures")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def _add_file_options(parser: argparse.ArgumentParser) -> None:
    """Add how a file is read."""
    parser.add_argument("--ignore", action="append", default=[], metavar="KIND", help=KINDS)
    parser.add_argument("--base", type=_one_of(("free", "fixed")), metavar="HOW", help="free or fixed, see linkax.load")
    folders = "a folder below which the file may name others, besides its own"
    parser.add_argument("--folder", dest="folders", action="append", default=[], metavar="DIR", help=folders)


def _add_sweep_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a sweep."""
    parser.add_argument("study", metavar="STUDY.py", type=_path, help="a study file, see below")
    scheduler = "of Dask, whose workers compute (default: the cores or devices of this machine)"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=scheduler)
    parser.add_argument("--resume", action="store_true", help="go on with the sweep in the store, if there is one")
    out = "Zarr store for the results (default: STUDY.zarr under linkax-out)"
    parser.add_argument("--out", type=_path, metavar="DIR", help=out)
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")


def _scene(text: str) -> str:
    if text not in _scenes() and not (Path(text).suffix and Path(text).is_file()):
        raise argparse.ArgumentTypeError(_unknown(text, _scenes(), "scene "))
    return text


def _one_of(choices: Iterable[str]) -> Callable[[str], str]:
    """A function that reads one of several words, in any case, and raises `ArgumentTypeError` for others."""

    def read(text):
        if text.lower() not in choices:
            raise argparse.ArgumentTypeError(_unknown(text, choices))
        return text.lower()

    return read


def _unknown(text, known, what="") -> str:
    """What to say of an unknown word, in the words of `linkax.model.names.meant`, which would import JAX."""
    from difflib import get_close_matches

    meant = "".join(f" (did you mean {close!r}?)" for close in get_close_matches(text.lower(), known, 1))
    return f"unknown {what}{text!r}{meant}; known: {', '.join(known)}"


def _positive(text: str) -> float:
    try:
        number = math.nan if "_" in text or not text.isascii() else float(text)  # as linkax.model.numbers.number_in
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive, finite number")
    return number


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("'' names nothing; give a name")
    return Path(text)
