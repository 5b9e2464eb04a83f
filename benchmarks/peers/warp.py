"""MuJoCo Warp, MuJoCo on graphics cards, in single precision: the same soft constraints, many worlds at once."""

import mujoco
import mujoco_warp
import numpy as np
import warp

from benchmarks.peers.description import Description
from benchmarks.peers.mjcf import model_of, places
from benchmarks.peers.runs import Deadline, Run, Setting, steps_between, timed

DECAY_STEPS = 2.0  # time in which gaps of loops decay


def run(description: Description, setting: Setting, times) -> Run:
    """One trajectory."""
    every = steps_between(times, setting.step)
    _worlds(description, setting, 1)[0](1)  # compiles

    def simulate():
        advance, data, order = _worlds(description, setting, 1)
        deadline, found = Deadline(), []
        for t in times:
            found.append((data.qpos.numpy()[0, order], data.qvel.numpy()[0, order]))
            advance(every)
            deadline.check(t)
        return [np.array(part) for part in zip(*found, strict=True)]

    found, seconds = timed(simulate)
    return Run(*found, seconds)


def throughput_alike(description: Description, count: int, setting: Setting, duration: float) -> float:
    """Trajectories of a duration [s] per second, of worlds that are alike."""
    advance, data, _ = _worlds(description, setting, count)
    advance(1)  # compiles

    def simulate():
        advance(round(duration / setting.step))
        data.qpos.numpy()

    return count / timed(simulate)[1]


def _worlds(description, setting, count):
    """A function that takes steps in all worlds, their data, and where the description's coordinates are."""
    # Of the flags that `model_of` sets Warp knows no other.
    flags = {"disableflags": mujoco.mjtDisableBit.mjDSBL_CONTACT}
    model = model_of(description, setting.method, setting.step, DECAY_STEPS, **flags)
    start, order = mujoco.MjData(model), places(model, description)
    start.qvel[order] = description.speeds
    mujoco.mj_forward(model, start)
    on_device = mujoco_warp.put_model(model)
    data = mujoco_warp.put_data(model, start, nworld=count)
    step = lambda: mujoco_warp.step(on_device, data)
    if warp.get_device().is_cuda:
        with warp.ScopedCapture() as captured:
            step()
        step = lambda: warp.capture_launch(captured.graph)

    def advance(steps):
        for _ in range(steps):
            step()
        warp.synchronize()

    return advance, data, order
