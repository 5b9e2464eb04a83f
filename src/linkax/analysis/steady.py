"""Recognise steady motion: drives are followed, and nothing changes as the motion goes on."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import applied_load, inertial_wrench
from linkax.equations.gaps import gaps
from linkax.equations.loops import jacobian, rate
from linkax.equations.motion import Motion
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.state import State
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import concrete

# How far a motion goes until it is checked again [rad, lengths of the mechanism]: by multiples of the golden angle,
# which leave no gap above 20° in a turn, such as the dwell of a cam.
LATER = np.pi * (5.0**0.5 - 1.0) * np.arange(1, 22)
AGREES = 1e-6  # relative error of speeds and forces up to which they count as equal
# Of limits in units of rounding: in single precision a disc that rolls in a circle seems to change by up to 4e-3.
LEAST_ULPS = 1e5


def may_move(state: State) -> bool:
    """Whether a state has a speed that is not zero; True where speeds are traced."""
    v = concrete(state.v)
    return v is None or bool(np.any(v != 0.0))


def system_in(mechanism: Mechanism, state: State, t: Float[Array, ""], moves: bool) -> System:
    """The mechanism's numbers; where all speeds of the state are zero, drives hold their joints as at time t [s]."""
    system, unless = system_of(mechanism, state.q.dtype), jnp.any(state.v != 0.0) if moves else False
    constraints = tuple(each.held(t, unless) for each in system.constraints)
    return dataclasses.replace(system, constraints=constraints)


def limit(most: float, dtype: DTypeLike) -> float:
    """A limit of what counts as nothing, or what rounding may leave where that is more: in single precision."""
    return max(most, LEAST_ULPS * float(jnp.finfo(dtype).eps))


class Nearby(eqx.Module):
    """A mechanism near coordinates q on the closed loops, in coordinates y of the tangent space: q ⊕ T y.

    - `basis`: T, (n_v, n), columns orthonormal in a metric, or zero.
    - `dual`: its inverse on the tangent space, (n, n_v).
    - `t`: time [s].
    """

    system: System
    method: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    basis: Float[Array, "n_v n"]
    dual: Float[Array, "n n_v"]

    def at(self, y: Float[Array, " n"]) -> Float[Array, " n_q"]:
        """Coordinates of the tree's joints, q ⊕ T y."""
        return retract(self.system.topology, self.q, self.basis @ y)

    @staticmethod
    def slopes(function: Callable, point: Float[Array, " n"]) -> tuple[Float[Array, " m"], Float[Array, "m n"]]:
        """A vector function of a vector at a point, and its derivative."""
        follow = lambda change: jax.jvp(function, (point,), (change,))
        return jax.vmap(follow, out_axes=(None, 1))(jnp.eye(len(point), dtype=point.dtype))


def instants(system: System, v: Float[Array, " n_v"]) -> Float[Array, " k"]:
    """The times that the fastest joint needs at speeds v to go as far as `LATER` says [s]."""
    return ratio(jnp.asarray(LATER, v.dtype), lax.stop_gradient(system.fastest(v)), 0.0)


def widest_gap(system: System, t: Float[Array, ""], q: Float[Array, " n_q"]) -> Float[Array, ""]:
    """The largest gap of the loops [rad, lengths of the mechanism]."""
    return gaps(configure(system, t, q)).in_scales(system).widest()


def missed_rates(
    system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> Float[Array, " m"]:
    """|J v − b| of each loop row and constraint, relative to the largest speed and the largest rate b asked for."""
    configuration = configure(system, t, q)
    asked = rate(configuration)
    size = jnp.maximum(system.fastest(v), largest(asked))
    return ratio(jnp.abs(jacobian(configuration) @ v - asked), size)


def of_missed_rate(mechanism: Mechanism, missed: np.ndarray, row: int, t: Float[Array, ""]) -> str:
    """Name what asks for the rate of a row of `missed`, in which constraints come last, and the remedy."""
    topology = mechanism.topology
    last = row - len(missed) + topology.num_constraint_rows
    what = mechanism.constraints[topology.constraint_of_row[last]].display_name if last >= 0 else "a loop"
    return (
        f"{what} asks for a rate that the state's speeds miss by {missed[row]:.3g} of the largest "
        f"at t = {float(t):.6g} s; make the state with linkax.assemble at that time"
    )


def largest_force(motion: Motion) -> Float[Array, ""]:
    """Sum of the magnitudes of all forces, to which rounding of their sum is relative [N m]."""
    load, system = applied_load(motion), motion.system
    force, moment = inertial_wrench(motion, motion.angular_bias[:-1], motion.bias[:-1])
    size = lambda vectors: jnp.sum(jnp.abs(vectors))
    on_bodies = system.length * (size(load.force) + size(force)) + size(load.moment) + size(moment)
    return on_bodies + size(system.scales * load.joint_force)
