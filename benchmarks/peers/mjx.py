"""MJX, MuJoCo in JAX: the same soft constraints, but for the part J̇v of the loops' accelerations, which it leaves out.

Compiled in double precision, since importing linkax asks JAX for it. Batches are by `jax.vmap`, derivatives forwards.
"""

import contextlib
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from benchmarks.peers.description import Description
from benchmarks.peers.mjcf import model_of, places
from benchmarks.peers.runs import Deadline, Run, Setting, steps_between, timed

with contextlib.redirect_stdout(sys.stderr):  # where it tells of packages that it does without
    from mujoco import mjx

METHODS = ("RK4", "Euler")  # integrators
# Loops alone make a quadratic problem, which Newton's method solves at once; a fixed count is unrolled, and quicker.
ONCE = {"iterations": 1, "ls_iterations": 4}
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4)
DECAY_STEPS = 2.0  # time in which gaps of loops decay
PIECE = 20  # samples at once


def settings() -> list[Setting]:
    """From coarse to fine, method by method."""
    return [Setting(method, step) for method in METHODS for step in STEPS]


def run(description: Description, setting: Setting, times) -> Run:
    """One trajectory; steps of one method share a compiled program."""
    model, start, order = _start(description, setting)
    every = steps_between(times, setting.step)
    _sample(model, start, 0)

    def simulate():
        deadline, data = Deadline(), start
        states = [(start.qpos[None], start.qvel[None])]
        for t in times[:-1:PIECE]:
            deadline.check(t)
            data, found = jax.block_until_ready(_sample(model, data, every))
            states.append(found)
        return [np.concatenate(part)[: len(times), order] for part in zip(*states, strict=True)]

    found, seconds = timed(simulate)
    return Run(*found, seconds)


def throughput(descriptions: list[Description], setting: Setting, duration: float) -> float:
    """Trajectories of a duration [s] per second, of mechanisms that differ in numbers and start only."""
    models, starts, _ = zip(*(_start(description, setting) for description in descriptions), strict=True)
    models, starts = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (models, starts))
    return _rate(_ends, models, starts, len(descriptions), round(duration / setting.step))


def throughput_alike(description: Description, count: int, setting: Setting, duration: float) -> float:
    """Trajectories of a duration [s] per second, of worlds that are alike."""
    model, start, _ = _start(description, setting)
    starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), start)
    return _rate(_ends_alike, model, starts, count, round(duration / setting.step))


def _rate(ends, models, starts, count, steps):
    """Trajectories of so many steps per second."""
    simulate = lambda steps: jax.block_until_ready(ends(models, starts, steps))
    simulate(0)
    return count / timed(lambda: simulate(steps))[1]


def mass_derivative(
    description: Description, setting: Setting, duration: float, body: int
) -> tuple[np.ndarray, float, float]:
    """Of the coordinates after a duration [s] by the mass of a body, whose inertia grows with it, (n,) [1/kg].

    **Returns:** the derivative, the seconds that it took forwards, with the coordinates, and those of the coordinates
    alone.
    """
    model, start, order = _start(description, setting)
    steps, mass = round(duration / setting.step), description.bodies[body].mass
    index = _model(description, setting).body(description.bodies[body].name).id

    @jax.jit
    def end(mass, steps):
        heavier = {
            "body_mass": model.body_mass.at[index].set(mass),
            "body_inertia": model.body_inertia.at[index].multiply(mass / model.body_mass[index]),
        }
        return _advance(model.tree_replace(heavier), start, steps).qpos[order]

    derivative = jax.jit(lambda steps: jax.jvp(lambda mass: end(mass, steps), (mass,), (1.0,)))
    jax.block_until_ready((end(mass, 0), derivative(0)))
    _, alone = timed(lambda: jax.block_until_ready(end(mass, steps)))
    (_, found), seconds = timed(lambda: jax.block_until_ready(derivative(steps)))
    return np.asarray(found), seconds, alone


def _model(description, setting):
    return model_of(description, setting.method, setting.step, DECAY_STEPS, **ONCE)


def _start(description, setting):
    """Model and state as MJX takes them, and where the description's coordinates are."""
    model = _model(description, setting)
    data, order = mujoco.MjData(model), places(model, description)
    data.qvel[order] = description.speeds
    return mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax"), order


def _advance(model, data, steps):
    return jax.lax.fori_loop(0, steps, lambda _, data: mjx.step(model, data), data)


@jax.jit
def _sample(model, data, every):
    """The state after `PIECE` times `every` steps, and coordinates and speeds after each of these times."""

    def sample(data, _):
        data = _advance(model, data, every)
        return data, (data.qpos, data.qvel)

    return jax.lax.scan(sample, data, length=PIECE)


def _end(model, start, steps):
    return _advance(model, start, steps).qpos


_ends = jax.jit(jax.vmap(_end, in_axes=(0, 0, None)))
_ends_alike = jax.jit(jax.vmap(_end, in_axes=(None, 0, None)))
