"""Forces along joints that give prescribed accelerations."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.equations.coordinates import rates
from linkax.equations.dynamics import generalised_force, mass_matrix
from linkax.equations.kinematics import configure, move
from linkax.equations.loops import gamma, jacobian
from linkax.equations.system import system_of
from linkax.linalg.constrained_solve import constrained_solve, invert, least_multipliers
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import known
from linkax.simulation.accuracy import BALANCED
from linkax.simulation.assembly import by_joint
from linkax.simulation.state import State

MET = 1e-9  # relative to the largest acceleration


class InverseDynamics(NamedTuple):
    """- `forces`: {joint: along its speeds [N m or N], on the child}. `acceleration`: v̇ of the tree, (n_v,)."""

    forces: dict[str, Float[Array, " n"]]
    acceleration: Float[Array, " n_v"]


def inverse_dynamics(mechanism: Mechanism, state: State, accelerations, *, t=0.0) -> InverseDynamics:
    """The forces along joints that give them prescribed accelerations, at a state on the closed loops.

    What is not prescribed moves as the forces drive it. The mechanism's own forces act besides.
    Where several sets of forces do the same, these have the smallest norm.

    **Arguments:** `accelerations`: {joint, in the tree or cut: rates of its speeds [rad/s² or m/s²]}.

    **Raises:** `ValueError` where the loops do not allow the accelerations together, naming the joint.
    """
    wanted = by_joint(mechanism, accelerations, "acceleration", lambda joint: len(joint.speed_units))
    found, misses = _inverse_dynamics(mechanism, state, wanted, jnp.asarray(t, float))
    if known(found.acceleration) is not None:
        scale = max(1.0, *(float(np.max(np.abs(entry), initial=0.0)) for entry in wanted.values()))
        for name, miss in misses.items():
            if not np.max(np.abs(miss), initial=0.0) <= MET * scale:
                raise ValueError(
                    f"the acceleration asked of joint {name!r} is missed by {np.max(np.abs(miss)):.6g}; the loops do "
                    "not allow it together with the others, so ask for fewer"
                )
    return found


@eqx.filter_jit
def _inverse_dynamics(mechanism, state, wanted, t):
    system, (q, v) = system_of(mechanism, state.q.dtype), (state.q, state.v)
    configuration = configure(system, t, q)
    motion, mass, loops = move(configuration, v), mass_matrix(configuration), jacobian(configuration)

    def speeds(q, v):
        motion = move(configure(system, t, q), v)
        return jnp.concatenate([motion.joint_speeds(name) for name in wanted])

    turning = jax.jvp(lambda q: speeds(q, v), (q,), (rates(system.topology, q, v),))[1]
    along = jax.jacfwd(lambda v: speeds(q, v))(v)
    rows = jnp.concatenate([loops, along])
    right = jnp.concatenate([gamma(motion), jnp.concatenate([*wanted.values()]) - turning])
    tolerance = BALANCED.method(system.dtype).rank_tolerance
    inverse = invert(mass, rows, system.units, tolerance)
    acceleration, multipliers = constrained_solve(inverse, mass, rows, generalised_force(motion), right)
    multipliers = least_multipliers(rows, multipliers, system.units, tolerance, inverse.rank).multipliers
    ends = np.cumsum([len(entry) for entry in wanted.values()])[:-1]
    split = lambda entries: dict(zip(wanted, jnp.split(entries, ends), strict=True))
    misses = rows @ acceleration - right
    return InverseDynamics(split(multipliers[len(loops) :]), acceleration), split(misses[len(loops) :])
