"""What can be read from a motion at one time; `linkax.Solution` reads it at all its times."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import Configuration, along_speeds, beam_point, configure
from linkax.equations.coordinates import rates
from linkax.equations.dynamics import body_accelerations, kinetic_energy, potential_energy
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.loops import immobile_residual, jacobian, rate, residual, sorted_multipliers
from linkax.equations.motion import Motion, move
from linkax.equations.reactions import Axes, Reaction, Side, reactions, reactions_to, seen_from
from linkax.equations.system import System
from linkax.formulations.formulation import AbstractFormulation, Dynamics
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.least_multipliers import LeastMultipliers, least_multipliers
from linkax.model.beams import Beam
from linkax.model.mechanism import Mechanism
from linkax.model.poses import Pose
from linkax.simulation.read.summary import of_power, of_violation
from linkax.spatial.rotations import rotate
from linkax.spatial.vectors import cross, dot, largest, length
from linkax.tables import printed_as
from linkax.xla.arrays import Array, Scalar

UNCHANGED = 1e-6  # by a self-stress of magnitude one


@printed_as(of_violation)
class Violation(NamedTuple):
    """Largest violation of the loop rows, at each time or over the run.

    - `position`: c, rotation rows [rad], translation rows in lengths of the loop.
    - `velocity`: J v − b [1/s]. `acceleration`: J v̇ − γ [1/s²].
    """

    position: Float[Array, "..."]
    velocity: Float[Array, "..."]
    acceleration: Float[Array, "..."]


@printed_as(of_power)
class Power(NamedTuple):
    """The rate of kinetic plus potential energy, by its causes [W].

    - `forces`: force elements, beyond the fall of their potential energy; damping counts as negative.
    - `drives`: constraints that change with time: drives, winches, cylinders.
    """

    forces: Float[Array, "..."]
    drives: Float[Array, "..."]


def do_work(mechanism: Mechanism | System) -> tuple[list[int], list[int]]:
    """Indices of the force elements that change the energy, and of the constraints that change with time."""
    forces = [index for index, force in enumerate(mechanism.forces) if not force.conserves_energy]
    return forces, [index for index, constraint in enumerate(mechanism.constraints) if constraint.is_driven]


class Observables(NamedTuple):
    """The state at one time, and what follows from it.

    - `method`: the formulation that moved it. `tangent_space`: splits into normal and tangent space.
    - `dynamics`: what `solve` returns, for functions that need accelerations or multipliers.
    - `internal`: internal states of force elements, to which those of `system` are bound; None where they have none.
    """

    system: System
    method: AbstractFormulation
    tangent_space: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    dynamics: Dynamics | None = None
    internal: Float[Array, " n_s"] | None = None

    @property
    def configuration(self) -> Configuration:
        return configure(self.system, self.t, self.q)

    @property
    def motion(self) -> Motion:
        return move(self.configuration, self.v)

    @property
    def solved(self) -> Dynamics:
        """`dynamics`, of an instance that has them."""
        assert self.dynamics is not None
        return self.dynamics

    def closed(self) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], Bool[Array, ""]]:
        """q and v on the loops, and whether they are, near to where they were."""
        q, v, holds = self.method.close_near(self.system, self.t, self.q, self.v)
        return q, v, jnp.asarray(holds)

    def solve(self) -> Dynamics:
        return self.method.dynamics(self.system, self.t, self.q, self.v)

    def position(self, body: Int[Array, "*bodies"], point: Float[Array, "3"]) -> Float[Array, "*bodies 3"]:
        configuration = self.configuration
        return configuration.world_position()[body] + _arm(configuration, body, point)

    def velocity(self, body: Int[Array, "*bodies"], point: Float[Array, "3"]) -> Float[Array, "*bodies 3"]:
        motion = self.motion
        arm = _arm(motion.configuration, body, point)
        return motion.velocity[body] + cross(motion.angular_velocity[body], arm)

    def acceleration(self, body: Int[Array, "*bodies"], point: Float[Array, "3"]) -> Float[Array, "*bodies 3"]:
        motion = self.motion
        arm, omega = _arm(motion.configuration, body, point), motion.angular_velocity[body]
        angular, linear = body_accelerations(motion, self.solved.acceleration)
        return linear[body] + cross(angular[body], arm) + cross(omega, cross(omega, arm))

    def center_of_mass(self, function: Callable[..., Any], bodies: Int[Array, " n"]) -> Float[Array, "3"]:
        """Apply `position`, `velocity` or `acceleration` to the common centre of mass of several bodies."""
        of_bodies = function(self, bodies, jnp.zeros(3, self.q.dtype))
        mass = self.system.mass[bodies]
        return mass @ of_bodies / jnp.sum(mass)

    def on_beam(self, function: Callable[..., Any], beam: Beam, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Apply the same to a point fixed to the section of a beam at point[0]."""
        place = lambda t, q: beam_point(configure(self.system, t, q), beam, point)
        if function is Observables.position:
            return place(self.t, self.q)
        moving = lambda t, q, v: jax.jvp(place, (t, q), (jnp.ones_like(t), rates(self.system.topology, q, v)))[1]
        if function is Observables.velocity:
            return moving(self.t, self.q, self.v)
        changes = jnp.ones_like(self.t), rates(self.system.topology, self.q, self.v), self.solved.acceleration
        return jax.jvp(moving, (self.t, self.q, self.v), changes)[1]

    def poses(self) -> Pose:
        configuration = self.configuration
        return Pose(configuration.world_position(), configuration.rotation[: self.system.topology.num_bodies])

    def orientation(self, body: Int[Array, ""]) -> Float[Array, "3 3"]:
        return self.configuration.rotation[body]

    def angular_velocity(self, body: Int[Array, ""]) -> Float[Array, "3"]:
        return self.motion.angular_velocity[body]

    def angular_acceleration(self, body: Int[Array, ""]) -> Float[Array, "3"]:
        return body_accelerations(self.motion, self.solved.acceleration)[0][body]

    def joint(self, name: str) -> Float[Array, " n"]:
        return self.configuration.joint_coordinates(name)

    def joint_speed(self, name: str) -> Float[Array, " n"]:
        return self.motion.joint_speeds(name)

    def joint_acceleration(self, name: str) -> Float[Array, " n"]:
        topology, system = self.system.topology, self.system
        if name in topology.speeds:
            return self.solved.acceleration[topology.speeds[name]]
        speeds = lambda t, q, v: move(configure(system, t, q), v).joint_speeds(name)
        changes = jnp.ones_like(self.t), rates(topology, self.q, self.v), self.solved.acceleration
        return jax.jvp(speeds, (self.t, self.q, self.v), changes)[1]

    def _least_multipliers(self):
        multipliers = self.solved.multipliers
        if not self.system.topology.num_rows:
            return LeastMultipliers(multipliers, jnp.zeros((0, 0)))
        tolerance = self.tangent_space.tolerance
        rows, scales = jacobian(self.configuration), self.system.scales
        return least_multipliers(rows, multipliers, scales, tolerance, self.rank())

    def _multipliers(self):
        """λ of minimum norm; of the paper's method, close to a singular configuration, as a limit along the motion."""
        if isinstance(self.method, TangentSpace) and self.system.topology.num_rows:
            return self.method.least_multipliers(self.system, self.t, self.q, self.v)
        return self._least_multipliers().multipliers

    def reactions(self, on: Side, axes: Axes) -> Reaction:
        found = reactions(self.motion, self.solved.acceleration, self._multipliers())
        return seen_from(self.configuration, found, on, axes)

    def constraint_forces(self) -> Float[Array, " k"]:
        return sorted_multipliers(self.configuration, self._multipliers()).constraints

    def _self_stresses(self):
        """Multipliers with Jᵀλ = 0, a row each: of rows that motion can change, and of rows that none can."""
        topology = self.system.topology
        immobile = topology.num_immobile_rows
        free = self._least_multipliers().free.T
        size = len(free) + immobile
        stresses = jnp.zeros((size, size), self.q.dtype).at[: len(free), : len(free)].set(free)
        stresses = stresses.at[len(free) :, len(free) :].set(jnp.eye(immobile))
        return jnp.split(stresses, [len(free)], axis=1)

    def unique(self, on: Side, axes: Axes) -> Reaction:
        configuration = self.configuration

        def changes(multipliers, immobile):
            return seen_from(configuration, reactions_to(configuration, multipliers, immobile), on, axes)

        force, moment = jax.vmap(changes)(*self._self_stresses())
        # Multipliers are moments, forces times the length of their loop.
        still = lambda change: jnp.max(jnp.abs(change), axis=0, initial=0.0) <= UNCHANGED
        return Reaction(still(force * self.system.length), still(moment))

    def unique_constraint_forces(self) -> Bool[Array, " k"]:
        topology = self.system.topology
        rows = self._self_stresses()[0][:, topology.num_rows - topology.num_constraint_rows :]
        return jnp.max(jnp.abs(rows), axis=0, initial=0.0) <= UNCHANGED

    def energies(self) -> tuple[Float[Array, ""], Scalar]:
        """Kinetic and potential energy [J]."""
        motion = self.motion
        return kinetic_energy(motion), potential_energy(motion.configuration)

    def powers_of_forces(self) -> Float[Array, " n"]:
        """Of each of the force elements that `do_work`, beyond the fall of its potential energy."""
        motion, configuration, system = self.motion, self.configuration, self.system
        forces = [system.forces[index] for index in do_work(system)[0]]

        def energies(q, internal=None):
            of = bound(system, internal)
            return [of.forces[index].potential_energy(configure(of, self.t, q)) for index in do_work(of)[0]]

        at, changes = (self.q,), (rates(system.topology, self.q, self.v),)
        if self.internal is not None:
            at, changes = (*at, self.internal), (*changes, internal_rates(motion))
        _, rises = jax.jvp(energies, at, changes)
        found = [jnp.zeros(0, self.q.dtype)]
        for force, rise in zip(forces, rises, strict=True):
            load = force.applied(self.t, motion)
            along = load.joint_force + along_speeds(configuration, load.force, load.moment)
            found.append((along @ self.v + rise)[None])
        return jnp.concatenate(found)

    def internal_changes(self) -> tuple[Float[Array, " n_s"], Float[Array, " n_s"]]:
        """First and second derivatives by time of the internal states."""

        def changes(t, q, v, internal):
            return internal_rates(move(configure(bound(self.system, internal), t, q), v))

        at = self.t, self.q, self.v, self.internal
        first = changes(*at)
        along = jnp.ones_like(self.t), rates(self.system.topology, self.q, self.v), self.solved.acceleration, first
        return jax.jvp(changes, at, along)

    def powers_of_drives(self) -> Float[Array, " n"]:
        """Of each of the constraints that `do_work`."""
        of_rows, (_, driven) = self.solved.multipliers * rate(self.configuration), do_work(self.system)
        of_rows, topology = of_rows[len(of_rows) - self.system.topology.num_constraint_rows :], self.system.topology
        of_driven = np.array(driven, int)[:, None] == topology.constraint_of_row
        return jnp.sum(jnp.where(of_driven, of_rows, 0.0), axis=1)

    def power(self) -> Power:
        return Power(jnp.sum(self.powers_of_forces()), jnp.sum(self.powers_of_drives()))

    def strength(self, index: int) -> Float[Array, ""] | Float[Array, "3"]:
        """Of a force element."""
        force, motion = self.system.forces[index], self.motion
        return force.strength(self.t, motion, *force.side(self.t, motion))

    def tension(self, index: int) -> Float[Array, ""]:
        """Of a `Distance`, by the index of its joint."""
        apart = self.configuration.separation[index - self.system.topology.num_bodies]
        return -dot(self.reactions("child", "ground").force[index], apart) / length(apart)

    def extent(self, of: str, index: int) -> Float[Array, ""]:
        """Length of a force element, a constraint or a `Distance`."""
        if of == "joints":
            return length(self.configuration.separation[index - self.system.topology.num_bodies])
        return getattr(self.system, of)[index].extent(self.configuration)

    def violation_and_scales(self) -> tuple[Violation, Float[Array, ""], Float[Array, ""]]:
        """The violation, and the largest speed and acceleration of the joints [1/s, 1/s²]."""
        configuration = self.configuration
        position = jnp.concatenate([residual(configuration), immobile_residual(configuration)])
        velocity = jacobian(configuration) @ self.v - rate(configuration)
        violation = Violation(*map(largest, (position, velocity, self.solved.violation)))
        speed = self.system.fastest(self.v)
        return violation, speed, jnp.maximum(self.system.fastest(self.solved.acceleration), speed**2)

    def rank(self) -> Int[Array, ""]:
        return jnp.sum(self.tangent_space.constraint_split(self.system, self.t, self.q).inverse.rank)

    def rank_and_distance(self) -> tuple[Int[Array, ""], Float[Array, ""]]:
        return self.rank(), self.tangent_space.distance(self.system, self.t, self.q)


def _arm(configuration, body, point):
    return rotate(configuration.rotation[body], point)
