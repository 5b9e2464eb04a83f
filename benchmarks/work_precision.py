"""Error against cost: four tolerances, both metrics, every projection, three scenes.

The presets of linkax are chosen from this table. `--json` prints one JSON object.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from known_answers import n_four_bar, reference

import linkax as lx
from linkax.scenes import SCENES

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-12)
PROJECTIONS = ("both", "stage", "step", "none")
METRICS = ("mass", "identity")
REPEATS = 4
LONG = 1.0  # seconds; such a run is timed once


def slider(variant, t1):
    known = reference(f"crank_slider_{variant}")
    exact = known["x_slider"][known["t"] <= t1 + 1e-9]
    return ("crank-slider", variant, t1, lambda found: found.position("slider")[:, 0] - exact)


def first_link(count, t1):
    def error(found):
        return found.position("link_0", at="tip")[:, :2] - n_four_bar(found.ts, count)

    return ("n-four-bar", "A02", t1, error)


# Passes singular configurations; two loops at once; one that never meets any.
RUNS = (slider("SC1", 5.0), first_link(2, 5.0), ("crank-slider", "regular", 1.0, None))


def regular_error(found):
    known = reference("crank_slider_torque")
    at = np.searchsorted(known["t"], found.ts[-1] - 1e-9)
    return found.joint("bearing")[-1] - known["theta"][at]


def measure(name, variant, t1, error, rtol, metric, projection):
    scene = SCENES[name]
    settings = scene.settings(variant)
    mechanism = scene.mechanism(settings)
    state = scene.initial(mechanism, settings)
    accuracy = lx.Accuracy(rtol=rtol, metric=metric, projection=projection)

    def run():
        began = time.perf_counter()
        found = jax.block_until_ready(lx.simulate(mechanism, state, t1=t1, accuracy=accuracy, throw=False))
        return found, time.perf_counter() - began

    found, first = run()
    seconds = run()[1]
    if seconds < LONG:
        seconds = min(seconds, *(run()[1] for _ in range(REPEATS)))
    energy, kinetic = np.asarray(found.energy()), np.asarray(found.kinetic_energy())
    conserved = not settings.get("torque")
    return {
        "scene": f"{name} {variant}",
        "metric": metric,
        "projection": projection,
        "rtol": rtol,
        "error": float(np.max(np.abs((error or regular_error)(found)))),
        "energy_error": float(np.max(np.abs(energy - energy[0])) / np.max(kinetic)) if conserved else None,
        "steps": int(found.stats["num_steps"]),
        "rejected": int(found.stats["num_rejected_steps"]),
        "first_s": first,
        "run_ms": 1e3 * seconds,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = []
    for run in RUNS:
        for metric in METRICS:
            for projection in PROJECTIONS:
                for rtol in TOLERANCES:
                    rows.append(measure(*run, rtol, metric, projection))
                    if not arguments.json:
                        print_row(rows[-1], len(rows) == 1)
    if arguments.json:
        print(json.dumps({"linkax": "0.1.0", "jax": jax.__version__, "rows": rows}))


def print_row(row, heading):
    if heading:
        print(f"{'scene':22} {'metric':9} {'projection':10}", end=" ")
        print(f"{'rtol':>7} {'error':>9} {'energy':>9} {'steps':>6} {'run ms':>8}")
    print(
        f"{row['scene']:22} {row['metric']:9} {row['projection']:10} {row['rtol']:7.0e} {row['error']:9.1e} "
        f"{row['energy_error'] or np.nan:9.1e} {row['steps']:6d} {row['run_ms']:8.1f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
