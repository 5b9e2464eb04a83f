"""Derivatives of what is read from joints along the speeds, in few directions."""

from collections.abc import Callable, Sequence
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.terms import Term
from linkax.model.topology import Topology
from linkax.xla.arrays import Array
from linkax.xla.static_scatter import scatter_static


def joint_slopes(
    function: Callable[[Float[Array, " n_v"]], Sequence[Float[Array, " _"]]],
    topology: Topology,
    terms: Sequence[Term],
    dtype: np.dtype,
) -> list[Float[Array, "_ n_v"]]:
    """Derivatives at zero of a function that returns for each term numbers of its joint.

    Speeds that change no joint's numbers together are one direction (Curtis, Powell, Reid, Journal of the Institute of
    Mathematics and its Applications 13, 1974).
    """
    if not terms:
        return []
    read = [topology.read_by_joint(along.joint) for along in terms]
    directions = _directions(read, topology.num_speeds)
    slopes = jax.jacfwd(lambda along: tuple(function(along[directions])))(jnp.zeros(np.max(directions) + 1, dtype))
    onto = lambda rows: jnp.zeros((topology.num_speeds, len(rows)), dtype)
    return [
        scatter_static(onto(rows), columns, rows[:, directions[columns]].T).T
        for rows, columns in zip(slopes, read, strict=True)
    ]


def _directions(read, size):
    """Number columns, (size,), so that those read together have different numbers, of which there are few."""
    together, numbers = [set(columns.tolist()) for columns in read], []
    for column in range(size):
        beside = set().union(*(columns for columns in together if column in columns))
        taken = {numbers[other] for other in beside if other < column}
        numbers.append(next(number for number in count() if number not in taken))
    return np.array(numbers)
