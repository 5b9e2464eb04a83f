"""Small motions about an equilibrium or a steady motion, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

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
from linkax.equations.loops import jacobian
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import whole_number
from linkax.simulation.explain.diagnosis import massless_bodies
from linkax.simulation.start.initial_state import moving_joints
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.xla.batches import one_by_one
from linkax.xla.tracing import all_concrete, concrete, quick_compile

NEAR = 1e-6  # distance from an equilibrium [rad, lengths of the mechanism] below which a state is in it
UNFELT = 1e-9  # of all forces: what is left of them by rounding
CONSTANT = 1e-5  # what coefficients and loops may change by, relative to them
ROUNDING_ULPS = 1e5  # of the largest stiffness, which softer ones may be off by
GROWS = 1e-6  # real part of an eigenvalue relative to it, below which the motion neither grows nor decays

_eig = one_by_one(lambda matrix: tuple(jnp.linalg.eig(matrix)))


@jax.custom_jvp
def _spectrum(matrix):
    """Eigenvalues and eigenvectors, with derivatives to any order where no two eigenvalues are equal."""
    return _eig(matrix)


@_spectrum.defjvp
def _spectrum_jvp(primals, changes):
    values, vectors = _spectrum(*primals)
    turned = jnp.linalg.solve(vectors, changes[0].astype(vectors.dtype) @ vectors)
    apart = values[None, :] - values[:, None] + jnp.eye(len(values), dtype=values.dtype)
    mixed = jnp.where(jnp.eye(len(values), dtype=bool), 0.0, turned / apart)
    return (values, vectors), (jnp.diagonal(turned), vectors @ mixed)


class _Moving(Nearby):
    """In motion about speeds v. The metric is that of the masses, and T stays orthonormal where numbers change."""

    v: Float[Array, " n_v"]

    @staticmethod
    def of(system, method, t, q, v) -> "_Moving":
        departure = method.at_rest(system, t, q)
        crossing, mass = departure.split, departure.mass
        fixed = crossing.inverse.basis
        still = jnp.zeros(len(crossing.jacobian), mass.dtype)

        def tangent(column):
            return constrained_solve(crossing.inverse, mass, crossing.jacobian, mass @ column, still)[0]

        basis = jax.vmap(tangent, in_axes=1, out_axes=1)(fixed)
        empty = jnp.diag((jnp.sum(fixed**2, axis=0) == 0.0).astype(mass.dtype))
        basis = basis @ cholesky_inverse_by_elimination(basis.T @ mass @ basis + empty)[0].T
        return _Moving(system, method, t, q, basis, basis.T @ mass, v)

    def after(self, t, motion) -> "_Moving":
        """The same at time t, moved on, with the tangent space taken along."""
        carry = lambda change: carried(self.system.topology, motion, change)
        basis, dual = jax.vmap(carry, in_axes=1, out_axes=1)(self.basis), jax.vmap(carry)(self.dual)
        q = retract(self.system.topology, self.q, motion)
        return dataclasses.replace(self, t=t, q=q, basis=basis, dual=dual)

    def acceleration(self, y, y_rate):
        """ÿ, in coordinates that the steady motion takes along: q ⊕ T y, moved on."""
        along = self.basis @ y_rate
        _, acceleration, *_ = self.method.derivative(self.system, self.t, self.at(y), self.v + along, True)
        if len(self.system.topology.quaternions):
            carry = lambda time: carried(self.system.topology, time * self.v, along)
            nothing = jnp.zeros((), y.dtype)
            acceleration = acceleration - jax.jvp(carry, (nothing,), (nothing + 1.0,))[1]
        return self.dual @ acceleration

    def coefficients(self):
        """ÿ at rest in y, stiffness and damping."""
        rest = jnp.zeros_like(self.system.scales)
        of_both = lambda both: self.acceleration(*jnp.split(both, 2))
        acceleration, slopes = self.slopes(of_both, jnp.concatenate([rest, rest]))
        return acceleration, *jnp.split(-slopes, 2, axis=1)

    def opens(self):
        """How far loops are open, or opened by what should keep them closed."""
        slopes = jacobian(configure(self.system, self.t, self.q)) @ self.basis
        longest = jnp.max(jnp.abs(self.basis / self.system.scales[:, None]), initial=0.0)
        apart = jnp.max(jnp.abs(slopes), initial=0.0) / jnp.where(longest > 0.0, longest, 1.0)
        misses = missed_rates(self.system, self.t, self.q, self.v)
        gap = widest_gap(self.system, self.t, self.q)
        return jnp.maximum(jnp.maximum(apart, gap), jnp.max(misses, initial=0.0))


class Linearisation(NamedTuple):
    """Small motions about a state: ÿ + damping ẏ + stiffness y = 0 on the tangent space, v = basis × ẏ.

    With d degrees of freedom:

    - `natural_frequencies`: undamped, (d,) [rad/s], rising. One that is negative is no frequency:
      its mode grows at that rate [1/s].
    - `modes`: speeds of the tree's joints in each mode, (n_v, d), of mass one. NaN where gyroscopic terms leave no
      modes in which all joints move in phase, see `eigenvectors`.
    - `basis`: (n_v, d), orthonormal in the mass metric. `stiffness`, `damping`: (d, d) [1/s², 1/s].

    About a state in motion y are coordinates that the motion takes along: changes of the joints' coordinates, and
    frequencies are those that a body driven in rotation sees. The stiffness has centrifugal forces, and what they
    stiffen, in it, the damping gyroscopic terms, its skew part. A rotor that whirls at ω seen from the ground whirls
    at ω − Ω here. `natural_frequencies` are without the symmetric part of the damping, and without the skew part of
    the stiffness, which dampers outside of what rotates have.

    Differentiable, where no two frequencies are equal.
    """

    natural_frequencies: Float[Array, " d"]
    modes: Float[Array, "n_v d"]
    basis: Float[Array, "n_v d"]
    stiffness: Float[Array, "d d"]
    damping: Float[Array, "d d"]

    @property
    def eigenvalues(self) -> Complex[Array, " 2d"]:
        """Of the motion with damping and gyroscopic terms [1/s]; a real part above zero grows."""
        return _of_members(self.stiffness, self.damping)[0]

    @property
    def eigenvectors(self) -> Complex[Array, "n_v 2d"]:
        """Speeds of the tree's joints in the motion with each of `eigenvalues`, of any size."""
        count = self.stiffness.shape[-1]
        return self.basis @ _of_members(self.stiffness, self.damping)[1][..., count:, :]


