"""MuJoCo, in C: loops are soft constraints, stiff enough to decay within a few steps, of any redundancy."""

import mujoco
import numpy as np
from mujoco.rollout import Rollout

from benchmarks.peers.description import Description
from benchmarks.peers.mjcf import model_of, places
from benchmarks.peers.runs import Deadline, Run, Setting, steps_between, timed

# Integrator, and the decay time of loops in steps.
METHODS = {
    "RK4 stiff": ("RK4", 2.0),
    "Euler stiff": ("Euler", 2.0),
    "implicitfast stiff": ("implicitfast", 2.0),
    "RK4 default": ("RK4", None),
}
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
PIECE = 1000  # steps at once, as all of their states are kept


def settings() -> list[Setting]:
    """From coarse to fine, method by method."""
    return [Setting(method, step) for method in METHODS for step in STEPS]


def run(description: Description, setting: Setting, times) -> Run:
    """One trajectory, in one thread."""
    model = _model(description, setting)
    every = steps_between(times, setting.step)

    def simulate():
        data, deadline = mujoco.MjData(model), Deadline()
        states = [_start(model, description)[None]]
        with Rollout(nthread=0) as rollout:
            for ahead in np.array_split(times[1:], np.ceil(every * (len(times) - 1) / PIECE)):
                warm, steps = data.qacc_warmstart.copy()[None], every * len(ahead)
                found, _ = rollout.rollout(model, data, states[-1][-1:], nstep=steps, initial_warmstart=warm)
                states.append(found[0, every - 1 :: every])
                deadline.check(ahead[-1])
        return np.concatenate(states)

    states, seconds = timed(simulate)
    order, width = places(model, description), model.nq
    return Run(states[:, 1 : 1 + width][:, order], states[:, 1 + width : 1 + 2 * width][:, order], seconds)


def throughput(descriptions: list[Description], setting: Setting, duration: float, threads: int) -> float:
    """Trajectories of a duration [s] per second, of mechanisms that differ in numbers and start only."""
    models = [_model(description, setting) for description in descriptions]
    pairs = zip(models, descriptions, strict=True)
    start = np.array([_start(model, description) for model, description in pairs])
    workers = [mujoco.MjData(models[0]) for _ in range(threads)]
    steps = round(duration / setting.step)

    def simulate():
        states, left = start, steps
        with Rollout(nthread=threads) as rollout:
            while left > 0:
                found, _ = rollout.rollout(models, workers, states, nstep=min(left, PIECE))
                states, left = found[:, -1], left - PIECE

    return len(descriptions) / timed(simulate)[1]


def _model(description, setting):
    integrator, decay_steps = METHODS[setting.method]
    return model_of(description, integrator, setting.step, decay_steps)


def _start(model, description):
    """The state as `Rollout` takes it: time, coordinates, speeds."""
    data = mujoco.MjData(model)
    data.qvel[places(model, description)] = description.speeds
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return state
