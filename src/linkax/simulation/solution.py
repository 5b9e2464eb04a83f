"""The motion that a simulation found, and what can be read from it."""

from typing import Any, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from linkax.equations.dynamics import body_accelerations, kinetic_energy, potential_energy
from linkax.equations.kinematics import configure, move
from linkax.equations.loops import immobile_residual, jacobian, rate, residual, sorted_multipliers
from linkax.equations.reactions import Axes, Reaction, Side, reactions, reactions_to, seen_from
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import LeastMultipliers, least_multipliers
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import number
from linkax.simulation.accuracy import BALANCED, Accuracy
from linkax.simulation.integration import Problem
from linkax.simulation.passages import Passages, passages
from linkax.simulation.results import RESULTS
from linkax.simulation.state import State
from linkax.spatial.rotations import cross, rotate

UNCHANGED = 1e-6  # by a self-stress of magnitude one


class Violation(NamedTuple):
    """Largest violation of the loop rows, at each time or over the run.

    - `position`: c, rotation rows [rad], translation rows in lengths of the loop.
    - `velocity`: J v [1/s]. `acceleration`: J v̇ − γ [1/s²].
    """

    position: Float[Array, "..."]
    velocity: Float[Array, "..."]
    acceleration: Float[Array, "..."]


class _Instant(NamedTuple):
    """One saved time of a solution."""

    system: System
    method: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]

    @property
    def configuration(self):
        return configure(self.system, self.t, self.q)

    @property
    def motion(self):
        return move(self.configuration, self.v)

    @property
    def dynamics(self):
        return self.method.dynamics(self.system, self.t, self.q, self.v)


