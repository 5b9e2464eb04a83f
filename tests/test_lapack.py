"""No program calls LAPACK for a batch on a CPU, as such calls may wait for each other for ever; and in one thread."""

import dataclasses
import json
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import start
from mechanisms import crank_slider

import linkax as lx
from linkax.equations.system import system_of
from linkax.formulations.named import COMPARED, TANGENT_SPACE, formulation
from linkax.simulation.read.passages import between_states

COUNT = 3
THREADS = """
import json, jax, linkax, threadpoolctl
jax.numpy.linalg.cholesky(jax.numpy.eye(3))
libraries = threadpoolctl.ThreadpoolController().select(user_api="blas").info()
print(json.dumps({"numpy" in library["filepath"]: library["num_threads"] for library in libraries}))
"""


def batched_calls(function, *args):
    """Calls of LAPACK and BLAS for more than one matrix in the lowered program."""
    text = eqx.filter_jit(function).lower(*args).as_text()
    calls = [line for line in text.splitlines() if "@lapack_" in line or "@blas_" in line]
    return [line for line in calls if 'num_batch_dims = "0"' not in line]


def in_a_batch(function, mechanism, state):
    """A function of a mechanism and a state for members that differ in all of their numbers."""
    dynamic, static = eqx.partition((mechanism, state), eqx.is_inexact_array)
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf] * COUNT), dynamic)
    member = lambda dynamic: eqx.filter(function(*eqx.combine(dynamic, static)), eqx.is_array)
    return jax.vmap(member), stacked


def times(mechanism, state, count):
    """A solution with one state at many times."""
    solution = lx.Solution.of_state(mechanism, state)
    q, v = (jnp.tile(part, (count, 1)) for part in (solution.q, solution.v))
    return dataclasses.replace(solution, ts=jnp.linspace(0.0, 1.0, count), q=q, v=v)


@pytest.fixture(scope="module")
def large():
    """Twenty four-bars, with more speeds than elimination serves."""
    return start("n-four-bar", "A02", {"N": 20})


@pytest.mark.skipif(os.cpu_count() == 1, reason="one thread in any case")
@pytest.mark.parametrize(("environment", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_lapack_uses_one_thread_unless_the_environment_says_otherwise(environment, threads):
    others = {name: value for name, value in os.environ.items() if not name.endswith("NUM_THREADS")}
    told = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, env=others | environment)
    assert told.returncode == 0, told.stderr
    of_numpy = json.loads(told.stdout)
    assert of_numpy["false"] == threads
    assert of_numpy.get("true", 2) > 1


def test_the_test_sees_them():
    assert batched_calls(jax.vmap(jnp.linalg.cholesky), jnp.stack([jnp.eye(3)] * COUNT))


@pytest.mark.slow
def test_passages(large):
    mechanism, state = large
    pairs = (jnp.tile(part, (COUNT, 2, 1)) for part in (state.q, state.v))
    ts, places, there = jnp.tile(jnp.array([0.0, 1.0]), (COUNT, 1)), jnp.ones(COUNT), jnp.ones(COUNT, bool)
    assert not batched_calls(between_states, mechanism, lx.TangentSpace(), None, there, ts, *pairs, places)


READINGS = {
    "reactions": lambda solution: (solution.reactions(), solution.reaction_unique("pivot_0")),
    "states": lambda solution: (solution.rank(), solution.singularity_distance(), solution.worst_violation()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", READINGS)
def test_readings(large, name):
    assert not batched_calls(READINGS[name], times(*large, 41))


IDENTITY = lx.TangentSpace(metric="identity")
MEMBERS = {
    "assemble": lambda mechanism, state: lx.assemble(mechanism),
    "simulate": lambda mechanism, state: lx.simulate(mechanism, state, t1=1.0),
    "identity metric": lambda mechanism, state: lx.simulate(mechanism, state, t1=1.0, formulation=IDENTITY),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEMBERS)
def test_batches(large, name):
    assert not batched_calls(*in_a_batch(MEMBERS[name], *large))


ANALYSES = {
    "equilibrium": lx.equilibrium,
    "linearise": lambda mechanism, state: lx.linearise(mechanism, state, degrees_of_freedom=1),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ANALYSES)
def test_analyses(name):
    mechanism = crank_slider(rod=1.6)
    state = lx.assemble(mechanism, {"bearing": -np.pi / 2})
    assert not batched_calls(*in_a_batch(ANALYSES[name], mechanism, state))


@pytest.mark.parametrize("name", [name for name in COMPARED if name != TANGENT_SPACE])
def test_classical_formulations(name):
    method, mechanism = formulation(name), crank_slider(rod=1.6)

    def dynamics(mechanism, state):
        system = system_of(mechanism, jnp.float64)
        return method.dynamics(system, 0.0, state.q, state.v), method.close(system, 0.0, state.q, state.v)

    assert not batched_calls(*in_a_batch(dynamics, mechanism, lx.assemble(mechanism, {"bearing": 0.5})))
