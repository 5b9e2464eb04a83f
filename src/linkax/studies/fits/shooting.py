"""Multiple shooting: a long record as short motions, whose starts are parameters and whose ends must join."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.numbers import is_finite, namespace, real, require, require_type
from linkax.studies.parameters.parameters import as_arrays
from linkax.xla.arrays import Array


class Shots(NamedTuple):
    """Outputs of consecutive motions, and the gaps between them.

    - `outputs`: of all motions, joined along the times of the record, (n_t, ...).
    - `gaps`: end of each motion minus start of the next, in the structure of one start, (n_shots - 1, ...).
    """

    outputs: Any
    gaps: Any


def shoot(run: Callable, starts: Any, ts: Float[Array, " n_t"] | Sequence[float]) -> Shots:
    """Run a long record as several motions, each from a start of its own: multiple shooting.

    The residual of a long or chaotic motion has many minima, that of short pieces has few. Make the starts parameters
    of a fit, and the gaps parts of its residual, with a weight so large that they close, such as a thousand over the
    noise: then only parameters fit that lead through the whole record (Bock, 1981).

    **Arguments:**

    - `run`: (start, ts, t1) -> (end, outputs): the motion from `start` at ts[0] to t1. You choose what start and end
      are, such as coordinates and speeds of the joints that move freely; outputs are those at ts, times first.
    - `starts`: pytree of arrays with the number of motions as the first axis.
    - `ts`: times of the record, (n_t,) [s], equally many for each motion. Each motion ends at the first time of the
      next, and the last one goes on for one interval beyond its last time.

    **Returns:** `Shots`.

    **Raises:** `ValueError` where the times do not divide into as many equal parts as there are starts.
    """
    require_type(run, Callable, "run", "give a function (start, ts, t1) -> (end, outputs)")
    starts = as_arrays(starts, "starts")
    sizes = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else 0 for leaf in jax.tree.leaves(starts)}
    if len(sizes) != 1:
        raise ValueError(
            f"starts have {sorted(sizes)} motions; give arrays with the same first axis, one entry per motion"
        )
    (count,) = sizes
    times = jnp.asarray(real(ts, "times [s]"))
    if times.ndim != 1 or len(times) < 2 or count == 0 or len(times) % count:
        raise ValueError(
            f"{count} starts for times of shape {times.shape}; give as many times for each motion, such as {count * 10}"
        )
    in_order = lambda ts: is_finite(ts) & (namespace(ts).diff(ts) > 0.0).all()
    times = require(times, in_order, "times [s]", "give finite times in rising order")
    parts = times.reshape(count, -1)
    until = jnp.append(parts[1:, 0], 2.0 * times[-1] - times[-2])
    ends, outputs = jax.vmap(run)(starts, parts, until)
    gaps = jax.tree.map(lambda end, start: end[:-1] - start[1:], ends, starts)
    return Shots(jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), outputs), gaps)
