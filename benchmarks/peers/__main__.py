"""Errors and times of other simulators on linkax's mechanisms.

A row for each run: peer, method, step [s] (of adaptive methods the relative tolerance), milliseconds per simulated
second, largest error of the tracked point [m], largest gap of a loop [m], change of energy [J], the time reached [s],
and why it ended early. Then for each peer the cheapest run whose error is below `--target`, and of Pinocchio the
microseconds for one right-hand side. Times are of this machine, this run: compare ratios.
"""

import argparse
import json
import math
from collections.abc import Iterator

import jax

from benchmarks.peers import PEERS
from benchmarks.peers.kinematics import judge
from benchmarks.peers.runs import GaveUp
from benchmarks.problems import PROBLEMS, TIMES, add_problems, chosen


def rows(problem: str, peers) -> Iterator[dict]:
    """One of `PROBLEMS` by each of the peers named."""
    description, reference = PROBLEMS[problem].describe(), PROBLEMS[problem].reference()
    jax.clear_caches()  # a process has room for the programs of a few mechanisms only
    for peer in peers:
        for found in _runs(PEERS[peer], description, reference):
            yield {"problem": problem, "peer": peer, **found}
        if peer == "pinocchio":
            cost = PEERS[peer].microseconds_per_evaluation(description)
            yield {"problem": problem, "peer": peer, "us_per_evaluation": cost}
        jax.clear_caches()


def _runs(peer, description, reference):
    hopeless = set()
    for setting in peer.settings():
        if setting.method in hopeless:
            continue
        try:
            run = peer.run(description, setting, TIMES)
        except GaveUp as error:
            hopeless.add(setting.method)
            yield {**setting._asdict(), "note": f"{error}, and so would finer ones"}
            continue
        verdict = judge(description, TIMES, run.coordinates, run.speeds, reference)
        cost = 1e3 * run.seconds / verdict["reached"] if verdict["reached"] else math.inf
        yield {**setting._asdict(), "ms_per_second": cost, **verdict, "note": run.note}


def cheapest(found: list[dict], target: float) -> Iterator[dict]:
    """Of each problem and peer, the run to the end with an error below a target [m] that took the least time."""
    good = [row for row in found if row.get("reached") == TIMES[-1] and row["error"] < target]
    for key in dict.fromkeys((row["problem"], row["peer"]) for row in found):
        runs = [row for row in good if (row["problem"], row["peer"]) == key]
        yield min(runs, key=lambda row: row["ms_per_second"]) if runs else {"problem": key[0], "peer": key[1]}


def _line(row):
    entries = (f"{key} {entry:.3g}" if isinstance(entry, float) else str(entry) for key, entry in row.items())
    return "  " + "  ".join(entries)


def main():
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_problems(parser, [key for key, problem in PROBLEMS.items() if problem.for_peers])
    parser.add_argument("--peer", choices=list(PEERS), action="append", help="default: all")
    parser.add_argument("--target", type=float, default=1e-6, help="error of the cheapest runs [m], default 1e-6")
    parser.add_argument("--json", action="store_true", help="print one JSON array of rows, and nothing else")
    arguments = parser.parse_args()
    found = []
    for problem in chosen(arguments.problems):
        if not arguments.json:
            print(f"\n{problem}: {PROBLEMS[problem].name}")
        for row in rows(problem, arguments.peer or PEERS):
            found.append(row)
            if not arguments.json:
                print(_line(row), flush=True)
    if arguments.json:
        print(json.dumps(found))
        return
    print(f"\ncheapest with an error below {arguments.target:g} m")
    for row in cheapest(found, arguments.target):
        print(_line(row))


if __name__ == "__main__":
    main()
