"""Find the forces along joints that produce prescribed accelerations."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import rates
from linkax.equations.dynamics import generalised_force, mass_matrix
from linkax.equations.internal_states import bound
from linkax.equations.loops import gamma, jacobian
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.least_multipliers import least_multipliers
from linkax.linalg.saddle_inverse import invert
from linkax.model.mechanism import Mechanism
from linkax.model.terms import term
from linkax.simulation.explain.diagnosis import massless_bodies
from linkax.simulation.integrate.run import cast
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked, speeds_by_joint
from linkax.tables import Rows, Table, numbers, printed_as
from linkax.xla.arrays import Array
from linkax.xla.tracing import concrete
from linkax.xla.undefined import nan_where
from scalarjit import scalarised

JointKey = str | tuple[str, int]
Accelerations = Mapping[JointKey, ArrayLike | Sequence[float]]
MET = 1e-9  # error up to which an acceleration counts as reached, relative to those that add up to it
MET_ULPS = 1e3  # the same in units of rounding, which is more in single precision


def _table(found: "InverseDynamics") -> Table:
    rows = [(f"{key}", numbers(forces, "N m or N", 1)) for key, forces in found.forces.items()]
    return Table("Forces along joints", [Rows(("joint", "force"), rows, "joints")])


@printed_as(_table)
class InverseDynamics(NamedTuple):
    """Forces along joints, and the accelerations that they produce.

    - `forces`: {key of `accelerations`: forces on the child along the joint's speeds, (n,) [N m or N]}.
    - `acceleration`: v̇ of the tree's joints, (n_v,) [rad/s² or m/s²].
    """

    forces: dict[JointKey, Float[Array, " n"]]
    acceleration: Float[Array, " n_v"]


def inverse_dynamics(
    mechanism: Mechanism,
    state: State,
    accelerations: Mapping[JointKey, ArrayLike | Sequence[float]],
    *,
    t: ArrayLike = 0.0,
) -> InverseDynamics:
    """Find the forces along joints that produce prescribed accelerations, at a state on the closed loops.

    The mechanism's own forces act too, and joints without a prescribed acceleration move as all forces drive them.
    Where several sets of forces produce the same motion, the one of smallest norm is returned.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`. `t`: time [s].
    - `accelerations`: {joint: rates of its speeds [rad/s² or m/s²]}, of joints in the tree or cut; with
      (joint, index) as the key, the rate of one of its speeds.

    **Returns:** an `InverseDynamics`.

    **Raises:** `ValueError` where the loops do not allow the accelerations together, naming the joint; under
    transformations of JAX all numbers are NaN there, and so are their derivatives.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    wanted = speeds_by_joint(mechanism, accelerations, "acceleration")
    if not wanted.groups:
        raise ValueError("inverse_dynamics needs accelerations; give {joint: acceleration, ...}")
    given = cast((mechanism, state, wanted, t), state.q.dtype)
    acceleration, forces, misses, most = _inverse_dynamics(*given)
    if concrete(acceleration) is not None:
        if not np.all(np.isfinite(acceleration)):
            system = system_of(mechanism, state.q.dtype)
            massless = massless_bodies(system, TangentSpace().prepared(system.dtype), t, state.q)
            raise ValueError(
                "accelerations are not finite; give mass and inertia to bodies that move without, "
                f"{', '.join(map(repr, massless)) or 'none here'}, and finite numbers to forces"
            )
        for (along, miss), (_, bound) in zip(misses.by_term(), most.by_term(), strict=True):
            if not np.all(np.abs(miss) <= bound):
                size = np.max(np.abs(miss))
                raise ValueError(
                    f"the acceleration asked of joint {along.joint!r} is missed by {size:.6g}; the loops do not allow "
                    "it together with the others, so ask for fewer"
                )
    else:
        missed = jnp.logical_not(jnp.all(jnp.abs(misses.flat()) <= most.flat()))
        acceleration, forces = nan_where(missed, (acceleration, forces), given)
    of_term = dict(forces.by_term())
    of_joint = {key: of_term[term(key, "acceleration")] for key in accelerations}
    return marked(mechanism, InverseDynamics(of_joint, acceleration))


@scalarised
def _inverse_dynamics(mechanism, state, wanted, t):
    system, (q, v) = bound(system_of(mechanism, state.q.dtype), state.internal), (state.q, state.v)
    configuration = configure(system, t, q)
    motion, mass, loops = move(configuration, v), mass_matrix(configuration), jacobian(configuration)
    speeds = lambda q: wanted.speeds(move(configure(system, t, q), v)).flat()
    turning = jax.jvp(speeds, (q,), (rates(system.topology, q, v),))[1]
    along = wanted.slopes(lambda v: wanted.speeds(move(configuration, v)), system.topology, system.dtype)
    rows = jnp.concatenate([loops, along])
    right = jnp.concatenate([gamma(motion), wanted.flat() - turning])
    tolerance = TangentSpace().prepared(system.dtype).tolerance
    inverse = invert(mass, rows, system.scales, tolerance)
    forces = generalised_force(motion)
    acceleration, multipliers = constrained_solve(inverse, mass, rows, forces, right)
    multipliers = least_multipliers(rows, multipliers, system.scales, tolerance, inverse.rank).multipliers
    misses = along @ acceleration + turning - wanted.flat()
    # Rounding is that of the largest terms, which are what each force would do alone, as a weight that a drive holds.
    size = jnp.diagonal(mass)
    alone = (jnp.abs(forces) + jnp.abs(rows).T @ jnp.abs(multipliers)) / jnp.where(size > 0.0, size, jnp.inf)
    fastest = jnp.max((jnp.abs(acceleration) + alone) / system.scales)
    terms = jnp.abs(along) @ system.scales * fastest + jnp.abs(turning) + jnp.abs(wanted.flat())
    most = lax.stop_gradient(terms) * max(MET, MET_ULPS * float(jnp.finfo(system.dtype).eps))
    return acceleration, *map(wanted.filled, (multipliers[len(loops) :], misses, most))
