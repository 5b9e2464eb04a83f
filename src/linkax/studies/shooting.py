"""Long records cut into short motions, which begin where the parameters say and must join."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from linkax.model.numbers import is_finite, namespace, real, require, require_type
from linkax.studies.parameters import as_arrays


class Shots(NamedTuple):
    """Motions one after the other.

    - `outputs`: what each motion gave at its times, joined along the times of the record, (n_t, ...).
    - `gaps`: by how much the end of each motion misses the start of the next, in the structure of one start,
      (n_shots - 1, ...).
    """

    outputs: Any
    gaps: Any


def shoot(run: Callable, starts: Any, ts: Float[Array, " n_t"]) -> Shots:
    """Run a long record as several motions, each from a start of its own: multiple shooting.

    A long or chaotic motion forgets its parameters and its start: its residual has many minima. Short pieces do not.
    Starts are parameters of a fit, and the gaps are parts of its residual, with a weight so large that they close
    (a thousand over the noise, say): then only parameters are left that lead through the whole record (Bock, 1981).

    **Arguments:**

    - `run`: (start, ts, t1) -> (end, outputs): the motion from `start` at ts[0] to t1, what start and end are being up
      to you, such as coordinates and speeds of the joints that move freely; outputs at ts, times first.
    - `starts`: pytree of arrays with the number of motions as the first axis.
    - `ts`: times of the record [s], as many for each motion; the next begins one time after the last of these.

    **Returns:** `Shots`.

    **Raises:** `ValueError` where the times do not fall into so many equal parts.
    """
    require_type(run, Callable, "run", "give a function (start, ts, t1) -> (end, outputs)")
    starts = as_arrays(starts, "starts")
    sizes = {jnp.shape(leaf)[0] if jnp.ndim(leaf) else 0 for leaf in jax.tree.leaves(starts)}
    if len(sizes) != 1:
        raise ValueError(
            f"starts have {sorted(sizes)} motions; give arrays with the same first axis, one entry per motion"
        )
    (count,) = sizes
    ts = jnp.asarray(real(ts, "times [s]"))
    if ts.ndim != 1 or len(ts) < 2 or count == 0 or len(ts) % count:
        raise ValueError(
            f"{count} starts for times of shape {ts.shape}; give as many times for each motion, such as {count * 10}"
        )
    in_order = lambda ts: is_finite(ts) & (namespace(ts).diff(ts) > 0.0).all()
    ts = require(ts, in_order, "times [s]", "give finite times in rising order")
    parts = ts.reshape(count, -1)
    until = jnp.append(parts[1:, 0], 2.0 * ts[-1] - ts[-2])
    ends, outputs = jax.vmap(run)(starts, parts, until)
    gaps = jax.tree.map(lambda end, start: end[:-1] - start[1:], ends, starts)
    return Shots(jax.tree.map(lambda rows: rows.reshape(-1, *rows.shape[2:]), outputs), gaps)
