"""Work of force elements and drives over a motion, between its saved times too."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.coordinates import rates, speeds
from linkax.model.names import ByName
from linkax.model.topology import Topology
from linkax.simulation.integrate.results import Solution
from linkax.simulation.read.observables import Observables, do_work
from linkax.simulation.read.reading import read, read_in_motion
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline

# Gauss's rule on [0, 1], exact to the fifth power.
PLACES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


def work(solution: Solution) -> dict[str, Float[Array, "*batch n_t"]]:
    """Work of each element since the first saved time [J], by name; inf at times that were not reached."""
    mechanism, (forces, drives) = solution.mechanism, do_work(solution.mechanism)
    names = [mechanism.force_names[index] for index in forces]
    names += [mechanism.topology.constraints[index] for index in drives]
    works: Any = [jnp.zeros_like(solution.ts) for _ in names]
    if names and solution.ts.shape[-1] > 1:
        between = _between(solution)
        powers = [read(Observables.powers_of_forces, between)] if forces else []
        powers += [read_in_motion(Observables.powers_of_drives, between)] if drives else []
        works = _integrals(solution.ts, powers)
    return ByName(dict(zip(names, works, strict=True)), "element that does work")


def _between(solution):
    """The same motion at Gauss's places between its saved times, interpolated by q, q̇ and q̈."""
    acceleration = read(Observables.solve, solution).acceleration
    states = solution.ts, solution.q, solution.v, acceleration
    ts, q, v = _interpolated(solution.mechanism.topology, *states)
    return dataclasses.replace(solution, ts=ts, q=q, v=v)


@jit_inline
def _interpolated(topology: Topology, ts, q, v, acceleration):
    """Times, coordinates and speeds between times that differ, by polynomials of degree five; inf elsewhere."""

    def between(before, later):
        rate = lambda q, v: rates(topology, q, v)
        curve = lambda q, v, acceleration: jax.jvp(rate, (q, v), (rate(q, v), acceleration))
        (t, q, v, acceleration), (end, q1, *ends) = before, later
        span = end - t
        is_span = jnp.isfinite(span) & (span > 0.0)
        h = jnp.where(is_span, span, 1.0)
        (slope, bend), (slope1, bend1) = curve(q, v, acceleration), curve(q1, *ends)
        first, second = h * slope, h**2 * bend / 2.0
        moved, faster, bent = q1 - q - first - second, h * slope1 - first - 2.0 * second, h**2 * (bend1 - bend)
        third, fourth, fifth = (
            10.0 * moved - 4.0 * faster + bent / 2.0,
            -15.0 * moved + 7.0 * faster - bent,
            6.0 * moved - 3.0 * faster + bent / 2.0,
        )
        place = lambda s: q + s * (first + s * (second + s * (third + s * (fourth + s * fifth))))

        def at(s):
            here, along = jax.jvp(place, (s,), (jnp.ones_like(s),))
            found = t + s * h, here, speeds(topology, here, along / h)
            return [jnp.where(is_span, part, jnp.inf) for part in found]

        return jax.vmap(at)(jnp.asarray(PLACES, q.dtype))

    def of_member(*states):
        first, last = ([part[ends] for part in states] for ends in (slice(None, -1), slice(1, None)))
        found = jax.vmap(between)(first, last)
        return [part.reshape(-1, *part.shape[2:]) for part in found]

    for _ in range(ts.ndim - 1):
        of_member = jax.vmap(of_member)
    return of_member(*(ts, q, v, acceleration))


@jit_inline
def _integrals(ts, powers):
    """Integrals over the saved times, (n, *batch, n_t), of powers at the places between them."""
    powers = jnp.moveaxis(jnp.concatenate(powers, axis=-1), -1, 0)
    span = jnp.where(jnp.isfinite(ts[..., 1:]), ts[..., 1:] - ts[..., :-1], 0.0)
    at_places = powers.reshape(*powers.shape[:-1], span.shape[-1], len(PLACES))
    each = jnp.where(span[..., None] > 0.0, at_places, 0.0) @ jnp.asarray(WEIGHTS, ts.dtype) * span
    found = jnp.concatenate([jnp.zeros_like(powers[..., :1]), jnp.cumsum(each, axis=-1)], axis=-1)
    return jnp.where(jnp.isfinite(ts), found, jnp.inf)