def _state_matrix(stiffness, damping):
    """Of (y, ẏ)."""
    nothing = jnp.zeros_like(stiffness)
    return jnp.block([[nothing, nothing + jnp.eye(len(nothing))], [-stiffness, -damping]])


@jax.jit
def _of_members(stiffness, damping):
    """Eigenvalues and eigenvectors, of each member of a batch."""
    of_one = lambda stiffness, damping: _spectrum(_state_matrix(stiffness, damping))
    return jnp.vectorize(of_one, signature="(n,n),(n,n)->(m),(m,m)")(stiffness, damping)


class _Steadiness(NamedTuple):
    """What a state must satisfy for its linearisation to be constant: all of it next to zero.

    - `missed`: rates that loops and drives ask for and the state has not, (m,).
    - `off`: distance from an equilibrium [rad, lengths of the mechanism]; `acceleration`: of all joints, (n_v,).
    - `changes`: of coefficients and loops as the motion goes on.
    """

    missed: Float[Array, " m"]
    off: Float[Array, ""]
    acceleration: Float[Array, " n_v"]
    changes: Float[Array, ""]

    @property
    def is_steady(self):
        """Whether it is."""
        return (jnp.max(self.missed, initial=0.0) <= AGREES) & (self.off <= NEAR) & (self.changes <= CONSTANT)


