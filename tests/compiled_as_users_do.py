"""A program for test_compiler, compiled with the flags that linkax itself sets; prints JSON."""

import json

import jax
import numpy as np
from known_answers import start

import linkax as lx
from linkax.xla.flags import makes_kernels_of_loops


def motion():
    """Speeds of a crank-slider after a while, and the steps to there."""
    found = lx.simulate(*start("crank-slider", "SC4"), t1=0.5)
    return {"speeds": np.asarray(found.v[-1]).tolist(), "steps": int(found.stats["num_steps"])}


def assembled_inside(angle):
    """The same end of a pendulum's motion, assembled and run in one program, and in programs of their own.

    `of_run`: whether its loops over steps are left as loops.
    """

    def end(angle):
        arm = lx.rod("arm", 1.0, 1.0)
        hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")
        mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
        start = lx.assemble(mechanism, {"hinge": angle})
        return lx.simulate(mechanism, start, t1=0.5).q[-1, 0]

    together = jax.jit(end).lower(angle).compile()
    _, _, entry = together.as_text().partition("\nENTRY")
    loops = [line for line in entry.splitlines() if " while(" in line or "xla_cpu_small_call" in line]
    of_run = [" while(" in line for line in loops if "diffeqsolve" in line]
    return {"ends": [float(end(angle)), float(together(angle))], "of_run": of_run}


if __name__ == "__main__":
    told = {"makes_kernels": makes_kernels_of_loops(), "motion": motion()}
    print(json.dumps(told | {"assembled_inside": assembled_inside(0.4)}))
