"""The commands, and the one line that bad input gets."""

import argparse
import sys
import warnings

import linkax as lx
from linkax.cli import compare, simulate
from linkax.scenes import SCENES


class _Parser(argparse.ArgumentParser):
    """One line on what is wrong, and no dump of the usage."""

    def error(self, message):
        raise ValueError(f"{message}; see `{self.prog} --help`")


def main(argv=None) -> int:
    """Run the command line; returns the exit code: 0, 1 for a run that failed, 2 for bad input."""
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"linkax: {message}", file=sys.stderr)
            arguments = _parser().parse_args(argv)
            return arguments.command(arguments)
    except BrokenPipeError:  # whoever read the output, such as `head`, has had enough
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


def _list(arguments):
    for found in SCENES.values():
        print(f"{found.name}: {found.summary}")
        for name, variant in found.variants.items():
            default = " (default)" if name == found.default_variant else ""
            print(f"    variant {name}{default}: {variant.summary}")
        for name, default in found.parameters.items():
            print(f"    {name} = {default:g}: {found.meanings[name]}")
    return 0
