"""Loop constraints: c(q, t) = 0, J v = b, J v̇ = γ.

Rows of cut joints are those of the paper's Table 1: with h₁ⁱ, h₂ʲ the joint's axes on parent and
child and s the separation of their origins, a rotation row is h₁ⁱ·h₂ʲ and a translation row
h₁ⁱ·s / ℓ, ℓ half the way around the loop. Some joint types combine several of these in one row. The
last rows are constraints on coordinates of the tree and ropes, in radians and lengths of the mechanism.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.equations.configuration import Configuration, along_speeds
from linkax.equations.coordinates import coordinates_by_speed
from linkax.equations.loop_rows import (
    combination,
    combine,
    combined_rows,
    combining_factors,
    immobile_rows,
    plain_rows,
    row_gamma,
    row_jacobian,
    row_residual,
)
from linkax.equations.motion import Motion
from linkax.equations.system import System
from linkax.linalg.static_sparse import StaticSparse
from linkax.model.ropes import Rope
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.tracing import jit_inline


def _right_sides(system: System, t):
    """Right sides of the constraints on coordinates at time t, (k,)."""
    sides = [jnp.asarray(constraint.right_side(t), system.dtype) for constraint in system.constraints]
    return jnp.stack(sides) / system.coupling_unit


def is_driven(system: System) -> bool:
    """Whether a constraint moves the mechanism with time."""
    return any(constraint.is_driven for constraint in system.constraints)


def ropes(system: System) -> list[tuple[int, Rope]]:
    """The ropes, and which of the constraints they are."""
    return [(row, rope) for row, rope in enumerate(system.constraints) if isinstance(rope, Rope)]


def residual(configuration: Configuration) -> Float[Array, " m"]:
    """c(q, t) of c = 0: the rows that motion can change, (m,)."""
    system = configuration.system
    rows: list[Array] = [row_residual(configuration, plain_rows(configuration))]
    if system.topology.combining:
        rows.append(combine(system, row_residual(configuration, combined_rows(configuration))))
    if system.constraints:
        coordinates = coordinates_by_speed(system.topology, configuration.q)
        values = jnp.asarray(system.coupling @ coordinates)
        for row, rope in ropes(system):
            values = values.at[row].set(rope.value(configuration))
        rows.append(values / system.coupling_unit - _right_sides(system, configuration.t))
    return jnp.concatenate(rows)


def immobile_residual(configuration: Configuration) -> Float[Array, " m_immobile"]:
    """The rows that no motion can change; nonzero where the loop cannot be closed."""
    return row_residual(configuration, immobile_rows(configuration))


def jacobian(configuration: Configuration) -> Float[Array, "m n_v"]:
    """J = ∂ċ/∂v, dense."""
    return jacobian_entries(configuration).dense()


def jacobian_entries(configuration: Configuration) -> StaticSparse:
    """J by its entries that are not zero at compile time: those of speeds that move a loop."""
    system = configuration.system
    rows = [row_jacobian(configuration, plain_rows(configuration))]
    if system.topology.combining:
        values, slopes = combination(configuration)
        rows.append(StaticSparse.whole(combining_factors(configuration, values) @ slopes))
    if system.constraints:
        slopes = jnp.asarray(system.coupling)
        for row, rope in ropes(system):
            unit_load = rope.load(configuration, 1.0)
            slopes = slopes.at[row].set(along_speeds(configuration, unit_load.force, unit_load.moment))
        rows.append(StaticSparse.whole(slopes / system.coupling_unit[:, None]))
    return StaticSparse.stacked(rows)


def rate(system: System, t: ScalarLike) -> Float[Array, " m"]:
    """b of J v = b, which makes ċ = 0: b = −∂c/∂t, the rates of drives; zero for other rows."""
    nothing = jnp.zeros(system.topology.num_rows, system.dtype)
    if not is_driven(system):
        return nothing
    sides = jax.jvp(lambda t: _right_sides(system, t), (t,), (jnp.ones_like(t),))[1]
    return nothing.at[-len(system.constraints) :].set(sides)


def drive_acceleration(system: System, t: ScalarLike) -> Float[Array, " m"]:
    """The part of γ that drives cause, ∂b/∂t."""
    return jax.jvp(lambda t: rate(system, t), (t,), (jnp.ones_like(t),))[1]


@jit_inline
def velocity_gamma(motion: Motion) -> Float[Array, " m"]:
    """The part of γ that speeds cause, −J̇ v: quadratic in them. A combined row r(u) has r' γᵤ − u̇ᵀ r'' u̇."""
    system, configuration = motion.system, motion.configuration
    rows = [row_gamma(motion, plain_rows(configuration))]
    if system.topology.combining:
        values, slopes = combination(configuration)
        turn = slopes @ motion.v
        own = lambda values: combine(system, values)
        along = lambda values: jax.jvp(own, (values,), (turn,))[1]
        bent = jax.jvp(along, (values,), (turn,))[1]
        factors = combining_factors(configuration, values)
        rows.append(factors @ row_gamma(motion, combined_rows(configuration)) - bent)
    if system.constraints:
        biases = jnp.zeros(len(system.constraints), system.dtype)
        for row, rope in ropes(system):
            biases = biases.at[row].set(rope.bias(motion) / system.coupling_unit[row])
        rows.append(biases)
    return jnp.concatenate(rows)


def gamma(motion: Motion) -> Float[Array, " m"]:
    """γ of J v̇ = γ, which makes c̈ = 0: γ = −J̇ v + ∂b/∂t (paper, acceleration constraints)."""
    return velocity_gamma(motion) + drive_acceleration(motion.system, motion.configuration.t)


class Multipliers(NamedTuple):
    """Multipliers sorted by what they act on.

    - `plain`, `combined`: of the rows of cut joints in `plain_rows` and `combined_rows`.
    - `constraints`: generalised force of each constraint on coordinates, per unit of coefficient; of ropes their
      tension.
    """

    plain: Float[Array, " n"]
    combined: Float[Array, " n"]
    constraints: Float[Array, " k"]


def sorted_multipliers(configuration: Configuration, multipliers: Float[Array, " m"]) -> Multipliers:
    """Sort the multipliers λ of all rows by what they act on."""
    system, topology = configuration.system, configuration.system.topology
    count = topology.num_rows - len(system.constraints)
    plain, combined, constraints = jnp.split(multipliers, [count - len(topology.combining), count])
    if topology.combining:
        combined = combined @ combining_factors(configuration, combination(configuration)[0])
    return Multipliers(plain, combined, constraints / system.coupling_unit)
