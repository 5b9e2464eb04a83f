"""Tracing, compiling and running one simulation of the crank-slider (SC1, 10 s) and its gradient.

`--json` prints one JSON object.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
REPEATS = 7


def motion(numbers, accuracy):
    settings = SCENE.settings("SC1", numbers)
    mechanism = SCENE.mechanism(settings)
    start = lx.State(jnp.array([0.0, 2.0, 0.0]), jnp.zeros(3))
    return lx.simulate(mechanism, start, t1=10.0, accuracy=accuracy).q


def staged(function, *arguments):
    """Seconds to trace and lower, to compile, and to run once compiled."""
    began = time.perf_counter()
    lowered = jax.jit(function).lower(*arguments)
    traced = time.perf_counter()
    compiled = lowered.compile()
    ready = time.perf_counter()

    def once():
        start = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        return time.perf_counter() - start

    once()
    return {"trace_s": traced - began, "compile_s": ready - traced, "run_ms": 1e3 * min(once() for _ in range(REPEATS))}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    numbers = {name: jnp.asarray(1.0) for name in ("crank_mass", "rod_mass", "slider_mass")}
    jax.block_until_ready(jnp.zeros(3) + 1.0)  # starts the backend
    found = {
        "simulate, BALANCED": staged(lambda numbers: motion(numbers, lx.BALANCED), numbers),
        "simulate, PRECISE": staged(lambda numbers: motion(numbers, lx.PRECISE), numbers),
        "gradient, BALANCED": staged(jax.grad(lambda numbers: motion(numbers, lx.BALANCED)[-1, 1]), numbers),
    }
    if arguments.json:
        print(json.dumps(found))
        return
    for name, row in found.items():
        print(
            f"{name:22} trace {row['trace_s']:6.2f} s  compile {row['compile_s']:6.2f} s  run {row['run_ms']:8.1f} ms"
        )


if __name__ == "__main__":
    main()
