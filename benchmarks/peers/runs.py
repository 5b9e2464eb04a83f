"""What runs of all peers have in common."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

LONGEST = 20.0  # seconds; a run that takes longer is given up
SHORT = 0.4  # seconds; a run that takes less is timed by the median of as many as fit
REPEATS = 3  # at least, of runs that do not take `LONG`
LONG = 2.0  # seconds

Result = TypeVar("Result")


class Setting(NamedTuple):
    """How a peer integrates: one of its methods, and a step [s], or for adaptive methods a relative tolerance."""

    method: str
    step: float


class Run(NamedTuple):
    """What a peer found at the times asked for.

    - `coordinates`, `speeds`: of the description's tree [rad or m], (n_t, n); not a number where a run ended early.
    - `seconds`: it took, without building the model or compiling.
    - `note`: why it ended early, if it did.
    """

    coordinates: np.ndarray
    speeds: np.ndarray
    seconds: float
    note: str = ""


class GaveUp(Exception):
    """A run would take longer than `LONGEST`."""


class Deadline:
    """Raises `GaveUp` once `LONGEST` has passed."""

    def __init__(self):
        self._end = time.perf_counter() + LONGEST

    def check(self, t: float):
        """`t`: the time reached in the simulation [s]."""
        if time.perf_counter() > self._end:
            raise GaveUp(f"gave up after {LONGEST:g} s at t = {t:.3g} s")


def timed(function: Callable[[], Result]) -> tuple[Result, float]:
    """What a function returns, and the seconds it took: the median of several where one is not `LONG`."""
    seconds = []
    while sum(seconds) < SHORT or (len(seconds) < REPEATS and sum(seconds) < LONG):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    return result, statistics.median(seconds)


def steps_between(times, step: float) -> int:
    """Steps from one of the times to the next, which must be evenly spaced from zero by whole steps."""
    count = round(times[1] / step)
    if not np.allclose(times, count * step * np.arange(len(times)), rtol=1e-9, atol=0.0):
        raise ValueError(f"times must be evenly spaced from zero by multiples of the step, {step:g} s")
    return count
