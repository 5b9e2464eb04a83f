"""Interpolate a motion between its saved times."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.coordinates import on_manifold, rates, speeds
from linkax.model.numbers import Number, Vector, is_finite, real, require
from linkax.model.topology import Topology
from linkax.simulation.integrate.results import Solution
from linkax.simulation.read.observables import Observables
from linkax.simulation.read.reading import read, read_in_motion
from linkax.xla.tracing import concrete, jit_inline
from linkax.xla.undefined import infinite_where

ROUNDING = 1e-9  # of the time between the first and the last saved one: how far beyond them a time may lie


def motion_at(solution: Solution, ts: Number | Vector | list[Number]) -> Solution:
    """The same motion at other times; see `Solution.at`.

    **Raises:** `ValueError` for times that are not those of the motion, and for a solution of one time.
    """
    what, shape = "times [s]", solution.ts.shape
    times = jnp.atleast_1d(jnp.asarray(real(ts, what)))
    if times.shape[:-1] not in ((), shape[:-1]):
        batch = f", or {(*shape[:-1], 'n')} of a batch" if shape[:-1] else ""
        raise ValueError(f"{what} have shape {times.shape}; give (n,) times{batch}")
    if not times.size:
        raise ValueError(f"{what} have shape {times.shape}, and a solution at no time says nothing; give at least one")
    if shape[-1] < 2:
        raise ValueError("this solution has one time, and no motion between times; simulate, and save several times")
    saved, asked = concrete(solution.ts), concrete(times)
    if saved is not None and asked is not None:
        _check_within(asked, saved)
    return _closed(_between(solution, times))


def motion_between(solution: Solution, places: Float[np.ndarray, " k"]) -> Solution:
    """The same motion at places in [0, 1] between all saved times, k each; infinity where these were not reached."""
    first, last = solution.ts[..., :-1, None], solution.ts[..., 1:, None]
    ts = first + jnp.asarray(places, solution.ts.dtype) * (last - first)
    return _between(solution, ts.reshape(*solution.ts.shape[:-1], -1))


def _check_within(asked, saved):
    """Raise a ValueError where a time is none of a motion, or of one of a batch."""
    require(asked, is_finite, "times [s]", "they must be finite")
    reached = np.where(np.isfinite(saved), saved, -np.inf)
    first, last = saved[..., :1], np.max(reached, axis=-1, keepdims=True)
    beyond = ROUNDING * (last - first)
    outside = (asked < first - beyond) | (asked > last + beyond)
    if np.any(outside):
        number = np.broadcast_to(asked, outside.shape)[outside][0]
        raise ValueError(
            f"time {number:.6g} s is outside of the saved motion, from {np.max(first):.6g} s to {np.min(last):.6g} s; "
            "simulate longer, or save its first and last time"
        )


def _closed(motion):
    """A motion between saved times on its loops; infinite, and where it is one alone an error, where none are near."""
    if not motion.formulation.checks_loops(motion.mechanism.topology):
        return motion
    q, v, holds = read(Observables.closed, motion)
    there = jnp.isfinite(motion.ts)
    known = concrete(there & jnp.logical_not(holds)) if motion.ts.ndim == 1 else None
    if known is not None and np.any(known):
        raise ValueError(
            f"between its saved times this motion is not known at t = {float(motion.ts[known][0]):.6g} s, where the "
            "state between them lies far off the loops; save more often"
        )
    q, v = infinite_where(jnp.logical_not(holds), (q, v), (motion.q, motion.v))
    return dataclasses.replace(motion, q=q, v=v)


def _between(solution, ts):
    acceleration = read(Observables.solve, solution).acceleration
    states = solution.ts, solution.q, solution.v, acceleration
    if solution.internal is not None:
        states = *states, solution.internal, *read_in_motion(Observables.internal_changes, solution)
    ts, q, v, *internal = _interpolated(solution.mechanism.topology, ts.astype(solution.ts.dtype), *states)
    record = None if solution.impact_record is None else _of_impacts(solution, ts)
    internal = internal[0] if internal else None
    return dataclasses.replace(solution, ts=ts, q=q, v=v, internal=internal, impact_record=record)


def _of_impacts(solution, ts):
    """The record of impacts at times: that of the last saved time before."""
    before = lambda saved, record, t: record[jnp.maximum(jnp.searchsorted(saved, t, side="right") - 1, 0)]
    found = jnp.vectorize(before, signature="(k),(k,a,b),(n)->(n,a,b)")(solution.ts, solution.impact_record, ts)
    return jnp.where(jnp.isfinite(ts)[..., None, None], found, jnp.inf)


@jit_inline
def _interpolated(topology: Topology, ts, *states):
    of_member = lambda ts, *states: _of_member(topology, ts, states)
    for _ in range(states[0].ndim - 1):
        of_member = jax.vmap(of_member, in_axes=(0 if ts.ndim > 1 else None, *(0,) * len(states)))
    return of_member(ts, *states)


def _of_member(topology, ts, states):
    """Times, coordinates, speeds, internal states at times of one motion; infinity at those that it did not reach."""
    saved = states[0]
    index = jnp.clip(jnp.searchsorted(saved, ts) - 1, 0, len(saved) - 2)
    first, last = saved[0], jnp.max(jnp.where(jnp.isfinite(saved), saved, -jnp.inf))
    beyond = ROUNDING * (last - first)
    within = (ts >= first - beyond) & (ts <= last + beyond)
    # The last interval that was reached, for a time that rounding puts beyond it.
    index = jnp.where(jnp.isfinite(saved[index + 1]), index, jnp.maximum(index - 1, 0))
    within &= jnp.isfinite(saved[index + 1])
    # Numbers for what is not within, without which derivatives of the others were not numbers.
    finite = [jnp.where(jnp.isfinite(part), part, 0.0) for part in states]
    before, later = ([part[at] for part in finite] for at in (index, index + 1))
    found = jax.vmap(lambda *given: _at(topology, *given))(jnp.where(within, ts, 0.0), before, later)
    return infinite_where(jnp.logical_not(within), [*found], (ts, states))


def _at(topology, t, before, later) -> tuple[Any, ...]:
    """The state at a time between two states, by the polynomial of degree five through q, q̇ and q̈ at both; internal
    states likewise.
    """
    rate = lambda q, v: rates(topology, q, v)
    curve = lambda q, v, acceleration: jax.jvp(rate, (q, v), (rate(q, v), acceleration))
    (start, q, v, acceleration, *internal), (end, q1, v1, acceleration1, *internal1) = before, later
    h = jnp.where(end > start, end - start, 1.0)
    path = _quintic(h, (q, *curve(q, v, acceleration)), (q1, *curve(q1, v1, acceleration1)))
    place = lambda s: on_manifold(topology, path(s))
    s = (t - start) / h
    here, along = jax.jvp(place, (s,), (jnp.ones_like(s),))
    states = [_quintic(h, internal, internal1)(s)] if internal else []
    return t, here, speeds(topology, here, along / h), *states


def _quintic(h, before, later):
    """The polynomial of s in [0, 1] through values and their first two derivatives by time at both ends, h apart."""
    (q, slope, bend), (q1, slope1, bend1) = before, later
    first, second = h * slope, h**2 * bend / 2.0
    moved, faster, bent = q1 - q - first - second, h * slope1 - first - 2.0 * second, h**2 * (bend1 - bend)
    third, fourth, fifth = (
        10.0 * moved - 4.0 * faster + bent / 2.0,
        -15.0 * moved + 7.0 * faster - bent,
        6.0 * moved - 3.0 * faster + bent / 2.0,
    )
    return lambda s: q + s * (first + s * (second + s * (third + s * (fourth + s * fifth))))
