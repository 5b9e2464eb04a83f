"""Linearise the equations of motion about an equilibrium or a steady motion, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag
from jaxtyping import ArrayLike, Bool, Float, Int

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
from linkax.analysis.symmetry import Symmetry, find_turns
from linkax.equations.configuration import configure
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.loops import jacobian
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.formulation import linear_system
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.linalg.saddle_inverse import invert_apart
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.model.forces.internal_states import scales
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import whole_number
from linkax.simulation.explain.diagnosis import massless_bodies
from linkax.simulation.start.initial_state import moving_joints
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.spatial.vectors import largest, length
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.program import Program
from linkax.xla.tracing import all_concrete, concrete
from linkax.xla.undefined import undefined_where

NEAR = 1e-6  # distance from an equilibrium up to which a state counts as in it [rad, lengths of the mechanism]
UNFELT = 1e-9  # forces that rounding leaves, relative to all forces
CONSTANT = 1e-5  # relative change of coefficients and loops up to which they count as constant
IMPLIED_ULPS = 1e4  # mobility along a slip that rounding leaves where other rows imply it, of the largest one
ROUNDING_ULPS = 1e5  # error of a stiffness, in units of rounding of the largest one


class _Moving(Nearby):
    """A mechanism near coordinates q and speeds v.

    T = [T_f, T_b] has the directions of the d speeds that constraints leave free, and those of displacements that slips
    alone bar, one for each row of slips, zero where other rows imply it. Tᵀ M T = 1, also where the mechanism's numbers
    change.
    """

    symmetry: Symmetry
    degrees_of_freedom: int = eqx.field(static=True)

    @staticmethod
    def of(
        system: System,
        method: TangentSpace,
        t: Float[Array, ""],
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        degrees_of_freedom: int,
    ) -> tuple["_Moving", Int[Array, ""]]:
        """The mechanism there, and how many degrees of freedom it has."""
        departure = method.at_rest(system, t, q)
        rows = departure.split.jacobian
        inverse = departure.split.inverse
        mass = departure.mass
        still, slips = jnp.zeros(len(rows), mass.dtype), system.topology.slips

        def tangent(column):
            return constrained_solve(inverse, mass, rows, mass @ column, still)[0]

        empty = jnp.sum(inverse.basis**2, axis=0) == 0.0
        fixed = inverse.basis[:, jnp.argsort(empty)[:degrees_of_freedom]]
        basis = _orthonormal(jax.vmap(tangent, in_axes=1, out_axes=1)(fixed), mass)
        if np.any(slips):
            holds = jnp.where(slips[:, None], 0.0, rows)
            barred = _barred(system, method.tolerance, mass, holds, rows[slips])
            basis = jnp.concatenate([basis, _orthonormal(barred, mass)], axis=1)
        symmetry = Symmetry.through(system, t, q, v)
        moving = _Moving(system, method, t, q, basis, basis.T @ mass, symmetry, degrees_of_freedom)
        return moving, jnp.sum(jnp.logical_not(empty))

    @property
    def v(self) -> Float[Array, " n_v"]:
        return self.symmetry.speeds(self.q)

    @property
    def free(self) -> Float[Array, "n_v d"]:
        """T_f."""
        return self.basis[:, : self.degrees_of_freedom]

    def after(self, duration: Float[Array, ""]) -> "_Moving":
        """The same mechanism a time later [s], with T carried along."""
        t, (q, basis) = self.t + duration, self.symmetry.follow(self.q, self.basis, duration)
        dual = basis.T @ linear_system(self.system, t, q).mass
        return dataclasses.replace(self, t=t, q=q, basis=basis, dual=dual)

    def rates(
        self, y: Float[Array, " h"], y_rate: Float[Array, " d"], internal: Float[Array, " n_s"] | None = None
    ) -> tuple[Float[Array, " h"], Float[Array, " n_s"]]:
        """ÿ of what is free and ẏ of what is barred, in coordinates y that move with the steady motion: q(t) ⊕ T y.

        And the rates of internal states, where some are given.
        """
        system, at = bound(self.system, internal), self.at(y)
        moved = self.symmetry.speeds(at) + self.free @ y_rate
        v, acceleration, q, _ = self.method.derivative(system, self.t, at, moved, True)
        steady, rate = self.symmetry.along(q, v)
        acceleration = acceleration - rate - self.symmetry.carry(self.q, v - steady)
        free, barred = jnp.split(self.dual, [self.degrees_of_freedom])
        changes = jnp.zeros(0, y.dtype) if internal is None else internal_rates(move(configure(system, self.t, q), v))
        return jnp.concatenate([free @ acceleration, barred @ (v - steady)]), changes

    def coefficients(self) -> tuple[Float[Array, " d"], Float[Array, "h h"], Float[Array, "h h"]]:
        """ÿ at y = ẏ = 0, −∂/∂y of ÿ, with zeros below, and −∂/∂ẏ of it, with ∂/∂y of ẏ of what is barred below."""
        count = self.basis.shape[1]
        degrees = self.degrees_of_freedom
        of_both = lambda both: self.rates(*jnp.split(both, [count]))[0]
        rates, slopes = self.slopes(of_both, jnp.zeros(count + degrees, self.basis.dtype))
        by_place, by_rate = jnp.split(-slopes, [count], axis=1)
        is_free = jnp.arange(count)[:, None] < degrees
        damping = jnp.pad(by_rate, ((0, 0), (0, count - degrees)))
        return rates[:degrees], jnp.where(is_free, by_place, 0.0), jnp.where(is_free, damping, -by_place)

    def opens(self) -> Float[Array, ""]:
        """The largest gap of the loops, rate that speeds miss, or slope at which T opens the loops."""
        bars = self.system.topology.slips[:, None] & (np.arange(self.basis.shape[1]) >= self.degrees_of_freedom)
        slopes = jnp.where(bars, 0.0, jacobian(configure(self.system, self.t, self.q)) @ self.basis)
        apart = ratio(largest(slopes), largest(self.basis / self.system.scales[:, None]))
        misses = missed_rates(self.system, self.t, self.q, self.v)
        gap = widest_gap(self.system, self.t, self.q)
        return jnp.maximum(jnp.maximum(apart, gap), jnp.max(misses, initial=0.0))


def _orthonormal(columns, mass):
    """The same directions, orthonormal in the mass metric; columns of zeros stay so."""
    if not columns.shape[1]:
        return columns
    empty = jnp.diag((jnp.sum(columns**2, axis=0) == 0.0).astype(mass.dtype))
    return columns @ cholesky_inverse_by_elimination(columns.T @ mass @ columns + empty)[0].T


def _barred(system, tolerance, mass, rows, slips):
    """Directions that `rows` leave free and `slips` do not, one for each of these, zero where the others imply it."""
    inverse = invert_apart(mass, rows, system.scales, tolerance, system.structure.islands)
    nothing = jnp.zeros(len(rows), mass.dtype)
    across = jax.vmap(lambda slip: constrained_solve(inverse, mass, rows, slip, nothing)[0], out_axes=1)(slips)
    unit = ratio(1.0, length(slips * system.scales))
    _, r, order = pivoted_qr(lax.stop_gradient(unit[:, None] * slips @ across * unit))
    mobility = largest(inverse.tangent / jnp.outer(system.scales, system.scales))
    felt = jnp.abs(jnp.diagonal(r)) > IMPLIED_ULPS * jnp.finfo(mass.dtype).eps * mobility
    return jnp.where(jnp.zeros(len(slips), bool).at[order].set(felt), across, 0.0)


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
    add, and what displacements that slips bar do, is in `states` and `eigenvalues`.

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
    most = min(asked, mechanism.topology.num_speeds)
    linearisation, steadiness, counted = _linearise(mechanism, state, t, most, may_move(state))
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
    """A `Linearisation`, its `_Steadiness`, and the degrees of freedom counted at the state."""
    system = bound(system_in(mechanism, state, t, moves), state.internal)
    v = state.v if moves else jnp.zeros(system.topology.num_speeds, system.dtype)
    still, counted = _Moving.of(system, TangentSpace().prepared(system.dtype), t, state.q, v, count)
    if not (moves and len(still.symmetry.turns)):
        return *_of_moving(mechanism, state, still, moves), counted

    def along(turns):
        symmetry = still.symmetry.turning(state.q, turns)
        return _of_moving(mechanism, state, dataclasses.replace(still, symmetry=symmetry), moves)

    # All joints at constant speeds come first.
    turns = find_turns(still.symmetry, system, still.method, t, state.q, still.basis, still.free)
    turns = jnp.where(jnp.all(jnp.isfinite(turns)), turns, 0.0)
    linearisations, steadiness = lax.map(along, jnp.stack([turns - lax.stop_gradient(turns), turns]))
    needed = jnp.argmax(jax.vmap(lambda each: each.is_steady)(steadiness))
    return *jax.tree.map(lambda leaf: leaf[needed], (linearisations, steadiness)), counted


def _of_moving(mechanism, state, moving, moves):
    """A `Linearisation` and its `_Steadiness`."""
    system, count = moving.system, moving.degrees_of_freedom
    (of_places, of_rates), history = _coefficients(moving, moves)
    stiffness, damping = of_places[:count, :count], of_rates[:count, :count]
    symmetric = (stiffness + stiffness.T) / 2.0
    modes = _Modes.of(system, moving.free, lax.stop_gradient(symmetric), moving.v)
    units = jnp.zeros(0, system.dtype) if state.internal is None else scales(mechanism.forces, system.dtype)
    states, of_states = _states(moving, state.internal, units)
    felt = jnp.abs(modes.vectors.T @ states.force) @ units
    steadiness = _steadiness(moving, state, modes, history, felt)._replace(of_states=of_states)
    frequencies, mode_speeds = _frequencies(moving, symmetric, damping, moves and count)
    linearisation = Linearisation(
        natural_frequencies=frequencies,
        modes=mode_speeds,
        basis=moving.free,
        stiffness=stiffness,
        damping=damping,
        states=_with_barred(states, of_places[:count, count:], of_rates[count:]),
    )
    return linearisation, lax.stop_gradient(steadiness)


def _states(moving, internal, units) -> tuple[StateSlopes, Float[Array, " n_s"]]:
    """What internal states add, by all of y, and how far each is off where it stands still, see `_Steadiness`."""
    still, degrees = jnp.zeros(moving.basis.shape[1], units.dtype), moving.degrees_of_freedom
    if internal is None:
        nothing = jnp.zeros((0, 0), units.dtype)
        shaped = nothing.reshape(degrees, 0), nothing.reshape(0, len(still)), nothing.reshape(0, degrees), nothing
        return StateSlopes(*shaped), jnp.zeros(0, units.dtype)
    at = still, still[:degrees], internal
    (_, rates), slopes = moving.rates(*at), jax.jacfwd(moving.rates, (0, 1, 2))(*at)
    (_, _, force), (by_coordinates, by_speeds, by_states) = slopes
    # The rate that each would have where all coordinates and states were off by one in their scales.
    size = jax.vmap(moving.system.fastest, in_axes=1)(moving.basis)
    sensitivity = jnp.abs(by_coordinates) @ ratio(jnp.ones_like(size), size, 0.0) + jnp.abs(by_states) @ units
    felt = jnp.abs(rates) > UNFELT * sensitivity
    off = jnp.where(felt, ratio(jnp.abs(rates), sensitivity, jnp.inf), 0.0)
    return StateSlopes(force[:degrees], by_coordinates, by_speeds, by_states), off


def _with_barred(states, stiffness, rates):
    """Displacements that slips bar as further states; None without either.

    **Arguments:** `states`: by all of y; `stiffness`: by what is barred, (d, b); `rates`: slopes of this, (b, d + b).
    """
    degrees, barred = stiffness.shape
    if states.force.shape[1] + barred == 0:
        return None
    split = lambda matrix: jnp.split(matrix, [degrees], axis=1)
    (by_free, by_barred), (of_free, of_barred) = split(states.by_coordinates), split(rates)
    none = jnp.zeros((barred, degrees + len(by_free)), rates.dtype)
    return StateSlopes(
        force=jnp.concatenate([states.force, -stiffness], axis=1),
        by_coordinates=jnp.concatenate([by_free, of_free]),
        by_speeds=jnp.concatenate([states.by_speeds, none[:, :degrees]]),
        by_states=jnp.block([[states.by_states, by_barred], [none[:, degrees:], of_barred]]),
    )


def _coefficients(moving, moves):
    """The coefficients at the state, and (ÿ, coefficients, gap of the loops) now and at later instants."""

    def at_instant(moving):
        return *moving.coefficients(), moving.opens() if moves else jnp.zeros((), moving.system.dtype)

    now = at_instant(moving)
    history = jax.tree.map(lambda part: part[None], lax.stop_gradient(now))
    if moves:
        still = lax.stop_gradient(moving)
        later = instants(moving.system, still.v)
        after = lax.map(lambda duration: at_instant(still.after(duration)), later)
        history = jax.tree.map(lambda *parts: jnp.concatenate(parts), history, after)
    return now[1:3], history


def _frequencies(moving, symmetric, damping, may_couple):
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
    return frequencies, jnp.where(couples, jnp.nan, moving.free @ vectors)


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


def _steadiness(moving, state, modes, history, of_states) -> _Steadiness:
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
    barred = moving.basis.shape[1] - moving.degrees_of_freedom
    vectors = block_diag(modes.vectors, jnp.eye(barred, dtype=system.dtype))
    square = jnp.concatenate([modes.square, jnp.broadcast_to(system.fastest(moving.v) ** 2, (barred,))])
    scale = jnp.sqrt(jnp.outer(square, square))

    def changes(matrices, scale):
        seen = vectors.T @ matrices @ vectors
        scale = scale + jnp.abs(seen[0])
        differences = jnp.abs(seen - seen[0])
        felt = differences > ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(scale, initial=0.0)
        return jnp.max(jnp.where(felt, differences, 0.0) / jnp.where(felt, scale, 1.0), initial=0.0)

    return _Steadiness(
        missed=missed_rates(system, moving.t, state.q, state.v) if len(opens) > 1 else jnp.zeros(0, system.dtype),
        off=jnp.max(distance, initial=0.0),
        acceleration=moving.free @ accelerations[worst],
        changes=jnp.max(jnp.stack([changes(stiffness, scale), changes(damping, jnp.sqrt(scale)), jnp.max(opens)])),
        of_states=jnp.zeros(0, system.dtype),
    )
