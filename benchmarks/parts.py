"""What benchmarks with several tables share: choose some by `--part`, print rows as they come, or JSON."""

import argparse
import json
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.machine import machine


def print_parts(description: str, parts: dict[str, Callable[..., Iterator[dict]]], out: Path | None = None):
    """The command line of a benchmark; each part yields the rows of a table.

    Where `out` is given, it is the default of `--out`, a folder that each part is called with.

    **Returns:** the rows of each part that ran, and that folder.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", choices=parts, action="append", help="default: all")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    if out is not None:
        parser.add_argument("--out", type=Path, default=out, metavar="DIR", help=f"for pictures, default {out}")
    arguments = parser.parse_args()
    folder = () if out is None else (arguments.out,)
    found = {}
    for name in arguments.part or parts:
        found[name] = []
        if not arguments.json:
            print(f"\n{name}")
        for row in parts[name](*folder):
            found[name].append(row)
            if not arguments.json:
                print("  " + "  ".join(f"{key} {entry}" for key, entry in row.items()), flush=True)
    if arguments.json:
        print(json.dumps({"machine": machine(), **found}, indent=1))
    return found, *folder
