"""What a first run waits for: tracing and compiling, BALANCED unless named.

first-runs: `linkax.assemble` (all that a scene does for its start), `linkax.simulate` over 10 s and the reaction of a
joint: by how much the first of equal runs takes longer than the others; `run_ms` is `simulate` alone, once compiled.
Then what is asked besides, each for the first time: energy, passages, error estimate. floor: diffrax alone, an equation
of two states. gradient: likewise the derivative of M1n's end after 1 s by the mass of its rod, with the assembly of its
start and from a given start; and `linkax.fit` of two masses of M1n to its motion. programs: compiled as one each,
simulations and their gradients: the crank-slider SC1 over 10 s; Bricard's mechanism over 1 s; and a row of four
four-bars over 1 s with twenty parameters: masses and inertias of nine bodies, gravity, angle at the start. processes:
wall time of whole processes, medians: imports, answers of the command line, and the README's crank-slider from the
start of Python to a reaction, for the first time and with the programs that an earlier process has kept.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts
from benchmarks.problems import PROBLEMS
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
REPEATS = 7
FIRST_RUNS = (("crank-slider", {}), ("bricard", {}), *(("n-four-bar", {"N": count}) for count in (5, 10, 20, 40)))


PROCESSES = {
    "import jax, diffrax": "import jax, diffrax",
    "import linkax": "import linkax",
    **{
        f"linkax {asked}": f"import linkax_command; linkax_command.run({asked.split()})"
        for asked in ("list", "simulate crank-slidr")
    },
}
CRANK_SLIDER = """
import sys
import jax, jax.numpy as jnp, linkax as lx
lx.cache_programs(sys.argv[1])
crank, rod = lx.rod("crank", length=1.0, mass=1.0), lx.rod("rod", length=1.5, mass=1.0)
slider = lx.point_mass("slider", mass=1.0)
joints = [
    lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
    lx.Revolute("crank_pin", crank.at("tip"), rod.at("base"), axis="z"),
    lx.Revolute("wrist_pin", rod.at("tip"), slider, axis="z"),
    lx.Prismatic("guide", lx.GROUND, slider, axis="x"),
]
mechanism = lx.Mechanism([crank, rod, slider], joints, [lx.Gravity([0.0, -9.81, 0.0])])
state = lx.assemble(mechanism, {"bearing": jnp.pi / 4}, {"bearing": 0.0})
jax.block_until_ready(lx.simulate(mechanism, state, t1=2.0).reaction("wrist_pin"))
"""


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
    run_s = least(lambda: compiled(*arguments))
    return {"trace_s": round(traced - began, 2), "compile_s": round(ready - traced, 2), "run_ms": milliseconds(run_s)}


def milliseconds(seconds):
    return round(1e3 * seconds, 2)


def seconds_of(run):
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def least(run):
    return min(seconds_of(run) for _ in range(REPEATS))


def first_run(name, changes):
    jax.clear_caches()
    scene = SCENES[name]
    settings = scene.settings(None, changes)
    mechanism = scene.mechanism(settings)
    assemble = lambda: scene.initial(mechanism, settings)
    simulate = lambda: lx.simulate(mechanism, assemble(), t1=10.0)
    read = lambda: simulate().reaction(mechanism.topology.joints[0])
    stages = {"assemble_s": assemble, "simulate_s": lambda: simulate().q, "reaction_s": read}
    waits, ran = {}, {}
    for stage, run in stages.items():
        first, ran[stage] = seconds_of(run), least(run)
        waits[stage] = round(first - ran[stage], 2)
    run_ms = milliseconds(ran["simulate_s"] - ran["assemble_s"])
    solution = simulate()
    asked = {"energy_s": solution.energy, "passages_s": solution.passages, "error_s": solution.error_estimate}
    questions = {question: round(seconds_of(answer), 2) for question, answer in asked.items()}
    sum_s = round(sum(waits.values()), 2)
    return {"scene": name, **changes, **waits, "sum_s": sum_s, "run_ms": run_ms, **questions}


def first_runs():
    yield from (first_run(name, changes) for name, changes in FIRST_RUNS)


def floor():
    """Diffrax alone, on a pendulum's equation."""
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -args * jnp.sin(y[0])]))
    control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
    run = lambda: diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0.0, 10.0, 0.01, jnp.ones(2), 9.81, stepsize_controller=control
    )
    jax.clear_caches()
    first, then = seconds_of(lambda: run().ys), least(lambda: run().ys)
    yield {"floor": "diffrax, two states", "first_s": round(first - then, 2), "run_ms": milliseconds(then)}


