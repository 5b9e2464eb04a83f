"""A sweep of regular crank-sliders, 10 s each at BALANCED: time per member, memory, and how it compares to single runs.

Crank 1 m, rod 1.5 to 3 m, rod of 0.5 to 2 kg, released at 45 degrees. `--members N` (default 100 000), `--json`.
"""

import argparse
import json
import resource
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
COMPARED = 20


def member(params):
    settings = SCENE.settings("SC4", {**params, "angle": jnp.pi / 4})
    mechanism = SCENE.mechanism(settings)
    found = lx.simulate(mechanism, SCENE.initial(mechanism, settings), t1=10.0, saveat=diffrax.SaveAt(t1=True))
    return {"slider": found.position("slider")[-1, 0], "steps": found.stats["num_steps"], "result": found.result}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=100_000)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    generator = np.random.default_rng(0)
    params = {
        "rod": generator.uniform(1.5, 3.0, arguments.members),
        "rod_mass": generator.uniform(0.5, 2.0, arguments.members),
    }
    began = time.perf_counter()
    found = lx.sweep(member, params, progress=not arguments.json)
    whole = time.perf_counter() - began
    single, apart, times = jax.jit(member), [], []
    for index in generator.choice(arguments.members, min(COMPARED, arguments.members), replace=False):
        own = {name: jnp.asarray(values[index]) for name, values in params.items()}
        began = time.perf_counter()
        alone = jax.block_until_ready(single(own))
        times.append(time.perf_counter() - began)
        apart.append(abs(float(alone["slider"] - found.output["slider"][index])))
    row = {
        "members": arguments.members,
        "ended": found.count(),
        "whole_s": whole,
        "per_member_ms": 1e3 * found.seconds_per_member,
        "single_run_ms": 1e3 * float(np.median(times)),
        "largest_difference_m": max(apart),
        "steps": [int(np.min(found.output["steps"])), int(np.max(found.output["steps"]))],
        "peak_memory_GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    if arguments.json:
        print(json.dumps(row))
        return
    for name, entry in row.items():
        print(f"{name:22} {entry}")


if __name__ == "__main__":
    main()
