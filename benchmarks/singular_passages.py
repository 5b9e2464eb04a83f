"""Runs through singular configurations: errors over tolerances, steps and phases; cost.

Each table is of this machine, this run; times are ratios. `--part` chooses one of them:

- `tolerances`: scenes x tolerances x solvers; largest error, accepted and rejected steps.
- `steps`: scenes x fixed steps.
- `phases`: many passages at random phases of the steps, over the clearance; median and largest error.
- `cost`: a mechanism that never comes near, with and without the clearance.
- `long`: 10 000 s of the four-bar, about one passage a second.
"""

import sys
import time
from pathlib import Path

import diffrax
import jax
import numpy as np

import linkax as lx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from known_answers import PASSING, start

from benchmarks.parts import print_parts

TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12, 1e-13)
STEPS = (10e-3, 5e-3, 2e-3, 1e-3, 0.5e-3)
SOLVERS = (diffrax.Tsit5(), diffrax.Dopri5(), diffrax.Dopri8())
MEMBERS = 400
REPEATS = 15


def tolerances():
    for name, run in PASSING.items():
        for solver in SOLVERS:
            row = {"scene": name, "solver": type(solver).__name__}
            for rtol in TOLERANCES:
                found = run.simulate(accuracy=lx.Accuracy(rtol=rtol), solver=solver, throw=False)
                accepted, rejected = (int(found.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
                failed = "" if found.result == lx.RESULTS.successful else " failed"
                row[f"{rtol:.0e}"] = f"{np.max(run.error(found)):.1e} ({accepted}+{rejected}){failed}"
            yield row


def steps():
    for name in ("SC2", "FL1"):
        run = PASSING[name]._replace(t1=5.0)
        for solver in SOLVERS:
            row = {"scene": name, "solver": type(solver).__name__}
            for step in STEPS:
                fixed = diffrax.ConstantStepSize()
                found = run.simulate(dt0=step, solver=solver, stepsize_controller=fixed)
                t = np.asarray(found.ts)
                assert np.all(np.isfinite(t))
                row[f"{1e3 * step:g} ms"] = f"{np.max(run.error(found)):.1e}"
            yield row


def phases():
    """Errors against the tightest run, over random phases of the passage."""
    mechanism, _ = start("crank-slider", "SC2")
    angles = np.random.default_rng(0).uniform(0.0, np.pi / 2, MEMBERS)
    speeds = np.sqrt(2.0 / (2.0 / 3.0 + 6.0 * np.sin(angles) ** 2))
    coordinates = {"bearing": angles, "crank_pin": -2.0 * angles, "guide": 2.0 * np.cos(angles)}
    rates = {"bearing": speeds, "crank_pin": -2.0 * speeds, "guide": -2.0 * np.sin(angles) * speeds}
    q, v = (np.stack([of[name] for name in mechanism.topology.coordinates], axis=1) for of in (coordinates, rates))

    def run(accuracy):
        one = lambda q, v, accuracy: lx.simulate(
            mechanism, lx.State(q, v), t1=2.0, accuracy=accuracy, saveat=diffrax.SaveAt(t1=True), throw=False
        ).q[0]
        return np.asarray(jax.vmap(one, (0, 0, None))(q, v, accuracy))

    exact = run(lx.Accuracy(rtol=1e-14))
    for clearance in (1e-2, 1e-3, 0.0):
        row = {"clearance": clearance}
        for rtol in TOLERANCES:
            errors = np.max(np.abs(run(lx.Accuracy(rtol=rtol, clearance=clearance)) - exact), axis=1)
            row[f"{rtol:.0e}"] = f"{np.median(errors):.0e} ... {np.max(errors):.0e}"
        yield row


def cost():
    """Interleaved runs, so that both meet the same noise; the ratio of the fastest, and of medians."""
    mechanism, state = start("crank-slider", "regular")

    def run(clearance):
        began = time.perf_counter()
        found = lx.simulate(mechanism, state, t1=3.0, accuracy=lx.Accuracy(rtol=1e-10, clearance=clearance))
        jax.block_until_ready(found.q)
        return time.perf_counter() - began, int(found.stats["num_steps"])

    run(0.0)
    times = {0.0: [], 1e-2: []}
    for _ in range(REPEATS):
        for clearance, kept in times.items():
            kept.append(run(clearance)[0])
    without, with_it = (np.array(kept) for kept in times.values())
    yield {
        "steps without": run(0.0)[1],
        "steps with": run(1e-2)[1],
        "time, fastest": f"{np.min(with_it) / np.min(without):.3f}",
        "time, median": f"{np.median(with_it) / np.median(without):.3f}",
    }


def long():
    mechanism, state = start("n-four-bar", "A02", {"N": 1})
    began = time.perf_counter()
    found = lx.simulate(mechanism, state, t1=1e4, max_steps=10**6)
    seconds = time.perf_counter() - began
    apart = np.max(np.abs(found.joint("pivot_0") - found.joint("pivot_1")))
    energy = np.asarray(found.energy())
    violation = found.worst_violation()
    yield {
        "steps": int(found.stats["num_steps"]),
        "links apart [rad]": f"{apart:.1e}",
        **{f"{level} violation": f"{float(size):.1e}" for level, size in violation._asdict().items()},
        "energy drift": f"{np.max(np.abs(energy - energy[0])) / np.max(np.asarray(found.kinetic_energy())):.1e}",
        "seconds": f"{seconds:.0f}",
    }


PARTS = {part.__name__: part for part in (tolerances, steps, phases, cost, long)}


if __name__ == "__main__":
    print_parts(__doc__, PARTS)