def gradients():
    settings = PROBLEMS["M1n"].settings
    _, start = PROBLEMS["M1n"].start()

    def end(rod_mass, given=None):
        mechanism = SCENE.mechanism(settings | {"rod_mass": rod_mass})
        state = SCENE.initial(mechanism, settings) if given is None else given
        return lx.simulate(mechanism, state, t1=1.0, saveat=diffrax.SaveAt(t1=True)).end.q[0]

    for name, given in (("with its assembly", None), ("from a given start", start)):
        jax.clear_caches()
        run = partial(jax.grad(end), 1.0, given)
        first, then = seconds_of(run), least(run)
        yield {"gradient": name, "first_s": round(first - then, 2), "run_ms": milliseconds(then)}
    yield {"fit": "of two masses", **_fit(settings)}


def _fit(settings):
    def angles(masses):
        mechanism = SCENE.mechanism(settings | masses)
        return lx.simulate(mechanism, SCENE.initial(mechanism, settings), t1=1.0).q[:, 0]

    true = {"crank_mass": 1.0, "rod_mass": 1.5}
    measured = angles(true) + 1e-3 * np.random.default_rng(0).normal(size=201)
    residual = lambda masses, measured: angles(masses) - measured
    run = lambda: lx.fit(residual, {"crank_mass": 0.8, "rod_mass": lx.Positive(1.2)}, (measured,), progress=False).loss
    jax.clear_caches()
    first, then = seconds_of(run), least(run)
    return {"first_s": round(first - then, 2), "run_ms": milliseconds(then)}


def programs():
    numbers = {name: jnp.asarray(1.0) for name in ("crank_mass", "rod_mass", "slider_mass")}
    bricard = {name: jnp.asarray(1.0) for name in ("length", "mass")}
    settings = SCENES["n-four-bar"].settings(None, {"N": 4})
    twenty = jnp.asarray([settings["gravity"], settings["angle"], *[1.0] * 18])
    last = {}
    for name, function, given in (
        ("simulate, BALANCED", lambda numbers: motion(numbers, lx.BALANCED), numbers),
        ("simulate, PRECISE", lambda numbers: motion(numbers, lx.PRECISE), numbers),
        ("gradient", jax.grad(lambda numbers: motion(numbers, lx.BALANCED)[-1, 1]), numbers),
        ("Bricard", of_bricard, bricard),
        ("Bricard, gradient", jax.grad(of_bricard), bricard),
        ("20 parameters", of_twenty, twenty),
        ("20 parameters, gradient", jax.grad(of_twenty), twenty),
    ):
        last[name] = staged(function, given)
        yield {"program": name, **last[name]}
    ratio = last["20 parameters, gradient"]["run_ms"] / last["20 parameters"]["run_ms"]
    yield {"program": "20 parameters, gradient over run", "ratio": round(ratio, 1)}


def processes():
    settings = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE", "EQX_ON_ERROR")
    environment = {name: value for name, value in os.environ.items() if name not in settings}

    def seconds(program, *arguments):
        command = [sys.executable, "-c", program, *arguments]
        return seconds_of(lambda: subprocess.run(command, capture_output=True, env=environment, check=True).returncode)

    # By turns, since others may use the machine.
    waits = [{name: seconds(program) for name, program in PROCESSES.items()} for _ in range(REPEATS)]
    for name in PROCESSES:
        yield {"process": name, "wall_s": round(statistics.median(wait[name] for wait in waits), 2)}
    with tempfile.TemporaryDirectory() as folder:
        yield {"process": "crank-slider, for the first time", "wall_s": round(seconds(CRANK_SLIDER, folder), 2)}
        again = statistics.median(seconds(CRANK_SLIDER, folder) for _ in range(REPEATS))
        yield {"process": "crank-slider, again", "wall_s": round(again, 2)}


if __name__ == "__main__":
    parts = {
        "first-runs": first_runs,
        "floor": floor,
        "gradient": gradients,
        "programs": programs,
        "processes": processes,
    }
    print_parts(__doc__, parts)