def linearise(mechanism: Mechanism, state: State, *, t=0.0, degrees_of_freedom: int | None = None) -> Linearisation:
    """Natural frequencies and modes about an equilibrium or a steady motion, see `linkax.equilibrium`.

    A state with speeds of zero is one at rest, and drives hold their joints then where they are at time t [s]; else
    they go on, at rates that the state must have. A steady motion is one in which joints go on at constant speeds,
    driven or not, and nothing changes: neither forces in axes that turn with them, nor loops.

    **Arguments:** `degrees_of_freedom`: of the mechanism; needed inside JAX transformations, where
    they cannot be found.

    **Raises:** `ValueError` for a state that is not in equilibrium, or not in steady motion; inside JAX
    transformations nothing is raised, and numbers are not finite then.
    """
    state, t = checked_state(mechanism, state), jnp.asarray(checked_time(t, "t"))
    if degrees_of_freedom is None:
        rank = concrete(_rank(mechanism, state, t))
        if rank is None:
            raise ValueError("linearise inside a JAX transformation needs degrees_of_freedom=; give their number")
        degrees_of_freedom = mechanism.topology.num_speeds - int(rank)
    asked = whole_number(degrees_of_freedom, "degrees_of_freedom", least=0)
    found, there, steadiness = _linearise(mechanism, state, t, asked, may_move(state))
    if concrete(there) is not None and there != asked:
        raise ValueError(f"degrees_of_freedom is {asked}; the mechanism has {there} here: give that, or leave it out")
    if not all_concrete((found, steadiness)):
        mark = lambda leaf: jnp.where(steadiness.is_steady, leaf, jnp.nan)
        return marked(mechanism, jax.tree.map(mark, found))
    if not np.all(np.isfinite(found.natural_frequencies)):
        system = system_of(mechanism, state.q.dtype)
        massless = massless_bodies(system, TangentSpace().prepared(system.dtype), t, state.q)
        why = f"bodies {', '.join(map(repr, massless))} move without mass" if massless else "forces are not finite"
        raise ValueError(f"frequencies are not finite, because {why}; give mass and inertia, or finite numbers")
    _check_steady(mechanism, state, t, steadiness)
    return marked(mechanism, found)


def _check_steady(mechanism, state, t, steadiness):
    """Raise where the linearisation would not be constant."""
    missed, topology, when = np.asarray(steadiness.missed), mechanism.topology, f"at t = {float(t):.6g} s"
    if not np.max(missed, initial=0.0) <= AGREES:
        told = of_missed_rate(mechanism, missed, int(np.argmax(missed)), t)
        raise ValueError(f"{told}, or give it speeds of zero, where drives hold")
    acceleration = np.asarray(steadiness.acceleration)
    if not steadiness.off <= NEAR:
        system = system_of(mechanism, state.q.dtype)
        column = int(np.argmax(np.abs(acceleration / np.asarray(system.scales))))
        joint = next(name for name, taken in topology.speeds.items() if taken.start <= column < taken.stop)
        raise ValueError(
            f"the state is {float(steadiness.off):.3g} off an equilibrium, in radians or lengths of the mechanism: "
            f"joint {joint!r} accelerates by {acceleration[column]:.6g} {when}; begin with linkax.equilibrium"
        )
    if not steadiness.changes <= CONSTANT:
        system = system_of(mechanism, state.q.dtype)
        names = ", ".join(map(repr, moving_joints(system, t, state.q, state.v[:, None])))
        raise ValueError(
            f"the motion of joints {names} is not steady: stiffness or loops change by {float(steadiness.changes):.3g} "
            "as it goes on; simulate it, or give a state with speeds of zero"
        )


@quick_compile
def _rank(mechanism, state, t):
    system = system_in(mechanism, state, t, False)
    return jnp.sum(TangentSpace().prepared(system.dtype).constraint_split(system, t, state.q).inverse.rank)


