"""Many mechanisms in one process, as users have them: without the flags of the tests (see test_compiler.py).

Prints JSON. `unlike`: the end of a run before compiled programs are forgotten and after, and how often they were;
`rebuilt`: the largest error of mechanisms that are built anew, and how many programs all of those compiled.
"""

import json
import mmap
import sys
import warnings

import jax.numpy as jnp
import numpy as np
from compilations import compilations
from mechanisms import pendulum

import linkax as lx
from linkax.xla import memory_maps

UNLIKE, REBUILT = 60, 2000
HELD = 54_000  # memory maps: a mechanism takes 50, and the 1000 that are left are used up several times
KINDS = (lx.Revolute, lx.Prismatic, lx.Universal, lx.Cylindrical, lx.Planar)


def chain(kinds):
    """Boxes in a chain, by joints of these kinds."""
    boxes = [lx.box(f"box_{i}", [1.0, 0.2, 0.3], 1.0) for i in range(len(kinds))]
    parents = [lx.GROUND, *(box.at([0.5, 0.0, 0.0]) for box in boxes)]
    children = [box.at([-0.5, 0.0, 0.0]) for box in boxes]
    joints = [
        kind(f"joint_{i}", *ends, "z") for i, (kind, *ends) in enumerate(zip(kinds, parents, children, strict=False))
    ]
    return lx.Mechanism(boxes, joints, [lx.Gravity([0.0, -9.81, 0.0])])


def end(mechanism):
    """The largest coordinate after a while."""
    size = mechanism.topology.num_speeds
    found = lx.simulate(mechanism, lx.State(jnp.full(size, 0.1), jnp.full(size, 0.5)), t1=0.2)
    return float(jnp.max(jnp.abs(found.q[-1])))


def driven(speed):
    """The speed of an arm with a drive and a torque by functions made anew."""
    mechanism = pendulum(gravity=0.0, forces=[lx.JointTorque("hinge", lambda t, motion: speed * jnp.cos(t))])
    return float(lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0).v[-1, 0])


if __name__ == "__main__":
    memory_maps._limit_of_maps = lambda: 65_530  # that of Linux, which `.ci/run` raises where it may
    held = [mmap.mmap(-1, mmap.PAGESIZE) for _ in range(HELD)]
    random = np.random.default_rng(0)
    kinds = dict.fromkeys(tuple(KINDS[i] for i in random.integers(len(KINDS), size=3)) for _ in range(200))
    unlike = [chain(of_joints) for of_joints in list(kinds)[:UNLIKE]]
    with warnings.catch_warnings(record=True) as told, compilations() as programs:
        warnings.simplefilter("always")
        if sys.argv[1] == "unlike":
            ends = [end(mechanism) for mechanism in [*unlike, unlike[0]]]
            found = {"unlike": len(unlike), "ends": [ends[0], ends[-1]]}
        else:
            speeds = np.linspace(0.0, 2.0, REBUILT)
            errors = [driven(jnp.asarray(speed)) - 3.0 * speed * np.sin(1.0) for speed in speeds]
            found = {"error": np.max(np.abs(errors)), "programs": len(programs)}
    found["cleared"] = sum("memory maps" in str(warning.message) for warning in told)
    print(json.dumps(found))