class Solution(eqx.Module):
    """A motion at the times `ts` [s].

    - `q`, `v`: coordinates and speeds of the tree's joints, (n_t, n_q) and (n_t, n_v), on the
      closed loops. Times that were not reached hold infinity.
    - `ys`: what a `SaveAt` with functions of its own saved; `q` and `v` are None then.
    - `t_end`, `end`: the time reached and the `State` there.
    - `stats`: as in diffrax: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
    - `result`: a `linkax.RESULTS`; equal to `RESULTS.successful` where all went well.
    - `rank_nearby`: rank along the motion, of each part that moves independently of the others, (k,);
      in a singular configuration `rank` is smaller than their sum.
    - `closest`: smallest distance from a singular configuration at any stage of any step.

    All that is read by the methods below comes as arrays with times as the first axis, in ground
    axes and SI units. A solution from `jax.vmap` has the batch axes before that.
    """

    mechanism: Mechanism
    accuracy: Accuracy
    ts: Float[Array, "*batch n_t"]
    q: Float[Array, "*batch n_t n_q"] | None
    v: Float[Array, "*batch n_t n_v"] | None
    ys: Any
    t_end: Float[Array, "*batch"]
    end: State
    stats: dict[str, Any]
    result: RESULTS
    rank_nearby: Int[Array, "*batch k"] | None
    closest: Float[Array, "*batch"]
    interpolation: Any

    @staticmethod
    def of_state(mechanism: Mechanism, state: State, *, t=0.0, accuracy: Accuracy = BALANCED) -> "Solution":
        """A solution of one time, to read reactions, energies or accelerations at a `State` on the closed loops."""
        t = jnp.asarray(t, state.q.dtype)
        return Solution(
            mechanism=mechanism,
            accuracy=accuracy,
            ts=t[None],
            q=state.q[None],
            v=state.v[None],
            ys=None,
            t_end=t,
            end=state,
            stats={},
            result=RESULTS.successful,
            rank_nearby=None,
            closest=jnp.ones((), state.q.dtype),
            interpolation=None,
        )

    def position(self, body: str, at=None) -> Float[Array, "*batch n_t 3"]:
        """Position of a body's centre of mass, or of the point `at` on it [m].

        `at`: the name of one of the body's frames, or [x, y, z] in its reference frame [m].
        """
        return _over_times(_position, self, self._body(body), self._point(body, at))

    def velocity(self, body: str, at=None) -> Float[Array, "*batch n_t 3"]:
        """Velocity of a body's centre of mass, or of the point `at` on it [m/s]."""
        return _over_times(_velocity, self, self._body(body), self._point(body, at))

    def acceleration(self, body: str, at=None) -> Float[Array, "*batch n_t 3"]:
        """Acceleration of a body's centre of mass, or of the point `at` on it [m/s²]."""
        return _over_times(_acceleration, self, self._body(body), self._point(body, at))

    def orientation(self, body: str) -> Float[Array, "*batch n_t 3 3"]:
        """Axes of a body's reference frame, as columns."""
        return _over_times(_orientation, self, self._body(body))

    def angular_velocity(self, body: str) -> Float[Array, "*batch n_t 3"]:
        """Angular velocity of a body [rad/s]."""
        return _over_times(_angular_velocity, self, self._body(body))

    def joint(self, name: str) -> Float[Array, "..."]:
        """Coordinate of a joint, in the tree or cut [rad or m]; (n_t, n) where it has several."""
        return self._joint(_joint, name)

    def joint_speed(self, name: str) -> Float[Array, "..."]:
        """Speed of a joint, in the tree or cut [rad/s or m/s]."""
        return self._joint(_joint_speed, name)

    def reaction(self, name: str, *, on: Side = "child", axes: Axes = "ground"):
        """What a joint or a constraint does.

        **Arguments:**

        - `name`: of a joint in the tree or cut, or of a constraint.
        - `on`: "child" or "parent" of the joint. The moment is about the origin of its frame.
        - `axes`: "ground", or "joint": h¹, h², h³ of the joint on that body.

        **Returns:** a `Reaction` of forces [N] and moments [N m], (n_t, 3) each. For a drive, its
        torque [N m] or force [N] along the joint, (n_t,); for a coupling, μ: it acts along each
        joint with coefficient × μ.

        With redundant constraints, reactions are not unique: these are of minimum norm, and
        `reaction_unique` tells which components can be relied upon.
        """
        if name in self.mechanism.topology.constraints:
            return _over_times(_constraint_force, self, self.mechanism.topology.constraints.index(name))
        return self._of_joint(_reactions, name, on, axes)

    def reaction_unique(self, name: str, *, on: Side = "child", axes: Axes = "ground"):
        """Which components of `reaction` the mechanics determine, as booleans of the same shapes.

        A component is unique where no self-stress of the redundant constraints changes it
        (Wojtyra, Multibody System Dynamics 13, 2005). Rigid bodies determine no more: the rest
        depends on elasticity, assembly, and here on the choice of the tree.
        """
        if name in self.mechanism.topology.constraints:
            return _over_times(_constraint_unique, self, self.mechanism.topology.constraints.index(name))
        return self._of_joint(_unique, name, on, axes)

    def reactions(self) -> dict[str, Reaction]:
        """The reactions of all joints on their children, in ground axes, by name."""
        force, moment = _over_times(_reactions, self, "child", "ground")
        names = enumerate(self.mechanism.topology.joints)
        return {name: Reaction(force[..., index, :], moment[..., index, :]) for index, name in names}

    def energy(self) -> Float[Array, "*batch n_t"]:
        """Kinetic plus potential energy [J]."""
        return self.kinetic_energy() + self.potential_energy()

    def kinetic_energy(self) -> Float[Array, "*batch n_t"]:
        """Kinetic energy [J]."""
        return _over_times(_kinetic_energy, self)

    def potential_energy(self) -> Float[Array, "*batch n_t"]:
        """Potential energy of the force elements that have one [J]."""
        return _over_times(_potential_energy, self)

    def violation(self) -> Violation:
        """Largest violation of the loop rows at each time."""
        return _over_times(_violation, self)

    def worst_violation(self) -> Violation:
        """Over all times, relative: to the run's largest speed and acceleration where those apply.

        Positions count in radians and lengths of the loop, speeds and accelerations of the
        joints in radians and lengths of the mechanism; the square of a speed counts as an
        acceleration, since uniform motion of the joints accelerates the bodies.
        """
        violation, (speed, acceleration) = self.violation(), _over_times(_largest, self)
        largest = lambda values: jnp.max(jnp.where(jnp.isfinite(self.ts), values, 0.0), axis=-1)
        relative = lambda values, scale: values / jnp.where(scale > 0.0, scale, 1.0)
        return Violation(
            largest(violation.position),
            relative(largest(violation.velocity), largest(speed)),
            relative(largest(violation.acceleration), largest(acceleration)),
        )

    def rank(self) -> Int[Array, "*batch n_t"]:
        """Number of independent loop rows."""
        return _over_times(_rank, self)

    def singularity_distance(self) -> Float[Array, "*batch n_t"]:
        """Distance d from the nearest singular configuration, see `linkax.Accuracy`."""
        return _over_times(_distance, self)

    def passages(self) -> Passages:
        """Times at which the motion goes through singular configurations, and the digits lost.

        Outside of JAX transformations, for one run.

        **Raises:** `ValueError` for a batch, or where functions of one's own were saved.
        """
        return passages(self)

    def evaluate(self, t) -> State:
        """The state at a time [s] between the steps; needs `saveat=SaveAt(dense=True)`."""
        if self.interpolation is None:
            raise ValueError("evaluate needs a dense solution; simulate with saveat=diffrax.SaveAt(dense=True)")
        return _evaluate(self, t)

    def _of_joint(self, function, name, on, axes):
        """Of reactions of all joints, so that all names share a program, those of one."""
        for what, entry, choices in (("on", on, get_args(Side)), ("axes", axes, get_args(Axes))):
            if entry not in choices:
                raise ValueError(f"{what} is {entry!r}; known: {', '.join(map(repr, choices))}")
        self.mechanism.joint(name)
        index = self.mechanism.topology.joints.index(name)
        force, moment = _over_times(function, self, on, axes)
        return Reaction(force[..., index, :], moment[..., index, :])

    def _body(self, name):
        self.mechanism.body(name)
        return self.mechanism.topology.bodies.index(name)

    def _point(self, body, at):
        found = self.mechanism.body(body)
        if at is None:
            return found.center_of_mass
        if isinstance(at, str):
            return found.at(at).offset
        offset = number(at, (3,), f"point on body {body!r} [m]")
        return jnp.broadcast_to(offset, (*self.ts.shape[:-1], 3))

    def _joint(self, function, name):
        self.mechanism.joint(name)
        values = _over_times(function, self, name)
        return values[..., 0] if values.shape[-1] == 1 else values


