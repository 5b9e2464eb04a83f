"""Crank-sliders M1a a second on JAX's default device, by thousands to a million at once: meant for graphics cards.

Ten seconds each, in double precision, at the loosest of linkax's tolerances with which the members that are checked are
within 1e-6 m of their references; the end of the motion, without and with its derivatives by two masses. MJX, in double
precision, and MuJoCo Warp (`pip install mujoco-warp`), in single, take worlds that are alike, at a step of 1e-3 s, as
neither reaches that error. A size is measured where the one before lets expect less than two minutes. `lowering`: what
linkax hands to XLA for a kind of device, which need not be there: operations, loops among them, and calls of libraries.
"""

import importlib
import re
from collections.abc import Callable, Iterator
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.batches import MJX, PROBLEM, cheapest_tolerance, masses, simulated
from benchmarks.evaluation import evaluate
from benchmarks.parts import print_parts
from benchmarks.peers.kinematics import judge
from benchmarks.peers.runs import GaveUp
from benchmarks.problems import PROBLEMS, TIMES
from linkax.equations.system import system_of

SIZES = (1_000, 10_000, 100_000, 1_000_000)
MOST_SECONDS = 120.0
LOWERED = ("M1a", "M3", "M2-10")
PLATFORMS = ("cpu", "cuda")


def _growing(rate_of: Callable[[int], float]) -> Iterator[dict]:
    """Rates of sizes that are expected to take no longer than MOST_SECONDS."""
    rate = np.inf
    for size in SIZES:
        if size / rate > MOST_SECONDS:
            return
        rate = rate_of(size)
        yield {"members": size, "per_second": round(rate, 1)}


def _room() -> dict:
    """Memory for a chunk: two thirds of what JAX may use of the device, where that tells it."""
    told = jax.devices()[0].memory_stats()
    return {"memory": told["bytes_limit"] * 2 / 3} if told else {}


def by_linkax() -> Iterator[dict]:
    """Ends of motions, and these with their derivatives."""
    rtol, error = cheapest_tolerance()
    end = simulated(rtol, diffrax.SaveAt(t1=True))
    slide = lambda numbers: end(numbers).end.q[-1]
    for what, function in (("run", slide), ("run and gradient", jax.value_and_grad(slide))):
        jax.clear_caches()
        swept = lambda size, function=function: lx.sweep(function, masses(size), chunk=size, **_room(), progress=False)
        for row in _growing(lambda size, swept=swept: 1.0 / swept(size).seconds_per_member):
            yield {"what": what, "setting": f"rtol {rtol:g}", "error": error, **row}


def _by_peer(name: str) -> Iterator[dict]:
    worlds, error = PROBLEM.describe(), None
    try:
        peer = importlib.import_module(f"benchmarks.peers.{name}")
    except ModuleNotFoundError as missing:
        yield {"note": f"{missing.name} is not installed"}
        return
    try:
        run = peer.run(worlds, MJX, TIMES)
        error = judge(worlds, TIMES, run.coordinates, run.speeds, PROBLEM.reference())["error"]
    except GaveUp:
        pass  # a single world may take longer than thousands are worth; its error is that of `benchmarks.peers`
    for row in _growing(lambda size: peer.throughput_alike(worlds, size, MJX, TIMES[-1])):
        yield {"what": "run", "setting": f"{MJX.method} {MJX.step:g} s", "error": error, **row}


def lowering() -> Iterator[dict]:
    """Corrected evaluations of a batch, and the run of M1a."""
    programs = {key: _evaluation(key) for key in LOWERED}
    run = simulated(1e-8, diffrax.SaveAt(t1=True))
    programs["M1a, run"] = jax.vmap(lambda numbers: run(numbers).end.q), masses(SIZES[0])
    for name, (function, *given) in programs.items():
        for platform in PLATFORMS:
            text = jax.jit(function).trace(*given).lower(lowering_platforms=(platform,)).as_text()
            calls = sorted(set(re.findall(r"custom_call @(\w+)", text)))
            told = {"operations": text.count("stablehlo."), "loops": text.count("stablehlo.while")}
            yield {"program": name, "platform": platform, **told, "libraries": ", ".join(calls) or "none"}


def _evaluation(key):
    mechanism, state = PROBLEMS[key].start()
    arrays, static = eqx.partition(system_of(mechanism, float), eqx.is_array)
    of_arrays = lambda arrays, q, v: evaluate(eqx.combine(arrays, static), q, v)
    batch = [jnp.tile(array, (SIZES[0], 1)) for array in (state.q, state.v)]
    return jax.vmap(of_arrays, in_axes=(None, 0, 0)), arrays, *batch


if __name__ == "__main__":
    by_peers = {name: partial(_by_peer, name) for name in ("mjx", "warp")}
    print_parts(__doc__, {"linkax": by_linkax, **by_peers, "lowering": lowering})
