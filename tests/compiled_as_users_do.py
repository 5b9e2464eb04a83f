"""A program for test_compiler: motions of scenes as JSON, compiled with the flags that linkax itself sets."""

import json
import sys

import jax
import numpy as np
from known_answers import start

import linkax as lx
from linkax.compiler import makes_kernels_of_loops


def motion(mechanism, state):
    found = lx.simulate(mechanism, state, t1=0.5)
    return {"v": np.asarray(found.v[-1]).tolist(), "steps": int(found.stats["num_steps"])}


def main(scenes):
    started = {scene: start(scene) for scene in scenes}
    found = {scene: motion(*given) for scene, given in started.items()}
    mechanism, state = started[scenes[0]]
    speeds = jax.vmap(lambda q: lx.simulate(mechanism, lx.State(q, state.v), t1=0.5).v[-1])(
        np.stack([state.q, state.q])
    )
    print(json.dumps({"kernels": makes_kernels_of_loops(), "motions": found, "batch": np.asarray(speeds).tolist()}))


if __name__ == "__main__":
    main(sys.argv[1:])
