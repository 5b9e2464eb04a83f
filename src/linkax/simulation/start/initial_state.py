"""The check of a state before motion starts: closed, on a branch of the motion, unique."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.gaps import gaps
from linkax.equations.internal_states import bound
from linkax.equations.loops import jacobian, rate
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.projected_state import ranks_along
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.state import State
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import jit_inline, without_derivatives
from scalarjit import Flat, scalarised

MOVES = 1e-6  # of the largest speed
SINGULAR_ULPS = 8.0  # times the number of speeds: what rounding leaves of a singular mass matrix
SIX_DIGITS = 1e-6
ON_BRANCH = 10.0  # rank tolerances that speeds may be off a branch, relative to their square


class InitialCheck(NamedTuple):
    """A state at time t [s], put on the closed loops, and what a run needs to know of it.

    - `singular`: the rank of J is smaller here than beside here.
    - `rank`: of J at the states beside it along the motion, for each island of the mechanism, or each front of its
      elimination plan where it has one.
    - `definiteness`: of the mass matrix on the tangent space, see `linkax.linalg.saddle_inverse.SaddleInverse`.
    - `assembled`: False for a state that `linkax.assemble` did not find, which it marks by infinite speeds.
    - `finite`, `closed`; `massive`: all that can move has mass; `on_branch`: the speeds lie on a
      branch of the motion; `unique`: so does, at rest, the acceleration.
    """

    t: Float[Array, ""]
    state: State
    singular: Bool[Array, ""]
    rank: Int[Array, " k"]
    definiteness: Float[Array, ""]
    assembled: Bool[Array, ""]
    finite: Bool[Array, ""]
    massive: Bool[Array, ""]
    closed: Bool[Array, ""]
    on_branch: Bool[Array, ""]
    unique: Bool[Array, ""]

    @property
    def can_start(self) -> Bool[Array, ""]:
        """Whether motion can start from here."""
        return self.finite & self.massive & self.closed & self.on_branch & self.unique

    def of_numbers(self, sound: Bool[Array, ""] | np.bool_) -> "InitialCheck":
        """Note whether the numbers of the mechanism are sound: what is wrong then."""
        return self._replace(finite=self.finite & sound, assembled=self.assembled | jnp.logical_not(sound))


class OffLoops(NamedTuple):
    """How far a state is off the closed loops.

    - `gap`: the widest, in radians and lengths of the mechanism.
    - `miss`: of J v = b, relative to the largest speed; zero at rest, as drawn, whatever speeds drives ask for.
    """

    gap: Float[Array, ""]
    miss: Float[Array, ""]

    @property
    def most(self) -> float:
        """What a state may be off that is copied from six digits, or computed in single precision."""
        return max(SIX_DIGITS, float(jnp.finfo(self.gap.dtype).eps) ** 0.5)

    @property
    def is_small(self) -> Bool[Array, ""]:
        """Whether a state is as good as on the loops; false for numbers that are not finite."""
        return (self.gap <= self.most) & (self.miss <= self.most)


@scalarised
def off_loops(flat: Flat[Mechanism], t: Float[Array, ""], state: State) -> OffLoops:
    """How far a state at time t [s] is off the closed loops, in positions and in speeds."""
    system = system_of(flat, state.q.dtype)
    configuration = configure(system, t, state.q)
    miss = largest(jacobian(configuration) @ state.v - rate(configuration))
    return OffLoops(gaps(configuration).in_scales(system).widest(), ratio(miss, system.fastest(state.v), 0.0))


def is_assembled(state: State) -> Bool[Array, ""]:
    """False for a state that `linkax.assemble` did not find, inside a JAX transformation."""
    return jnp.logical_not(jnp.all(jnp.isfinite(state.q)) & jnp.all(jnp.isposinf(state.v)) & (len(state.v) > 0))


def check_initial_state(method: TangentSpace, system: System, t: Float[Array, ""], state: State) -> InitialCheck:
    """Close a state and find the rank of J beside it along the motion.

    At rest the motion departs along the acceleration. In a singular configuration that may take any direction that J
    leaves; it lies on a branch only if no force of the loops turns it.
    """
    q, v = method.close(system, t, state.q, state.v)
    start, begins = State(q, v, system.topology, state.internal), lax.stop_gradient(t)
    system = bound(system, state.internal)
    # All that follows only decides, and has no derivative.
    method, system, t, given, q, v = without_derivatives((method, system, t, state.q, q, v))
    # A singular mass matrix has spoiled them.
    q, v = jnp.where(jnp.all(jnp.isfinite(q)), q, given), jnp.where(jnp.isfinite(v), v, 0.0)
    found = _at_start(method, system, t, q, v)
    eps = jnp.finfo(system.dtype).eps
    massive = found.definiteness > SINGULAR_ULPS * eps * len(v)
    finite = jnp.all(jnp.isfinite(state.q)) & jnp.all(jnp.isfinite(state.v)) & jnp.all(jnp.isfinite(found.mass))
    finite = finite & jnp.all(jnp.isfinite(jnp.where(massive, found.acceleration, 0.0)))
    finite = finite if state.internal is None else finite & jnp.all(jnp.isfinite(state.internal))
    return InitialCheck(
        t=begins,
        state=start,
        singular=jnp.any(found.rank > found.rank_here),
        rank=found.rank
        if system.topology.num_rows == 0
        else ranks_along(method, system, t, q, found.direction, found.rank),
        definiteness=found.definiteness,
        assembled=is_assembled(state),
        finite=finite,
        massive=massive,
        closed=found.gap <= jnp.sqrt(eps),
        on_branch=found.on_branch | found.at_rest,
        unique=found.on_branch | jnp.logical_not(found.at_rest),
    )


class _AtStart(NamedTuple):
    """What a check decides by: the acceleration from rest, the motion's direction, ranks of J here and along it."""

    mass: Float[Array, "n_v n_v"]
    acceleration: Float[Array, " n_v"]
    definiteness: Float[Array, ""]
    rank_here: Int[Array, " n_islands"]
    rank: Int[Array, " n_islands"]
    gap: Float[Array, ""]
    direction: Float[Array, " n_v"]
    at_rest: Bool[Array, ""]
    on_branch: Bool[Array, ""]


