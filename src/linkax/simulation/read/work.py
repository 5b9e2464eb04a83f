"""Work of force elements, impacts and drives over a motion, between its saved times too."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.forces.impacts import Impact
from linkax.model.names import ByName
from linkax.simulation.integrate.results import Solution
from linkax.simulation.read.interpolation import motion_between
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
        between = motion_between(solution, PLACES)
        powers = [read(Observables.powers_of_forces, between)] if forces else []
        powers += [read_in_motion(Observables.powers_of_drives, between)] if drives else []
        works = _integrals(solution.ts, powers)
    if solution.impact_record is not None:
        stops = [
            name
            for name, force in zip(mechanism.force_names, mechanism.forces, strict=True)
            if isinstance(force, Impact)
        ]
        taken = solution.impact_record[..., 1, :]
        since = jnp.where(jnp.isfinite(taken), taken[..., :1, :] - taken, jnp.inf + solution.ts[..., None])
        names, works = [*names, *stops], [*works, *jnp.moveaxis(since, -1, 0)]
    return ByName(dict(zip(names, works, strict=True)), "element that does work")


@jit_inline
def _integrals(ts, powers):
    """Integrals over the saved times, (n, *batch, n_t), of powers at the places between them."""
    powers = jnp.moveaxis(jnp.concatenate(powers, axis=-1), -1, 0)
    span = jnp.where(jnp.isfinite(ts[..., 1:]), ts[..., 1:] - ts[..., :-1], 0.0)
    at_places = powers.reshape(*powers.shape[:-1], span.shape[-1], len(PLACES))
    each = jnp.where(span[..., None] > 0.0, at_places, 0.0) @ jnp.asarray(WEIGHTS, ts.dtype) * span
    found = jnp.concatenate([jnp.zeros_like(powers[..., :1]), jnp.cumsum(each, axis=-1)], axis=-1)
    return jnp.where(jnp.isfinite(ts), found, ts)
