"""Loop constraints: c(q, t) = 0, J v = b, J v̇ = γ.

Rows of cut joints are those of the paper's Table 1: with h₁ⁱ, h₂ʲ the joint's axes on parent and
child and s the separation of their origins, a rotation row is h₁ⁱ·h₂ʲ and a translation row
h₁ⁱ·s / ℓ, ℓ half the way around the loop. Some joint types combine several of these in one row. The
last rows are those of constraints, in radians and lengths of the mechanism.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.equations.configuration import Configuration
from linkax.equations.constraint_rows import (
    constraint_gamma,
    constraint_jacobian,
    constraint_rate,
    constraint_residual,
    drive_gamma,
    is_driven,
)
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
from linkax.linalg.static_sparse import StaticSparse
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline


def residual(configuration: Configuration) -> Float[Array, " m"]:
    """c(q, t) of c = 0: the rows that motion can change, (m,)."""
    system = configuration.system
    rows: list[Array] = [row_residual(configuration, plain_rows(configuration))]
    if system.topology.combining:
        rows.append(combine(system, row_residual(configuration, combined_rows(configuration))))
    if system.constraints:
        rows.append(constraint_residual(configuration))
    return jnp.concatenate(rows)


def widest(configuration: Configuration) -> Float[Array, ""]:
    """The largest |c|, in radians and lengths of the mechanism or the loop."""
    return largest(residual(configuration))


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
        rows.append(StaticSparse.whole(constraint_jacobian(configuration)))
    return StaticSparse.stacked(rows)


def rate(configuration: Configuration) -> Float[Array, " m"]:
    """b of J v = b, which makes ċ = 0: b = −∂c/∂t, the rates of drives; zero for other rows."""
    return _last_rows(configuration.system, lambda: constraint_rate(configuration))


def drive_acceleration(motion: Motion) -> Float[Array, " m"]:
    """The part of γ that drives cause."""
    return _last_rows(motion.system, lambda: drive_gamma(motion))


def _last_rows(system, found):
    """Rows of drives, with zeros for all others."""
    nothing = jnp.zeros(system.topology.num_rows, system.dtype)
    return nothing.at[-system.topology.num_constraint_rows :].set(found()) if is_driven(system) else nothing


@jit_inline
def velocity_gamma(motion: Motion) -> Float[Array, " m"]:
    """The part of γ that speeds cause, −J̇ v: quadratic in them. A combined row r(u) has r' γᵤ − u̇ᵀ r'' u̇."""
    return _gamma(motion, 0.0)


def gamma(motion: Motion) -> Float[Array, " m"]:
    """γ of J v̇ = γ, which makes c̈ = 0: γ = −J̇ v + ∂b/∂t (paper, acceleration constraints)."""
    return _gamma(motion, 1.0)


def _gamma(motion, pace):
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
        rows.append(constraint_gamma(motion, pace))
    return jnp.concatenate(rows)


class Multipliers(NamedTuple):
    """Multipliers sorted by what they act on.

    - `plain`, `combined`: of the rows of cut joints in `plain_rows` and `combined_rows`.
    - `constraints`: of the rows of each constraint, in the units of its residual.
    """

    plain: Float[Array, " n"]
    combined: Float[Array, " n"]
    constraints: Float[Array, " k"]


def sorted_multipliers(configuration: Configuration, multipliers: Float[Array, " m"]) -> Multipliers:
    """Sort the multipliers λ of all rows by what they act on."""
    system, topology = configuration.system, configuration.system.topology
    count = topology.num_rows - topology.num_constraint_rows
    plain, combined, constraints = jnp.split(multipliers, [count - len(topology.combining), count])
    if topology.combining:
        combined = combined @ combining_factors(configuration, combination(configuration)[0])
    return Multipliers(plain, combined, constraints / system.constraint_scales)
