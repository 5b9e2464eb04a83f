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
from known_answers import PASSING, REDUNDANT, known_slider_end, slider_end, slider_start

import linkax as lx

TIMED = REDUNDANT["bricard"]


def answers():
    for known in (PASSING["SC1"], TIMED):
        assert np.max(known.error(known.simulate())) < 1e-5


def gradient():
    step = 1e-3
    expected = (known_slider_end(1.0 + step) - known_slider_end(1.0 - step)) / (2.0 * step)
    np.testing.assert_allclose(jax.grad(slider_end)(1.0), expected, rtol=1e-4)


def sweep():
    masses = jnp.linspace(0.5, 2.0, 5)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):  # computed, then read from the store
            found = lx.sweep(slider_end, masses, chunk=3, store=Path(folder) / "store").output
            np.testing.assert_allclose(found, [known_slider_end(mass) for mass in np.asarray(masses)], atol=1e-6)


def best_time(runs=10):
    """The least time of a run [s]."""
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        jax.block_until_ready(TIMED.simulate().q)
        times.append(time.perf_counter() - begin)
    return min(times)


slider_start()
for part in (sweep, gradient, answers):
    part()
print("holds", flush=True)
for _ in sys.stdin:
    print(best_time(), flush=True)