@eqx.filter_jit
def _over_times(function, solution, *details):
    """Evaluate a function of an instant at all times of all members of a batch."""
    if solution.q is None:
        raise ValueError("this solution saved functions of its own in ys; simulate without SaveAt(fn=...)")

    def of_member(solution, *details):
        system = system_of(solution.mechanism, solution.q.dtype)
        method = solution.accuracy.method(solution.q.dtype, solution.rank_nearby)
        of_time = lambda t, q, v: function(_Instant(system, method, t, q, v), *details)
        return jax.vmap(of_time)(solution.ts, solution.q, solution.v)

    for _ in range(solution.ts.ndim - 1):
        of_member = eqx.filter_vmap(of_member)
    return of_member(solution, *details)


@eqx.filter_jit
def _evaluate(solution, t):
    dtype = solution.end.q.dtype
    system, method = system_of(solution.mechanism, dtype), solution.accuracy.method(dtype, solution.rank_nearby)
    t = jnp.asarray(t, dtype)
    y = solution.interpolation.evaluate(t)
    return Problem(solution.mechanism, system, method, solution.accuracy).close(t, y)


def _arm(configuration, body, point):
    return rotate(configuration.rotation[body], point)


def _position(instant, body, point):
    configuration = instant.configuration
    return configuration.world_position()[body] + _arm(configuration, body, point)


