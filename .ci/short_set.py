"""What has to hold with any versions: known answers, a gradient, a sweep. Then the time of a run, for each line read.

`.ci/versions` runs it with several versions, with warnings as errors.
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
import jax.numpy as jnp
import numpy as np
from known_answers import PASSING, REDUNDANT, crank_slider

import linkax as lx
from linkax.scenes import SCENES

SCENE, TIMED = SCENES["crank-slider"], REDUNDANT["bricard"]
SETTINGS = SCENE.settings(None, {"rod": 2.0, "angle": np.pi / 4})
MECHANISM = SCENE.mechanism(SETTINGS)
STATE = SCENE.initial(MECHANISM, SETTINGS)
END = 1.0


def end(mass):
    """Where the slider is after a while, by the rod's mass."""
    mechanism = SCENE.mechanism(SETTINGS | {"rod_mass": mass})
    return lx.simulate(mechanism, STATE, t1=END).position("slider")[-1, 0]


def known_end(mass):
    """The same from one equation of the crank's angle."""
    angle, _ = crank_slider(SETTINGS | {"rod_mass": mass}, np.array([0.0, END]))[:, -1]
    crank, rod = SETTINGS["crank"], SETTINGS["rod"]
    return crank * np.cos(angle) + np.sqrt(rod**2 - (crank * np.sin(angle)) ** 2)


def answers():
    for known in (PASSING["SC1"], TIMED):
        assert np.max(known.error(known.simulate())) < 1e-5


def gradient():
    step = 1e-3
    expected = (known_end(1.0 + step) - known_end(1.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(end)(1.0), expected, rtol=1e-4)


def sweep():
    masses = jnp.linspace(0.5, 2.0, 5)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):  # computed, then read from the store
            found = lx.sweep(end, masses, chunk=3, store=Path(folder) / "store").output
            np.testing.assert_allclose(found, [known_end(mass) for mass in np.asarray(masses)], atol=1e-6)


def best_time(runs=10):
    """The least time of a run [s]."""
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(TIMED.simulate().q)
        times.append(time.perf_counter() - begin)
    return min(times)


for part in (sweep, gradient, answers):
    part()
print("holds", flush=True)
for _ in sys.stdin:
    print(best_time(), flush=True)
