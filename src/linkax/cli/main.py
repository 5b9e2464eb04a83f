"""Parse and run the commands; bad input is answered by one line."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn

import linkax as lx
from linkax.cli import compare, simulate
from linkax.scenes import SCENES


class _Parser(argparse.ArgumentParser):
    """A parser that tells an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message}; see `{self.prog} --help`")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, by default of this process.

    **Returns:** the exit code: 0, 1 for a run that failed, 2 for bad input.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"linkax: {message}", file=sys.stderr)
            arguments = _parser().parse_args(argv)
            return arguments.command(arguments)
    except BrokenPipeError:  # the reader of the output, such as `head`, has ended
        sys.stderr.close()
        return 0
    except lx.SimulationError as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def _parser():
    parser = _Parser(prog="linkax", description="Simulate mechanisms with closed loops.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the scenes, their variants and parameters")
    listing.set_defaults(command=_list)
    simulate.add_command(commands)
    compare.add_command(commands)
    return parser


def _list(arguments) -> int:
    """Print the scenes, their variants and parameters."""
    for scene in SCENES.values():
        print(f"{scene.name}: {scene.summary}")
        for name, variant in scene.variants.items():
            default = " (default)" if name == scene.default_variant else ""
            print(f"    variant {name}{default}: {variant.summary}")
        for name, default in scene.parameters.items():
            print(f"    {name} = {default:g}: {scene.meanings[name]}")
    return 0
