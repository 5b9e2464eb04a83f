"""A state of motion."""

import equinox as eqx
from jaxtyping import Float

from linkax.xla.arrays import Array


class State(eqx.Module):
    """Coordinates and speeds of the joints in the spanning tree, in the tree's order.

    - `q`: coordinates [rad or m], unit quaternions among them, (n_q,). `v`: speeds [rad/s or m/s], (n_v,).

    `linkax.assemble` makes one on the closed loops from the joints' names.
    """

    q: Float[Array, "*batch n_q"]
    v: Float[Array, "*batch n_v"]
