"""Assembly from rough places in the world: how many of many guesses lead to the mode that is drawn.

Each guess has the places of all moving pins, off along each axis by up to ±15 % of the mechanism's size, at random and
evenly; drives are held as drawn, and joints have their zeros anywhere. Each row: the share of guesses that end in what
is drawn, to 1e-6 of the size; in another assembly; in none; seconds of the first call, and of all.
"""

import time
from collections.abc import Iterator
from functools import partial

import numpy as np

import linkax as lx
from benchmarks.linkages import LINKAGES, Linkage, hidden
from benchmarks.parts import print_parts

GUESSES, OFF = 100, 0.15
SAME = 1e-6


def share(name: str, count: int = GUESSES, off: float = OFF) -> Iterator[dict]:
    """Of one linkage."""
    linkage = hidden(LINKAGES[name]())
    times, found = [time.perf_counter()], []
    for places in guesses(linkage, count, off):
        found.append(mode(linkage, places))
        times.append(time.perf_counter())
    shares = {ending: found.count(ending) / count for ending in ("drawn", "other", "none")}
    seconds = {"first_s": times[1] - times[0], "all_s": times[-1] - times[0]}
    yield {"speeds": linkage.mechanism.topology.num_speeds, **shares, **seconds}


def guesses(linkage: Linkage, count: int, off: float) -> np.ndarray:
    """Places of the pins, (count, pins, 3); those of bodies that share a pin differ."""
    drawn = np.stack([*linkage.pins.values()])
    aside = off * linkage.size * np.random.default_rng(0).uniform(-1.0, 1.0, size=(count, *drawn.shape))
    return drawn + aside * np.array([1.0, 1.0, not linkage.flat])


def mode(linkage: Linkage, places: np.ndarray) -> str:
    """What a guess of places leads to: "drawn", "other" or "none"."""
    mechanism = linkage.mechanism
    try:
        state = lx.assemble(mechanism, linkage.held, guess=dict(zip(linkage.pins, places, strict=True)))
    except lx.AssemblyError:
        return "none"
    poses, missed = lx.Solution.of_state(mechanism, state).poses(), 0.0
    for key, drawn in linkage.pins.items():
        body, _, frame = key.partition(".")
        position, orientation = (np.asarray(part)[0] for part in poses[body])
        missed = max(missed, np.max(np.abs(position + orientation @ mechanism.body(body).at(frame).offset - drawn)))
    return "drawn" if missed <= SAME * linkage.size else "other"


PARTS = {name: partial(share, name) for name in LINKAGES}

if __name__ == "__main__":
    print_parts(__doc__ or "", PARTS)
