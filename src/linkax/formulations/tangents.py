"""Tangents of a state on the loops and of its acceleration, by the implicit function theorem.

Differentiated are the equations that they satisfy, c(q) = 0, J v = b, M v̇ = f + Jᵀλ and J v̇ = γ, not the way in which
they were found: neither factors nor iterations have derivatives, and M only as f − M v̇. A tangent None is zero.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from linkax.equations.configuration import Configuration, configure
from linkax.equations.coordinates import rates, speeds
from linkax.equations.dynamics import unbalanced_force
from linkax.equations.loops import gamma, jacobian, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import materialise, pushforward


class Tangents(NamedTuple):
    """Tangents of a system's numbers, of time, and of a state near the loops."""

    system: System | None
    t: Float[Array, ""] | None
    q: Float[Array, " n_q"] | None
    v: Float[Array, " n_v"] | None


class StateTangent(NamedTuple):
    """A state on the loops and its tangent.

    - `configuration`, `jacobian`, `v`: the state. `to_configuration`, `to_jacobian`, `to_q`, `to_v`: their tangents.
    """

    configuration: Configuration
    jacobian: Float[Array, "m n_v"]
    v: Float[Array, " n_v"]
    to_configuration: Any
    to_jacobian: Float[Array, "m n_v"] | None
    to_q: Float[Array, " n_q"]
    to_v: Float[Array, " n_v"]


def state_tangent(
    onto: Callable[[Array], Array] | None,
    system: System,
    t: ScalarLike,
    q: Float[Array, " n_q"],
    v: Float[Array, " n_v"],
    tangents: Tangents,
) -> StateTangent:
    """Compute the tangent of a state projected onto loops that change: J dq = −dc, J dv = db − dJ v.

    `onto`: rows -> the smallest change of coordinates or speeds with that change of the rows J; or None, for a state
    that is taken as it is.
    """
    topology = system.topology
    along = jnp.zeros_like(v) if tangents.q is None else speeds(topology, q, tangents.q)
    to_v = materialise(v, tangents.v)
    if onto is not None:
        open_ = lambda system, t, q: residual(configure(system, t, q))
        to_q = rates(topology, q, along)
        _, opens = pushforward(open_, (system, t, q), (tangents.system, tangents.t, to_q))
        along = along - onto(opens)
    to_q = rates(topology, q, along)
    configuration, to_configuration = eqx.filter_jvp(configure, (system, t, q), (tangents.system, tangents.t, to_q))
    rows, to_rows = eqx.filter_jvp(jacobian, (configuration,), (to_configuration,))
    if onto is not None:
        asked = lambda configuration, rows, v: rows @ v - rate(configuration)
        _, missed = pushforward(asked, (configuration, rows, v), (to_configuration, to_rows, to_v))
        to_v = to_v - onto(missed)
    return StateTangent(configuration, rows, v, to_configuration, to_rows, to_q, to_v)


def unbalanced_tangent(
    state: StateTangent, acceleration: Float[Array, " n_v"], multipliers: Float[Array, " m"]
) -> tuple[Float[Array, " n_v"], Float[Array, " m"]]:
    """How f − M v̇ + Jᵀλ and γ − J v̇ change at given v̇ and λ: right-hand sides for the tangents of these."""

    def sides(configuration, rows, v):
        motion = move(configuration, v)
        return unbalanced_force(motion, acceleration) + rows.T @ multipliers, gamma(motion) - rows @ acceleration

    at = state.configuration, state.jacobian, state.v
    return pushforward(sides, at, (state.to_configuration, state.to_jacobian, state.to_v))[1]