@jit_inline
def _at_start(method, system, t, q, v) -> _AtStart:
    split, mass, acceleration, definiteness = method.at_rest(system, t, q)
    rank = split.inverse.rank
    if system.topology.num_rows == 0:
        zero, false, true = jnp.zeros((), q.dtype), jnp.zeros((), bool), jnp.ones((), bool)
        return _AtStart(mass, acceleration, definiteness, rank, rank, zero, v, false, true)
    gap = gaps(split.configuration).in_scales(system).widest()
    slowest = jnp.maximum(jnp.finfo(system.dtype).eps * system.fastest(acceleration), split.slowest() ** 2)
    at_rest = system.fastest(v) ** 2 <= slowest
    direction = jnp.where(at_rest, acceleration, v)
    off, beside = split.along(direction, at_rest)
    # Rows that are not quite dependent contradict each other by as much.
    on_branch = largest(off) <= ON_BRANCH * method.tolerance
    return _AtStart(mass, acceleration, definiteness, rank, beside, gap, direction, at_rest, on_branch)


def moving_joints(system: System, t: Scalar, q: Float[Array, " n_q"], directions: Float[Array, "n_v k"]) -> list[str]:
    """Names of the joints, in the tree or cut, that move in some of the directions, (n_v, k)."""
    size = np.max(np.abs(directions), initial=0.0)
    configuration = configure(system, t, q)

    def moves(name):
        speeds = jax.vmap(lambda v: move(configuration, v).joint_speeds(name), in_axes=1)(directions)
        return np.max(np.abs(speeds), initial=0.0) > MOVES * size

    return [name for name in system.topology.joints if moves(name)]