@quick_compile
def _linearise(mechanism, state, t, count, moves):
    system = system_in(mechanism, state, t, moves)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    moving = _Moving.of(system, TangentSpace().prepared(system.dtype), t, state.q, state.v if moves else rest)
    none = jnp.sum(moving.basis**2, axis=0) == 0.0
    columns = jnp.argsort(none)[:count]

    def of_columns(moving):
        acceleration, stiffness, damping = moving.coefficients()
        reduced = (matrix[columns[:, None], columns[None, :]] for matrix in (stiffness, damping))
        return acceleration[columns], *reduced, moving.opens() if moves else jnp.zeros((), system.dtype)

    now = of_columns(moving)
    stiffness, damping = now[1:3]
    found = jax.tree.map(lambda part: part[None], lax.stop_gradient(now))
    if moves:
        still = lax.stop_gradient(moving)
        after = lax.map(lambda instant: of_columns(still.after(*instant)), instants(system, still.t, still.v))
        found = jax.tree.map(lambda *parts: jnp.concatenate(parts), found, after)
    basis, symmetric = moving.basis[:, columns], (stiffness + stiffness.T) / 2.0
    modes = _Modes.of(system, basis, lax.stop_gradient(symmetric), moving.v)
    steadiness = _steadiness(moving, state, basis, modes, found)
    couples = jnp.zeros((), bool)
    if moves and count:
        gyroscopic = (damping - damping.T) / 2.0
        rounding = ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(jnp.abs(damping))
        couples = jnp.max(jnp.abs(gyroscopic)) > UNFELT * system.fastest(moving.v) + rounding
    # What is not asked for has eigenvalues apart from each other, and so derivatives.
    apart = jnp.diag(jnp.arange(1.0, len(symmetric) + 1.0, dtype=system.dtype) ** 2)
    values, vectors = eigh(jnp.where(couples, apart, symmetric))
    frequencies = jnp.sign(values) * jnp.sqrt(jnp.where(values == 0.0, 1.0, jnp.abs(values)))
    if moves and count:
        matrix = _state_matrix(jnp.where(couples, symmetric, apart), jnp.where(couples, gyroscopic, 0.0))
        frequencies = jnp.where(couples, _gyroscopic_frequencies(matrix), frequencies)
    found = Linearisation(
        natural_frequencies=frequencies,
        modes=jnp.where(couples, jnp.nan, basis @ vectors),
        basis=basis,
        stiffness=stiffness,
        damping=damping,
    )
    return found, jnp.sum(jnp.logical_not(none)), lax.stop_gradient(steadiness)


class _Modes(NamedTuple):
    """Modes without damping: speeds of the tree's joints, y, and the stiffness that changes of it are small against."""

    of_joints: Float[Array, "n_v d"]
    vectors: Float[Array, "d d"]
    square: Float[Array, " d"]

    @staticmethod
    def of(system, basis, stiffness, v) -> "_Modes":
        values, vectors = eigh(stiffness)
        return _Modes(basis @ vectors, vectors, jnp.maximum(jnp.abs(values), system.fastest(v) ** 2))


def _steadiness(moving, state, basis, modes, found) -> _Steadiness:
    """How steady a motion is, by its coefficients and open loops at several instants."""
    system, (accelerations, stiffness, damping, opens) = moving.system, found
    size = jnp.max(jnp.abs(modes.of_joints / system.scales[:, None]), axis=0, initial=0.0)
    forces = largest_force(move(configure(system, moving.t, moving.q), moving.v))
    along = jnp.abs(accelerations @ modes.vectors)
    felt = along > UNFELT * size * forces
    distance = jnp.where(felt, size * along, 0.0) / jnp.where(felt, modes.square, 1.0)
    worst = jnp.argmax(jnp.max(distance, axis=1, initial=0.0))

    # Relative to the geometric mean of what two modes have, and no less than rounding of the stiffest.
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
    )


def _gyroscopic_frequencies(matrix):
    """Frequencies, as of `Linearisation`, by the eigenvalues of a state matrix, which are in pairs of opposite sign."""
    found, _ = _spectrum(matrix)
    size = jnp.sqrt(found.real**2 + found.imag**2)
    return jnp.sort(jnp.where(jnp.abs(found.real) <= GROWS * size, jnp.abs(found.imag), -jnp.abs(found.real)))[::2]
