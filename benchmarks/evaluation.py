"""One evaluation of the equations of motion: its time, what corrections take of it, and how both grow.

Each row: speeds and loop rows; microseconds for an evaluation as a step asks for it; what part of that the correction
of positions and speeds takes; seconds to compile it, and kilobytes that it works in; and Pinocchio's microseconds for
`constraintDynamics` at the same state, where it is installed. Part `problems`: those of `benchmarks.problems`, and the
telescopic crane. Part `rows`: N four-bars in a row. Part `joints`: each type of joint, a chain of five below a hinge,
and one that closes a loop of two hinged bodies. Parts `chains` and `rings`: as many bodies, hinged to each other, from
ground, and back to it. After those the exponents with which times grow. Times are of this machine, this run: compare
ratios.
"""

import itertools
import math
import time
from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.compile_times import least
from benchmarks.parts import print_parts
from benchmarks.peers import PEERS
from benchmarks.problems import PROBLEMS, Problem
from linkax.equations.system import System, system_of
from linkax.simulation.integrate import problem as integrated
from scalarjit import scalarised

ROWS = (1, 2, 5, 10, 20, 40, 70, 100, 200)
BODIES = (10, 30, 100, 300, 1000)
LONG_ENOUGH = 0.05  # seconds, for a loop over evaluations
SMALLEST = 1e-30  # keeps a loop from being the same in each pass, and changes nothing


