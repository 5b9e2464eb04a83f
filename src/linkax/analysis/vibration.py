"""Linearise the equations of motion about an equilibrium or a steady motion, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Bool, Float

from linkax.analysis.linearisation import EQUAL_ULPS, Linearisation, StateSlopes, gyroscopic_frequencies, state_matrix
from linkax.analysis.steady import (
    AGREES,
    Nearby,
    eigh,
    instants,
    largest_force,
    may_move,
    missed_rates,
    of_missed_rate,
    system_in,
    widest_gap,
)
from linkax.equations.configuration import configure
from linkax.equations.coordinates import carried, retract
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.loops import jacobian
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.model.forces.internal_states import scales
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import whole_number
from linkax.simulation.explain.diagnosis import massless_bodies
from linkax.simulation.start.initial_state import moving_joints
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.program import Program
from linkax.xla.tracing import all_concrete, concrete
from linkax.xla.undefined import undefined_where

NEAR = 1e-6  # distance from an equilibrium up to which a state counts as in it [rad, lengths of the mechanism]
UNFELT = 1e-9  # forces that rounding leaves, relative to all forces
CONSTANT = 1e-5  # relative change of coefficients and loops up to which they count as constant
ROUNDING_ULPS = 1e5  # error of a stiffness, in units of rounding of the largest one


class _Moving(Nearby):
    """A mechanism near coordinates q and speeds v.

    T is orthonormal in the mass metric, Tᵀ M T = 1, also where the mechanism's numbers change.
    """

    v: Float[Array, " n_v"]

    @staticmethod
    def of(
        system: System, method: TangentSpace, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> "_Moving":
        departure = method.at_rest(system, t, q)
        split, mass = departure.split, departure.mass
        fixed = split.inverse.basis
        still = jnp.zeros(len(split.jacobian), mass.dtype)

        def tangent(column):
            return constrained_solve(split.inverse, mass, split.jacobian, mass @ column, still)[0]

        basis = jax.vmap(tangent, in_axes=1, out_axes=1)(fixed)
        empty = jnp.diag((jnp.sum(fixed**2, axis=0) == 0.0).astype(mass.dtype))
        basis = basis @ cholesky_inverse_by_elimination(basis.T @ mass @ basis + empty)[0].T
        return _Moving(system, method, t, q, basis, basis.T @ mass, v)

    def after(self, t: Float[Array, ""], motion: Float[Array, " n_v"]) -> "_Moving":
        """The same mechanism at time t, displaced by `motion`, with T carried along."""
        carry = lambda change: carried(self.system.topology, motion, change)
        basis, dual = jax.vmap(carry, in_axes=1, out_axes=1)(self.basis), jax.vmap(carry)(self.dual)
        q = retract(self.system.topology, self.q, motion)
        return dataclasses.replace(self, t=t, q=q, basis=basis, dual=dual)

    def acceleration(self, y: Float[Array, " n_v"], y_rate: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
        """ÿ, in coordinates y that move with the steady motion: q(t) ⊕ T y."""
        along = self.basis @ y_rate
        _, acceleration, *_ = self.method.derivative(self.system, self.t, self.at(y), self.v + along, True)
        if len(self.system.topology.quaternions):
            carry = lambda time: carried(self.system.topology, time * self.v, along)
            nothing = jnp.zeros((), y.dtype)
            acceleration = acceleration - jax.jvp(carry, (nothing,), (nothing + 1.0,))[1]
        return self.dual @ acceleration

    def coefficients(self) -> tuple[Float[Array, " n_v"] | Float[Array, "n_v n_v"], ...]:
        """ÿ at y = ẏ = 0, the stiffness −∂ÿ/∂y and the damping −∂ÿ/∂ẏ."""
        origin = jnp.zeros_like(self.system.scales)
        of_both = lambda both: self.acceleration(*jnp.split(both, 2))
        acceleration, slopes = self.slopes(of_both, jnp.concatenate([origin, origin]))
        return acceleration, *jnp.split(-slopes, 2, axis=1)

    def opens(self) -> Float[Array, ""]:
        """The largest gap of the loops, rate that speeds miss, or slope at which T opens the loops."""
        slopes = jacobian(configure(self.system, self.t, self.q)) @ self.basis
        apart = ratio(largest(slopes), largest(self.basis / self.system.scales[:, None]))
        misses = missed_rates(self.system, self.t, self.q, self.v)
        gap = widest_gap(self.system, self.t, self.q)
        return jnp.maximum(jnp.maximum(apart, gap), jnp.max(misses, initial=0.0))


class _Steadiness(NamedTuple):
    """By how much a state fails to make its linearisation constant; all zero in an equilibrium or steady motion.

    - `missed`: by how much speeds miss the rates that loops and drives ask for, (m,).
    - `off`: distance from an equilibrium [rad, lengths of the mechanism]. `acceleration`: of the tree's joints, (n_v,).
    - `changes`: relative change of coefficients and loops as the motion goes on.
    - `of_states`: how far internal states are off where they stand still, (n_s,), or other coordinates by which they
      would [scales of the states, rad, lengths of the mechanism].
    """

    missed: Float[Array, " m"]
    off: Float[Array, ""]
    acceleration: Float[Array, " n_v"]
    changes: Float[Array, ""]
    of_states: Float[Array, " n_s"]

    @property
    def is_steady(self) -> Bool[Array, ""]:
        """Whether all of them are negligible."""
        still = jnp.max(self.of_states, initial=0.0) <= NEAR
        return (jnp.max(self.missed, initial=0.0) <= AGREES) & (self.off <= NEAR) & (self.changes <= CONSTANT) & still


def linearise(
    mechanism: Mechanism, state: State, *, t: ArrayLike = 0.0, degrees_of_freedom: int | None = None
) -> Linearisation:
    """Find natural frequencies and modes about an equilibrium or a steady motion, see `linkax.equilibrium`.

    Where all speeds of the state are zero, drives hold their joints in their positions at time t [s]. Else drives go
    on, at rates that the state must have. In a steady motion joints go on at constant speeds, driven or not, and
    neither the loops nor the forces in axes that turn with the joints change.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`. `t`: time [s].
    - `degrees_of_freedom`: number d of the mechanism. JAX transformations need it, since they cannot count.

    **Returns:** a `Linearisation`.

    Internal states of force elements, such as pressures, are those of the state, and stand still there too; what they
    add is in `states` and `eigenvalues`.

    **Raises:** `ValueError` for a state that is neither in equilibrium nor in steady motion. Inside JAX transformations
    nothing is raised, and the numbers are NaN.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    if degrees_of_freedom is None:
        rank = concrete(_rank(mechanism, state, t))
        if rank is None:
            raise ValueError("linearise inside a JAX transformation needs degrees_of_freedom=; give their number")
        degrees_of_freedom = mechanism.topology.num_speeds - int(rank)
    asked = whole_number(degrees_of_freedom, "degrees_of_freedom", least=0)
    linearisation, counted, steadiness = _linearise(mechanism, state, t, asked, may_move(state))
    if concrete(counted) is not None and counted != asked:
        raise ValueError(f"degrees_of_freedom is {asked}; the mechanism has {counted} here: give that, or leave it out")
    if not all_concrete((linearisation, steadiness)):
        mark = lambda leaf: jnp.where(steadiness.is_steady, leaf, jnp.nan)
        return marked(mechanism, jax.tree.map(mark, linearisation))
    if not np.all(np.isfinite(linearisation.natural_frequencies)):
        system = system_of(mechanism, state.q.dtype)
        massless = massless_bodies(system, TangentSpace().prepared(system.dtype), t, state.q)
        why = f"bodies {', '.join(map(repr, massless))} move without mass" if massless else "forces are not finite"
        raise ValueError(f"frequencies are not finite, because {why}; give mass and inertia, or finite numbers")
    _check_steady(mechanism, state, t, steadiness)
    return marked(mechanism, linearisation)


def _check_steady(mechanism, state, t, steadiness):
    """Raise a ValueError where the linearisation would not be constant."""
    missed, topology, when = np.asarray(steadiness.missed), mechanism.topology, f"at t = {float(t):.6g} s"
    if not np.max(missed, initial=0.0) <= AGREES:
        told = of_missed_rate(mechanism, missed, int(np.argmax(missed)), t)
        raise ValueError(f"{told}, or give it speeds of zero, where drives hold")
    acceleration = np.asarray(steadiness.acceleration)
    if not steadiness.off <= NEAR:
        system = system_of(mechanism, state.q.dtype)
        column = int(np.argmax(np.abs(acceleration / np.asarray(system.scales))))
        joint = next(name for name, columns in topology.speeds.items() if columns.start <= column < columns.stop)
        raise ValueError(
            f"the state is {float(steadiness.off):.3g} off an equilibrium, in radians or lengths of the mechanism: "
            f"joint {joint!r} accelerates by {acceleration[column]:.6g} {when}; begin with linkax.equilibrium"
        )
    of_states = np.asarray(steadiness.of_states)
    if not np.max(of_states, initial=0.0) <= NEAR:
        names = [f"{name!r} of {force.display_name}" for force in mechanism.forces for name in force.states]
        counts = [entry.initial.size for force in mechanism.forces for entry in force.states.values()]
        worst = np.repeat(names, counts)[np.argmax(of_states)]
        raise ValueError(
            f"the internal state {worst} changes {when}: it is {np.max(of_states):.3g} of its scale off where it "
            "stands still; simulate until it rests"
        )
    if not steadiness.changes <= CONSTANT:
        system = system_of(mechanism, state.q.dtype)
        names = ", ".join(map(repr, moving_joints(system, t, state.q, state.v[:, None])))
        raise ValueError(
            f"the motion of joints {names} is not steady: stiffness or loops change by {float(steadiness.changes):.3g} "
            "as it goes on; simulate it, or give a state with speeds of zero"
        )


@Program
def _rank(mechanism, state, t):
    """Number of independent constraints, drives included."""
    system = system_in(mechanism, state, t, False)
    return jnp.sum(TangentSpace().prepared(system.dtype).constraint_split(system, t, state.q).inverse.rank)


@Program
def _linearise(mechanism, state, t, count, moves):
    """A `Linearisation`, the degrees of freedom counted at the state, and the `_Steadiness`."""
    system = bound(system_in(mechanism, state, t, moves), state.internal)
    v = state.v if moves else jnp.zeros(system.topology.num_speeds, system.dtype)
    moving = _Moving.of(system, TangentSpace().prepared(system.dtype), t, state.q, v)
    empty = jnp.sum(moving.basis**2, axis=0) == 0.0
    columns = jnp.argsort(empty)[:count]
    (stiffness, damping), history = _coefficients(moving, columns, moves)
    basis, symmetric = moving.basis[:, columns], (stiffness + stiffness.T) / 2.0
    modes = _Modes.of(system, basis, lax.stop_gradient(symmetric), moving.v)
    states, of_states, felt = None, jnp.zeros(0, system.dtype), 0.0
    if state.internal is not None:
        units = scales(mechanism.forces, system.dtype)
        states, of_states = _states(moving, basis, moving.dual[columns], state.internal, units)
        felt = jnp.abs(modes.vectors.T @ states.force) @ units
    steadiness = _steadiness(moving, state, basis, modes, history, felt)._replace(of_states=of_states)
    frequencies, mode_speeds = _frequencies(moving, basis, symmetric, damping, moves and count)
    linearisation = Linearisation(
        natural_frequencies=frequencies,
        modes=mode_speeds,
        basis=basis,
        stiffness=stiffness,
        damping=damping,
        states=states,
    )
    return linearisation, jnp.sum(jnp.logical_not(empty)), lax.stop_gradient(steadiness)


def _states(moving, basis, dual, internal, units) -> tuple[StateSlopes, Float[Array, " n_s"]]:
    """What internal states add, and how far each is off where it stands still, see `_Steadiness`."""
    topology, still = moving.system.topology, jnp.zeros(basis.shape[1], internal.dtype)

    def changes(y, y_rate, internal):
        system = bound(moving.system, internal)
        place = retract(topology, moving.q, basis @ y), moving.v + basis @ y_rate
        v, acceleration, q, _ = moving.method.derivative(system, moving.t, *place, True)
        return dual @ acceleration, internal_rates(move(configure(system, moving.t, q), v))

    (_, rates), slopes = changes(still, still, internal), jax.jacfwd(changes, (0, 1, 2))(still, still, internal)
    (_, _, force), (by_coordinates, by_speeds, by_states) = slopes
    # The rate that each would have where all coordinates and states were off by one in their scales.
    size = jax.vmap(moving.system.fastest, in_axes=1)(basis)
    sensitivity = jnp.abs(by_coordinates) @ ratio(jnp.ones_like(size), size, 0.0) + jnp.abs(by_states) @ units
    felt = jnp.abs(rates) > UNFELT * sensitivity
    off = jnp.where(felt, ratio(jnp.abs(rates), sensitivity, jnp.inf), 0.0)
    return StateSlopes(force, by_coordinates, by_speeds, by_states), off


def _coefficients(moving, columns, moves):
    """Stiffness and damping at the state, and (ÿ, stiffness, damping, gap of the loops) now and at later instants."""

    def at_instant(moving):
        acceleration, stiffness, damping = moving.coefficients()
        reduced = (matrix[columns[:, None], columns[None, :]] for matrix in (stiffness, damping))
        return acceleration[columns], *reduced, moving.opens() if moves else jnp.zeros((), moving.system.dtype)

    now = at_instant(moving)
    history = jax.tree.map(lambda part: part[None], lax.stop_gradient(now))
    if moves:
        still = lax.stop_gradient(moving)
        later = instants(moving.system, still.t, still.v)
        after = lax.map(lambda instant: at_instant(still.after(*instant)), later)
        history = jax.tree.map(lambda *parts: jnp.concatenate(parts), history, after)
    return now[1:3], history


def _frequencies(moving, basis, symmetric, damping, may_couple):
    """Natural frequencies, and speeds of the tree's joints in each mode, NaN where gyroscopic terms couple them."""
    system, couples, gyroscopic = moving.system, jnp.zeros((), bool), (damping - damping.T) / 2.0
    if may_couple:
        rounding = ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(jnp.abs(damping))
        couples = jnp.max(jnp.abs(gyroscopic)) > UNFELT * system.fastest(moving.v) + rounding
    # The eigenproblem that is not used gets eigenvalues apart from each other, so that its derivatives are finite.
    apart = jnp.diag(jnp.arange(1.0, len(symmetric) + 1.0, dtype=system.dtype) ** 2)
    values, vectors = eigh(jnp.where(couples, apart, symmetric))
    steps = jnp.diff(lax.stop_gradient(values), prepend=-jnp.inf, append=jnp.inf)
    near = steps <= EQUAL_ULPS * jnp.finfo(system.dtype).eps * largest(lax.stop_gradient(values))
    equal = near[1:] | near[:-1]
    values, vectors = undefined_where((equal, equal), (values, vectors), symmetric)
    frequencies = jnp.sign(values) * jnp.sqrt(jnp.where(values == 0.0, 1.0, jnp.abs(values)))
    if may_couple:
        matrix = state_matrix(jnp.where(couples, symmetric, apart), jnp.where(couples, gyroscopic, 0.0))
        frequencies = jnp.where(couples, gyroscopic_frequencies(matrix), frequencies)
    return frequencies, jnp.where(couples, jnp.nan, basis @ vectors)


class _Modes(NamedTuple):
    """Undamped modes of the symmetric stiffness, to measure distances and changes in.

    - `of_joints`: speeds of the tree's joints in each mode. `vectors`: y in each mode.
    - `square`: |λ| of each mode, no less than the square of the largest speed [1/s²].
    """

    of_joints: Float[Array, "n_v d"]
    vectors: Float[Array, "d d"]
    square: Float[Array, " d"]

    @staticmethod
    def of(
        system: System, basis: Float[Array, "n_v d"], stiffness: Float[Array, "d d"], v: Float[Array, " n_v"]
    ) -> "_Modes":
        values, vectors = eigh(stiffness)
        return _Modes(basis @ vectors, vectors, jnp.maximum(jnp.abs(values), system.fastest(v) ** 2))


def _steadiness(moving, state, basis, modes, history, of_states) -> _Steadiness:
    """How steady a motion is, from its `history` of coefficients and gaps, see `_coefficients`.

    **Arguments:** `of_states`: accelerations of the modes by internal states in their scales, whose parts may cancel.
    """
    system, (accelerations, stiffness, damping, opens) = moving.system, history
    size = jax.vmap(system.fastest, in_axes=1)(modes.of_joints)
    forces = largest_force(move(configure(system, moving.t, moving.q), moving.v))
    along = jnp.abs(accelerations @ modes.vectors)
    felt = along > UNFELT * (size * forces + of_states)
    distance = jnp.where(felt, size * along, 0.0) / jnp.where(felt, modes.square, 1.0)
    worst = jnp.argmax(jnp.max(distance, axis=1, initial=0.0))

    # Relative to the geometric mean of two modes' stiffnesses, and beyond rounding of the stiffest one.
    scale = jnp.sqrt(jnp.outer(modes.square, modes.square))

    def changes(matrices, scale):
        seen = modes.vectors.T @ matrices @ modes.vectors
        scale = scale + jnp.abs(seen[0])
        differences = jnp.abs(seen - seen[0])
        felt = differences > ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(scale, initial=0.0)
        return jnp.max(jnp.where(felt, differences, 0.0) / jnp.where(felt, scale, 1.0), initial=0.0)

    return _Steadiness(
        missed=missed_rates(system, moving.t, state.q, state.v) if len(opens) > 1 else jnp.zeros(0, system.dtype),
        off=jnp.max(distance, initial=0.0),
        acceleration=basis @ accelerations[worst],
        changes=jnp.max(jnp.stack([changes(stiffness, scale), changes(damping, jnp.sqrt(scale)), jnp.max(opens)])),
        of_states=jnp.zeros(0, system.dtype),
    )
