"""Reading a solution: functions of `Observables` over all its times and members, each kept while the solution lives."""

from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Float, Int

from linkax.equations.internal_states import bound
from linkax.equations.system import system_of
from linkax.formulations.formulation import AbstractFormulation, Dynamics
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.map_saved_times import map_saved_times
from linkax.simulation.integrate.problem import Problem
from linkax.simulation.integrate.results import Solution
from linkax.simulation.read.observables import Observables
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, is_first
from linkax.xla.undefined import infinite_where
from linkax.xla.waiting import compiling
from scalarjit import Flat, kept_while_alive, scalarised


def read_in_motion(function: Callable[..., Any], solution: Solution, *details: Any) -> Any:
    """Read a function that needs v̇ or λ: these are solved by one program for all such functions, and passed in."""
    if (known := solution.known_dynamics) is not None:
        return read(function, solution, *details, dynamics=known)
    flat = solution.run.flat
    if solution.q is not None and all_concrete(solution) and is_first(function, flat.tree.topology, flat.noted):
        with compiling(), ThreadPoolExecutor() as threads:
            given = _asked(solution, Observables.solve, (), ())
            threads.submit(_of_times.lower(*given).compile)
            given = _asked(solution, function, _of_times.blank_result(*given), details)
            threads.submit(_of_times.lower(*given).compile)
    return read(function, solution, *details, dynamics=read(Observables.solve, solution))


def read(function: Callable[..., Any], solution: Solution, *details: Any, dynamics: Dynamics | tuple[()] = ()) -> Any:
    """Evaluate a function of `Observables` at all times of all members of a batch."""
    if solution.q is None:
        raise ValueError("this solution saved functions of its own in ys; simulate without SaveAt(fn=...)")

    def compute():
        return _of_times(*_asked(solution, function, dynamics, details))

    named = all(isinstance(detail, str | int) for detail in details)
    return kept(solution, (function, *details), compute) if named else compute()


def _asked(solution, function, dynamics, details):
    """The arguments of the program that reads."""
    run = solution.run
    states = solution.ts, solution.q, solution.v, solution.internal
    motion = SavedMotion(run.flat, run.formulation, run.tangent_space, solution.rank_nearby, *states)
    return function, motion, dynamics, details


class SavedMotion(NamedTuple):
    """What is read: with another solver or tolerance the same program reads it."""

    flat: Flat[Mechanism]
    formulation: AbstractFormulation
    tangent_space: TangentSpace
    rank_nearby: Int[Array, "*batch k"] | None
    ts: Float[Array, "*batch n_t"]
    q: Float[Array, "*batch n_t n_q"]
    v: Float[Array, "*batch n_t n_v"]
    internal: Float[Array, "*batch n_t n_s"] | None


def kept(solution: Solution, key: Hashable, compute: Callable[[], Any]) -> Any:
    """What `compute` gives, once for a run, while its solution lives: other names and readings ask for the same."""
    if solution.ts.ndim > 1:
        return compute()
    found = _found(solution)
    if key not in found:
        found[key] = compute()
    return found[key]


@kept_while_alive(if_all=lambda leaf: not isinstance(leaf, Tracer))
def _found(solution):
    """What has been read of a solution; of one that is traced, nothing."""
    return {}


@scalarised
def _of_times(function, motion: SavedMotion, dynamics, details):
    def of_member(motion, dynamics, details):
        dtype = motion.q.dtype
        system = system_of(motion.flat, dtype, fixed_scales=False)
        tangent_space = motion.tangent_space.prepared(dtype, motion.rank_nearby)
        method = motion.formulation.prepared(dtype, motion.rank_nearby)

        states = [] if motion.internal is None else [motion.internal]

        def of_time(t, q, v, *others):
            (internal,), dynamics = (others[:1], others[1:]) if states else ((None,), others)
            found = Dynamics(*dynamics) if dynamics else None
            at = Observables(bound(system, internal), method, tangent_space, t, q, v, found, internal)
            return function(at, *details)

        return map_saved_times(of_time, jnp.isfinite(motion.ts), motion.ts, motion.q, motion.v, *states, *dynamics)

    for _ in range(motion.ts.ndim - 1):
        of_member = eqx.filter_vmap(of_member)
    return of_member(motion, dynamics, details)


@eqx.filter_jit
def evaluate_dense(
    flat: Flat[Mechanism],
    formulation: AbstractFormulation,
    accuracy: Accuracy,
    rank_nearby: Int[Array, " k"] | None,
    interpolation: diffrax.DenseInterpolation,
    t: Float[Array, ""],
) -> State:
    dtype = interpolation.t0.dtype
    t = jnp.asarray(t, dtype)
    y = interpolation.evaluate(t)
    system, method = system_of(flat, dtype), formulation.prepared(dtype, rank_nearby)
    state, holds = Problem(flat.tree, system, method, accuracy).close(t, y)
    return infinite_where(jnp.logical_not(holds), state, y)
