"""A program for test_compiler, compiled with the flags that linkax itself sets; prints JSON."""

import json

import numpy as np
from known_answers import start

import linkax as lx
from linkax.xla.flags import makes_kernels_of_loops


def motion():
    """Speeds of a crank-slider after a while, and the steps to there."""
    found = lx.simulate(*start("crank-slider", "SC4"), t1=0.5)
    return {"speeds": np.asarray(found.v[-1]).tolist(), "steps": int(found.stats["num_steps"])}


if __name__ == "__main__":
    print(json.dumps({"makes_kernels": makes_kernels_of_loops(), "motion": motion()}))
