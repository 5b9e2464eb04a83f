"""A program for test_compiler, compiled with the flags that linkax itself sets; prints JSON."""

import json

import jax
import jax.numpy as jnp
import numpy as np
from known_answers import start

import linkax as lx
from linkax.compiler import makes_kernels_of_loops
from linkax.tracing import in_one_kernel


def motion(optimise=True):
    """Speeds of a crank-slider after a while, and the steps to there."""
    found = lx.simulate(*start("crank-slider", "SC4"), t1=0.5, optimise=optimise)
    return {"speeds": np.asarray(found.v[-1]).tolist(), "steps": int(found.stats["num_steps"])}


def kernels():
    """A function of an array and a number that is none, alone, in a batch, and where it makes no sense."""
    of = lambda sound, array: in_one_kernel(lambda array, count: (array @ array, count), sound, array, 3)
    matrices = jnp.arange(32.0).reshape(2, 4, 4)
    alone, count = jax.jit(of)(True, matrices[0])
    batch, _ = jax.jit(jax.vmap(of, in_axes=(None, 0)))(True, matrices)
    none, _ = jax.jit(of)(False, matrices[0])
    loop = jax.jit(lambda array: of(True, array)[0]).lower(matrices[0]).as_text()
    told = {"alone": alone, "count": count, "batch": batch, "none": none}
    return {name: np.asarray(array).tolist() for name, array in told.items()} | {"loops": loop.count("while")}


def assembled_inside(angle):
    """The same end of a pendulum's motion, assembled and run in one program, and in programs of their own."""

    def end(angle):
        arm = lx.rod("arm", 1.0, 1.0)
        hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")
        mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
        return lx.simulate(mechanism, lx.assemble(mechanism, {"hinge": angle}), t1=0.5).q[-1, 0]

    return [float(end(angle)), float(jax.jit(end)(angle))]


if __name__ == "__main__":
    motions = {"motion": motion(), "motion_once": motion(optimise=False)}
    told = {"makes_kernels": makes_kernels_of_loops(), "kernels": kernels(), "assembled_inside": assembled_inside(0.4)}
    print(json.dumps(told | motions))