def _velocity(instant, body, point):
    motion = instant.motion
    arm = _arm(motion.configuration, body, point)
    return motion.velocity[body] + cross(motion.angular_velocity[body], arm)


def _acceleration(instant, body, point):
    motion = instant.motion
    arm, omega = _arm(motion.configuration, body, point), motion.angular_velocity[body]
    angular, linear = body_accelerations(motion, instant.dynamics.acceleration)
    return linear[body] + cross(angular[body], arm) + cross(omega, cross(omega, arm))


def _orientation(instant, body):
    return instant.configuration.rotation[body]


def _angular_velocity(instant, body):
    return instant.motion.angular_velocity[body]


def _joint(instant, name):
    return instant.configuration.joint_coordinates(name)


def _joint_speed(instant, name):
    return instant.motion.joint_speeds(name)


def _least_multipliers(instant):
    dynamics, configuration = instant.dynamics, instant.configuration
    if not instant.system.topology.num_rows:
        return LeastMultipliers(dynamics.multipliers, jnp.zeros((0, 0)))
    tolerance = instant.method.rank_tolerance
    rows, units = jacobian(configuration), instant.system.units
    return least_multipliers(rows, dynamics.multipliers, units, tolerance, dynamics.rank)


def _reactions(instant, on, axes):
    found = reactions(instant.motion, instant.dynamics.acceleration, _least_multipliers(instant).multipliers)
    return seen_from(instant.configuration, found, on, axes)


def _constraint_force(instant, constraint):
    multipliers = _least_multipliers(instant).multipliers
    return sorted_multipliers(instant.configuration, multipliers).constraints[constraint]


def _self_stresses(instant):
    """Multipliers with Jᵀλ = 0, a row each: those of rows that motion changes, and of rows that none does."""
    topology = instant.system.topology
    immobile = len(topology.immobile_rotation_rows) + len(topology.immobile_translation_rows)
    free = _least_multipliers(instant).free.T
    size = len(free) + immobile
    stresses = jnp.zeros((size, size), instant.q.dtype).at[: len(free), : len(free)].set(free)
    stresses = stresses.at[len(free) :, len(free) :].set(jnp.eye(immobile))
    return jnp.split(stresses, [len(free)], axis=1)


def _unique(instant, on, axes):
    configuration = instant.configuration

    def changes(multipliers, immobile):
        return seen_from(configuration, reactions_to(configuration, multipliers, immobile), on, axes)

    force, moment = jax.vmap(changes)(*_self_stresses(instant))
    # Multipliers are moments, forces times the length of their loop.
    still = lambda change: jnp.max(jnp.abs(change), axis=0, initial=0.0) <= UNCHANGED
    return Reaction(still(force * instant.system.length), still(moment))


def _constraint_unique(instant, constraint):
    topology = instant.system.topology
    row = topology.num_rows - len(topology.constraints) + constraint
    return jnp.max(jnp.abs(_self_stresses(instant)[0][:, row]), initial=0.0) <= UNCHANGED


def _kinetic_energy(instant):
    return kinetic_energy(instant.motion)


def _potential_energy(instant):
    return potential_energy(instant.configuration)


def _violation(instant):
    configuration = instant.configuration
    position = jnp.concatenate([residual(configuration), immobile_residual(configuration)])
    velocity = jacobian(configuration) @ instant.v - rate(instant.system, instant.t)
    return Violation(*map(_size, (position, velocity, instant.dynamics.violation)))


def _size(rows):
    return jnp.max(jnp.abs(rows), initial=0.0)


def _largest(instant):
    units = instant.system.units
    speed = _size(instant.v / units)
    return speed, jnp.maximum(_size(instant.dynamics.acceleration / units), speed**2)


def _rank(instant):
    return instant.dynamics.rank


def _distance(instant):
    return instant.dynamics.distance
