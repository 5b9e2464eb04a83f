"""Compile the function of a sweep for many members at once, on one or several devices."""

import os
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from linkax.simulation.integrate.results import KNOWN_RESULTS, RESULTS
from linkax.studies.parameters.fingerprint import fingerprint
from linkax.studies.sweeps.sweep_result import FINE, NOT_FINITE_OUTPUT, REASONS
from linkax.xla.enumerations import code, is_item


class Plan(NamedTuple):
    """What is known of a program, wherever it runs.

    - `size`: members that it computes together. `outputs`: shapes of one member's arrays.
    - `fingerprint`: of its text before compilation, the same for the same function.
    """

    size: int
    outputs: Any
    fingerprint: str


class SweepProgram(NamedTuple):
    """The function, compiled for `size` members at once: a batch of params -> (outputs, reasons).

    - `fingerprint`: see `Plan`. `calls_lapack`: whether it calls LAPACK for batches.
    """

    run: Callable
    size: int
    fingerprint: str
    calls_lapack: bool

    @property
    def workers(self) -> int:
        """The number of chunks that are computed at once.

        Programs that run at once on a CPU and call LAPACK for batches can block each other for ever (jaxlib 0.10: the
        calls wait for threads of the pool that they run in). linkax makes no such call, see `linkax.xla.batches`.
        """
        if jax.default_backend() != "cpu":
            return 2  # one is computed while the results of another are copied
        return 1 if self.calls_lapack else _cores()

    @staticmethod
    def compiled(function: Callable, one: Any, chunk: int, memory: int | float, devices: list) -> "SweepProgram":
        """Compile for parameters of one member like `one`, in no more than `memory`."""
        while True:
            size = chunk * len(devices)
            batch = jax.tree.map(lambda leaf, size=size: jax.ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), one)
            with jax.default_device(devices[0]):
                lowered = jax.jit(_spread(jax.vmap(_member(function)), devices)).lower(batch)
                text = lowered.as_text()
                calls_lapack = _calls_lapack_for_batches(text)
                if len(devices) > 1 and devices[0].platform == "cpu" and calls_lapack:
                    devices = devices[:1]
                    continue
                run = lowered.compile()
            used = _memory(run)
            if used <= memory or chunk == 1:
                return SweepProgram(run, size, fingerprint(text, []), calls_lapack)
            chunk = max(1, int(0.9 * chunk * memory / used))


def is_struct(leaf: Any) -> bool:
    """Whether a leaf is the shape of an array."""
    return isinstance(leaf, jax.ShapeDtypeStruct)


def _is_result(node):
    return is_item(node, RESULTS)


def _member(function):
    """A function of one member's params -> the arrays of its output, and how it ended, as an index into `REASONS`."""

    def run(params):
        output = function(params)
        arrays, _ = eqx.partition(output, eqx.is_array)
        results = [node for node in jax.tree.leaves(output, is_leaf=_is_result) if _is_result(node)]
        numbers = [leaf for leaf in jax.tree.leaves(arrays) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
        # Of a run with a result, times that were not reached hold infinity.
        is_spoiled = jnp.isnan if results else lambda leaf: jnp.logical_not(jnp.isfinite(leaf))
        spoiled = jnp.array([jnp.any(is_spoiled(leaf)) for leaf in numbers]).any()
        reasons = jnp.concatenate([*(jnp.ravel(_reason(result)) for result in results), jnp.zeros(1, jnp.int8)])
        failed = jnp.logical_not(jnp.isin(reasons, jnp.array(FINE)))
        # The first failure, or where there is none, the first result.
        reason = reasons[jnp.argmax(failed)]
        return arrays, jnp.where(spoiled & jnp.logical_not(jnp.any(failed)), NOT_FINITE_OUTPUT, reason).astype(jnp.int8)

    return run


def _reason(result):
    """The index into `REASONS` of a `RESULTS`."""
    reason = jnp.full(jnp.shape(code(result)), REASONS.index("failed"), jnp.int8)
    for index, name in enumerate(KNOWN_RESULTS):
        reason = jnp.where(result == getattr(RESULTS, name), index, reason).astype(jnp.int8)
    return reason


def _spread(mapped, devices):
    """A function of a batch that computes an equal part of it on each device; no device waits for another."""
    if len(devices) == 1:
        return mapped
    members = PartitionSpec("members")
    mesh = Mesh(np.array(devices), ("members",))
    return jax.shard_map(mapped, mesh=mesh, in_specs=(members,), out_specs=members, check_vma=False)


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _calls_lapack_for_batches(text) -> bool:
    calls = (line for line in text.splitlines() if "@lapack_" in line or "@blas_" in line)
    return any('num_batch_dims = "0"' not in line for line in calls)


def _memory(compiled) -> int:
    """Bytes that a program needs on one device; 0 where the compiler does not tell."""
    sizes = compiled.memory_analysis()
    if sizes is None:
        return 0
    return sizes.temp_size_in_bytes + sizes.argument_size_in_bytes + sizes.output_size_in_bytes
