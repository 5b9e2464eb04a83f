"""A derivative through a simulation: the crank of M1n after one second by the mass of its rod, whose inertia grows too.

linkax backwards and forwards, alone and in a batch, against MuJoCo's central difference of two runs, and MJX forwards.
Each row: the derivative [rad/kg], milliseconds that it takes after compilation, and that the run alone takes, and
seconds to compile where that is known. Peers at a step of 1e-3 s, as the row says. Times are of this machine, this run:
compare ratios.
"""

import time
from collections.abc import Iterator

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts
from benchmarks.peers import PEERS
from benchmarks.peers.description import Description, describe
from benchmarks.peers.runs import Setting, timed
from benchmarks.problems import PROBLEMS
from linkax.scenes import SCENES

PROBLEM, SCENE = PROBLEMS["M1n"], SCENES["crank-slider"]
MASS, DURATION = 1.0, 1.0
ACCURACY = lx.Accuracy(rtol=1e-7)
TIMES = np.linspace(0.0, DURATION, 21)
DIFFERENCE = 1e-4  # kg
MEMBERS = 80


def _mechanism(mass):
    return SCENE.mechanism(PROBLEM.settings | {"rod_mass": mass})


def _description(mass) -> Description:
    return describe(_mechanism(mass), PROBLEM.start()[1], PROBLEM.tracked, PROBLEM.cuts)


def by_linkax() -> Iterator[dict]:
    """In both modes."""
    _, state = PROBLEM.start()

    angle, mass = _angle(state), jnp.array(MASS)
    _, alone, _ = _timed(angle, mass)
    for mode, derivative in MODES.items():
        (_, slope), seconds, compiling = _timed(derivative(angle), mass)
        told = {"by": "linkax", "mode": mode, "derivative": float(slope), "ms": 1e3 * seconds}
        yield {**told, "run_ms": 1e3 * alone, "compile_s": compiling}


def of_a_batch() -> Iterator[dict]:
    """80 members."""
    _, state = PROBLEM.start()
    masses = jnp.linspace(0.9 * MASS, 1.1 * MASS, MEMBERS)
    angle = _angle(state)
    _, alone, _ = _timed(jax.vmap(angle), masses)
    for mode, derivative in MODES.items():
        _, seconds, compiling = _timed(jax.vmap(derivative(angle)), masses)
        told = {"by": f"linkax, {MEMBERS} members", "mode": mode, "ms": 1e3 * seconds}
        yield {**told, "run_ms": 1e3 * alone, "compile_s": compiling}


def _angle(state):
    """The crank's angle at the end, as a function of the rod's mass."""

    def angle(mass):
        saveat = diffrax.SaveAt(t1=True)
        found = lx.simulate(_mechanism(mass), state, t1=DURATION, accuracy=ACCURACY, saveat=saveat)
        return found.joint("bearing")[-1]

    return angle


def _timed(function, mass):
    """Value, seconds of a run, and seconds to compile it."""
    began = time.perf_counter()
    program = jax.jit(function).lower(mass).compile()
    compiling = time.perf_counter() - began
    program(mass)
    return *timed(lambda: jax.block_until_ready(program(mass))), compiling


def _forwards(function):
    return lambda mass: jax.jvp(function, (mass,), (jnp.ones_like(mass),))


# Function -> its value and derivative.
MODES = {"backwards": jax.value_and_grad, "forwards": _forwards}


def by_mujoco() -> Iterator[dict]:
    """Two runs."""
    setting = next(s for s in PEERS["mujoco"].settings() if s.method.startswith("RK4") and s.step == 1e-3)
    runs = [PEERS["mujoco"].run(_description(MASS + change), setting, TIMES) for change in (DIFFERENCE, -DIFFERENCE)]
    bearing = _bearing(_description(MASS))
    more, less = (run.coordinates[-1, bearing] for run in runs)
    seconds = sum(run.seconds for run in runs)
    told = {
        "by": "mujoco",
        "mode": f"{setting.method} {setting.step:g} s",
        "derivative": (more - less) / 2 / DIFFERENCE,
    }
    yield {**told, "ms": 1e3 * seconds, "run_ms": 1e3 * seconds / 2}


def by_mjx() -> Iterator[dict]:
    """Runge-Kutta steps, and Euler's, which cost less."""
    description = _description(MASS)
    rod = next(index for index, body in enumerate(description.bodies) if body.name == "rod")
    for method in ("RK4", "Euler"):
        setting = Setting(method, 1e-3)
        found, seconds, alone = PEERS["mjx"].mass_derivative(description, setting, DURATION, rod)
        told = {"by": "mjx", "mode": f"{method} 0.001 s", "derivative": float(found[_bearing(description)])}
        yield {**told, "ms": 1e3 * seconds, "run_ms": 1e3 * alone}


def _bearing(description):
    return next(index for index, joint in enumerate(description.tree) if joint.name == "bearing")


if __name__ == "__main__":
    print_parts(__doc__, {"linkax": by_linkax, "batch": of_a_batch, "mujoco": by_mujoco, "mjx": by_mjx})
