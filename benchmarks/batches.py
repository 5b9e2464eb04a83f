"""Trajectories per second, of many crank-sliders M1a at once: linkax, MuJoCo on all cores, MJX.

Masses of rod and slider differ; ten seconds each. linkax by `linkax.sweep`, at the loosest of its tolerances with which
the members that are checked are within 1e-6 m of their references; MuJoCo's threads at its cheapest setting with which
M1a itself is; MJX by `jax.vmap` at a step of 1e-3 s, with its error, since no step reaches the target within minutes.
Rates of MuJoCo hardly depend on the number of members, of which fewer are run where all would take long. Times are of
this machine, this run: compare ratios.
"""

import os
from collections.abc import Callable, Iterator

import diffrax
import jax
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts
from benchmarks.peers import PEERS
from benchmarks.peers.__main__ import cheapest
from benchmarks.peers.__main__ import rows as peer_rows
from benchmarks.peers.description import describe
from benchmarks.peers.runs import Setting
from benchmarks.problems import PROBLEMS, TIMES
from linkax.scenes import SCENES

PROBLEM, SCENE = PROBLEMS["M1a"], SCENES["crank-slider"]
TARGET = 1e-6  # m
TOLERANCES = (1e-6, 3e-7, 1e-7, 3e-8, 1e-8)
CHECKED = 8
SIZES = (1, 64, 1024, 4096, 65_536)
MOST_OF_PEERS = 64
MJX = Setting("RK4", 1e-3)


def masses(count: int) -> dict[str, np.ndarray]:
    """Of rods and sliders [kg], (n,) each."""
    generator = np.random.default_rng(0)
    return {name: generator.uniform(0.8, 1.2, count) for name in ("rod_mass", "slider_mass")}


def _mechanism(numbers):
    return SCENE.mechanism(PROBLEM.settings | numbers)


def simulated(rtol: float, saveat: diffrax.SaveAt) -> Callable[[dict], lx.Solution]:
    """A function of the masses of a member; all start alike."""
    _, state = PROBLEM.start()
    accuracy = lx.Accuracy(rtol=rtol)
    return lambda numbers: lx.simulate(_mechanism(numbers), state, t1=TIMES[-1], accuracy=accuracy, saveat=saveat)


def _error(rtol):
    """The largest of some members, against references of their own [m]."""
    given = masses(CHECKED)
    found = lx.sweep(simulated(rtol, diffrax.SaveAt(ts=TIMES)), given, progress=False).output
    path = np.asarray(found.position("slider"))
    references = [
        PROBLEM._replace(changes=PROBLEM.changes | {name: float(values[i]) for name, values in given.items()})
        for i in range(CHECKED)
    ]
    return max(float(np.max(np.abs(own - of.reference()))) for own, of in zip(path, references, strict=True))


def cheapest_tolerance() -> tuple[float, float]:
    """The loosest tolerance with which the members that are checked reach TARGET, and their largest error [m]."""
    tried = ((rtol, _error(rtol)) for rtol in TOLERANCES)
    return next(found for found in tried if found[1] < TARGET)


def by_linkax() -> Iterator[dict]:
    """As many members as `SIZES` say."""
    rtol, error = cheapest_tolerance()
    told = {"by": "linkax", "setting": f"rtol {rtol:g}", "error": error}
    jax.clear_caches()
    end = simulated(rtol, diffrax.SaveAt(t1=True))
    for size in SIZES:
        found = lx.sweep(lambda numbers: (end(numbers).end.q, end(numbers).result), masses(size), progress=False)
        rate = 1.0 / found.seconds_per_member
        yield {**told, "members": size, "failed": int(np.sum(~found.ok)), "per_second": rate}


def by_mujoco() -> Iterator[dict]:
    """Threads on all cores, and one."""
    (best,) = cheapest(list(peer_rows("M1a", ["mujoco"])), TARGET)
    setting = Setting(best["method"], best["step"])
    for threads in dict.fromkeys((1, os.cpu_count())):
        for size in (1, MOST_OF_PEERS):
            rate = PEERS["mujoco"].throughput(_descriptions(size), setting, TIMES[-1], threads)
            told = {"by": "mujoco", "setting": f"{setting.method} {setting.step:g} s", "error": best["error"]}
            yield {**told, "threads": threads, "members": size, "per_second": rate}


def by_mjx() -> Iterator[dict]:
    """All members at once."""
    error = next(row for row in peer_rows("M1a", ["mjx"]) if (row["method"], row["step"]) == MJX).get("error")
    for size in (1, MOST_OF_PEERS):
        rate = PEERS["mjx"].throughput(_descriptions(size), MJX, TIMES[-1])
        told = {"by": "mjx", "setting": f"{MJX.method} {MJX.step:g} s", "error": error}
        yield {**told, "members": size, "per_second": rate}


def _descriptions(size):
    given, (_, state) = masses(size), PROBLEM.start()
    mechanisms = (_mechanism({name: float(values[i]) for name, values in given.items()}) for i in range(size))
    return [describe(mechanism, state, PROBLEM.tracked, PROBLEM.cuts) for mechanism in mechanisms]


if __name__ == "__main__":
    print_parts(__doc__, {"linkax": by_linkax, "mujoco": by_mujoco, "mjx": by_mjx})
