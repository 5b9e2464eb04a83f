"""Tracing, compiling and running simulations and their gradients, BALANCED unless named.

The crank-slider SC1 over 10 s; Bricard's mechanism over 1 s; and a row of four four-bars over 1 s with twenty
parameters: masses and inertias of nine bodies, gravity, angle at the start. `--json` prints one JSON object.
"""

import argparse
import json
import time

import diffrax
import equinox as eqx
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


def end_of(scene, settings, scales=None):
    """Speeds 1 s after the start; masses and inertias of the bodies times `scales`, (2 n_b,)."""
    scene = SCENES[scene]
    mechanism = scene.mechanism(settings)
    if scales is not None:
        masses, inertias = jnp.split(scales, 2)
        bodies = [
            eqx.tree_at(lambda b: (b.mass, b.inertia), body, (body.mass * mass, body.inertia * inertia))
            for body, mass, inertia in zip(mechanism.bodies, masses, inertias, strict=True)
        ]
        mechanism = lx.Mechanism(bodies, mechanism.joints, mechanism.forces, mechanism.constraints)
    state = scene.initial(mechanism, settings)
    return lx.simulate(mechanism, state, t1=1.0, saveat=diffrax.SaveAt(t1=True)).end.v


def of_bricard(numbers):
    return end_of("bricard", SCENES["bricard"].settings(None, numbers))[0]


def of_twenty(numbers):
    settings = SCENES["n-four-bar"].settings(None, {"N": 4}) | {"gravity": numbers[0], "angle": numbers[1]}
    return end_of("n-four-bar", settings, numbers[2:])[0]


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
    bricard = {name: jnp.asarray(1.0) for name in ("length", "mass")}
    settings = SCENES["n-four-bar"].settings(None, {"N": 4})
    twenty = jnp.asarray([settings["gravity"], settings["angle"], *[1.0] * 18])
    jax.block_until_ready(jnp.zeros(3) + 1.0)  # starts the backend
    found = {
        "simulate, BALANCED": staged(lambda numbers: motion(numbers, lx.BALANCED), numbers),
        "simulate, PRECISE": staged(lambda numbers: motion(numbers, lx.PRECISE), numbers),
        "gradient": staged(jax.grad(lambda numbers: motion(numbers, lx.BALANCED)[-1, 1]), numbers),
        "Bricard": staged(of_bricard, bricard),
        "Bricard, gradient": staged(jax.grad(of_bricard), bricard),
        "20 parameters": staged(of_twenty, twenty),
        "20 parameters, gradient": staged(jax.grad(of_twenty), twenty),
    }
    ratio = found["20 parameters, gradient"]["run_ms"] / found["20 parameters"]["run_ms"]
    if arguments.json:
        print(json.dumps(found | {"gradient over run, 20 parameters": ratio}))
        return
    for name, row in found.items():
        print(
            f"{name:23} trace {row['trace_s']:6.2f} s  compile {row['compile_s']:6.2f} s  run {row['run_ms']:8.1f} ms"
        )
    print(f"gradient over run, 20 parameters: {ratio:.1f}")


if __name__ == "__main__":
    main()
