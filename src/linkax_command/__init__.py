"""The command `linkax`: what it is asked is read, and Ctrl-C heard, before linkax is imported, which takes a while.

`linkax.cli` computes; nothing of linkax imports this package.
"""

import sys
from collections.abc import Sequence

from linkax_command.interrupt import at_interrupt, heard


def main() -> int:
    """Run the command line of this process.

    Ctrl-C ends it with one line and code 130; a second Ctrl-C ends it at once.
    """
    with heard():
        return run()


def run(argv: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of this process; bad input is answered by one line.

    **Returns:** the exit code: 0, 1 for a run that failed, 2 for bad input.
    """
    from linkax_command.parser import parsed, print_scenes

    try:
        arguments = parsed(argv)
        if arguments.command == "list":
            return print_scenes()
        from linkax.cli import run as compute

        return compute(arguments, at_interrupt)
    except BrokenPipeError:  # the reader of the output, such as `head`, has ended
        sys.stderr.close()
        return 0
    except (ValueError, OSError) as error:
        print(f"linkax: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