def evaluate(system: System, q: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
    """v, v̇ and q of the equations of motion, corrected."""
    return lx.TangentSpace().prepared(float).derivative(system, jnp.zeros(()), q, v, True)[:3]


def cost(mechanism: lx.Mechanism, state: lx.State) -> dict:
    """Of an evaluation at a state."""
    method, system = lx.TangentSpace().prepared(float), system_of(mechanism, float)
    accuracies = {True: lx.Accuracy(), False: lx.Accuracy(projection="none")}

    def repeated(problem, y, count):
        return jax.lax.fori_loop(0, count, lambda _, y: y + SMALLEST * problem.derivative(0.0, y), y)

    found, rows = {}, mechanism.topology.num_rows
    for correct in (True, False):
        began = time.perf_counter()
        # At no time is the state on the loops already.
        problem = integrated.Problem(mechanism, system, method, accuracies[correct], closed_at=-1.0)
        given = problem, problem.packed(state.q, state.v)
        program = jax.jit(scalarised(repeated)).lower(*given, 1).compile()
        found[correct] = seconds_of(lambda count, program=program, given=given: program(*given, count))
        if correct:
            compiling, memory = time.perf_counter() - began, program.memory_analysis()
    return {
        "speeds": mechanism.topology.num_speeds,
        "rows": rows,
        "us": 1e6 * found[True],
        "correction_share": 1.0 - found[False] / found[True] if rows else None,
        "compile_s": compiling,
        "kB": (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e3,
    }


def seconds_of(run):
    """Of one evaluation: by how much a loop over four times as many takes longer, the shortest of several."""
    count = 1
    jax.block_until_ready(run(count))  # the first call takes longer
    while least(partial(run, count)) < LONG_ENOUGH:
        count *= 4
    return (least(partial(run, 4 * count)) - least(partial(run, count))) / (3 * count)


def _pinocchio(problem):
    """Its microseconds, where it is installed."""
    try:
        peer = PEERS["pinocchio"]
    except ModuleNotFoundError:
        return {}
    return {"pinocchio_us": peer.microseconds_per_evaluation(problem.describe())}


def _of_problem(problem):
    found = cost(*problem.start())
    if problem.for_peers:
        found |= _pinocchio(problem)
    if "pinocchio_us" in found:
        found["ratio"] = found["pinocchio_us"] / found["us"]
    jax.clear_caches()
    return found


def problems() -> Iterator[dict]:
    """All problems that other benchmarks use, and one with beams."""
    with_beams = Problem("telescopic-crane", {}, "tip", singular=False, conserves=False, for_peers=False)
    for key, problem in (*PROBLEMS.items(), ("telescopic-crane", with_beams)):
        yield {"problem": key, **_of_problem(problem)}


def rows() -> Iterator[dict]:
    """N four-bars in a row."""
    yield from _growing("N", ROWS, lambda count: _of_problem(Problem("n-four-bar", {"N": count}, "B0", singular=True)))


def chains() -> Iterator[dict]:
    """Bodies hanging from each other."""
    yield from _growing("bodies", BODIES, lambda count: cost(*_bodies(count, closed=False)))


def rings() -> Iterator[dict]:
    """A polygon of bodies, the first and the last hinged to ground."""
    yield from _growing("bodies", BODIES, lambda count: cost(*_bodies(count, closed=True)))


JOINTS = {
    "Revolute": partial(lx.Revolute, axis="z"),
    "Prismatic": partial(lx.Prismatic, axis="x"),
    "Screw": partial(lx.Screw, axis="z", pitch=0.1),
    "Universal": partial(lx.Universal, axis="x", second_axis="y"),
    "Cylindrical": partial(lx.Cylindrical, axis="z"),
    "Rectangular": partial(lx.Rectangular, axis="z"),
    "Planar": partial(lx.Planar, axis="z"),
    "Spherical": lx.Spherical,
    "Fixed": lx.Fixed,
    "Free": lx.Free,
}
ROD = 0.4  # [m], of a `Distance`


def joints() -> Iterator[dict]:
    """A chain of five joints of each type, and one of them that closes a loop."""
    for name, make in JOINTS.items():
        yield {"joint": name, "place": "tree", **cost(*_chain_of(make))}
        if name != "Free":
            yield {"joint": name, "place": "cut", **cost(*_loop_with(partial(make, cut=True), apart=0.0))}
        jax.clear_caches()
    yield {"joint": "Distance", "place": "cut", **cost(*_loop_with(partial(lx.Distance, length=ROD), apart=ROD))}


def _chain_of(make):
    rods = [lx.rod(f"rod_{i}", 1.0, 1.0) for i in range(6)]
    joints = [make(f"joint_{i}", rods[i].at("tip"), rods[i + 1].at("base")) for i in range(5)]
    return _at_zero(rods, [lx.Revolute("hinge", lx.GROUND, rods[0].at("base"), "z"), *joints])


def _loop_with(make, apart):
    rods = [lx.rod(name, 1.0, 1.0) for name in ("left", "right")]
    left, right = (lx.Revolute(f"hinge_{rod.name}", lx.GROUND, rod.at("base"), "z") for rod in rods)
    closing = make("closing", rods[0].at("tip"), rods[1].at([1.0, apart, 0.0]))
    return _at_zero(rods, [left, right, closing])


def _at_zero(rods, joints):
    mechanism = lx.Mechanism(rods, joints, [lx.Gravity([0.0, -9.81, 0.0])])
    return mechanism, lx.assemble(mechanism)


def _growing(name, counts, measure):
    found = []
    for count in counts:
        row = {name: count, **measure(count)}
        found.append((count, row))
        yield row
    for (few, less), (many, more) in itertools.pairwise(found):
        exponent = lambda key, a=less, b=more, r=many / few: math.log(b[key] / a[key]) / math.log(r)
        yield {"from": few, "to": many, **{f"{key}_exponent": exponent(key) for key in ("us", "compile_s", "kB")}}


def _bodies(count, closed):
    """Rods of one metre, each turned against the one before it as in a regular polygon."""
    rods = [lx.rod(f"rod_{i}", 1.0, 1.0) for i in range(count)]
    ends = [lx.GROUND.at([0.0, 0.0, 0.0]), *(rod.at("tip") for rod in rods)]
    joints = [lx.Revolute(f"hinge_{i}", ends[i], rods[i].at("base"), axis="z") for i in range(count)]
    turn = 2.0 * math.pi / (count + 1)
    if closed:
        # The side that is missing lies on the ground.
        joints.append(lx.Revolute("last", ends[-1], lx.GROUND.at([-1.0, 0.0, 0.0]), axis="z"))
    mechanism = lx.Mechanism(rods, joints, [lx.Gravity([0.0, -9.81, 0.0])])
    speeds = mechanism.topology.num_speeds
    return mechanism, lx.State(np.full(speeds, turn), np.zeros(speeds))


if __name__ == "__main__":
    print_parts(__doc__, {"problems": problems, "rows": rows, "joints": joints, "chains": chains, "rings": rings})
