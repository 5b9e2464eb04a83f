"""Static equilibrium, and small motions about it, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.loops import gaps
from linkax.equations.system import System, system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.model.constraints import Coupling
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import all_known, known
from linkax.simulation.accuracy import BALANCED
from linkax.simulation.assembly import CLOSED, LONGEST_STEP
from linkax.simulation.state import State

MOST_STEPS = 200
AT_REST = 1e-12  # step [rad, lengths of the mechanism] below which the search for an equilibrium ends
BALANCED_STEP = 1e-8  # the same, above which it has failed
NEUTRAL = 1e-12  # stiffness relative to the largest that counts as none


class EquilibriumError(RuntimeError):
    """No equilibrium was found; `state` is where the search stopped."""

    def __init__(self, message, state):
        super().__init__(message)
        self.state = state


def _held_system(mechanism, dtype, t) -> System:
    """The mechanism's numbers, with drives that hold their joints where they are at time t."""
    system = system_of(mechanism, dtype)
    held = [
        Coupling(constraint.name, dict(zip(constraint.terms, constraint.coefficients, strict=True)), side)
        for constraint in system.constraints
        for side in [constraint.right_side(t)]
    ]
    return dataclasses.replace(system, constraints=tuple(held))


class _Tangent(eqx.Module):
    """A mechanism near closed coordinates q, in coordinates y of the tangent space: q ⊕ T y.

    - `basis`: T, (n_v, n_v), columns orthonormal in the mass metric, zero where there is no tangent;
      `dual`: TᵀM, its inverse on the tangent space.
    """

    system: System
    method: TangentSpace
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    basis: Float[Array, "n_v n_v"]
    dual: Float[Array, "n_v n_v"]

    @staticmethod
    def at(system, method, t, q) -> "_Tangent":
        departure = lax.stop_gradient(method.departure(system, t, q))
        basis = departure.crossing.inverse.basis
        return _Tangent(system, method, t, q, basis, basis.T @ departure.mass)

    @staticmethod
    def differentiable(system, method, t, q) -> "_Tangent":
        """The same, with a basis that stays tangent and orthonormal where numbers change."""
        departure = method.departure(system, t, q)
        crossing, mass = departure.crossing, departure.mass
        fixed = crossing.inverse.basis
        still = jnp.zeros(len(crossing.jacobian), mass.dtype)

        def tangent(column):
            return constrained_solve(crossing.inverse, mass, crossing.jacobian, mass @ column, still)[0]

        basis = jax.vmap(tangent, in_axes=1, out_axes=1)(fixed)
        empty = jnp.diag((jnp.sum(fixed**2, axis=0) == 0.0).astype(mass.dtype))
        basis = basis @ cholesky_inverse_by_elimination(basis.T @ mass @ basis + empty)[0].T
        return _Tangent(system, method, t, q, basis, basis.T @ mass)

    def acceleration(self, y, y_rate):
        """ÿ."""
        q = retract(self.system.topology, self.q, self.basis @ y)
        _, acceleration, *_ = self.method.derivative(self.system, self.t, q, self.basis @ y_rate, True)
        return self.dual @ acceleration

    def stiffness(self):
        """−∂ÿ/∂y at rest."""
        rest = jnp.zeros_like(self.system.units)
        return -jax.jacfwd(self.acceleration)(rest, rest)


def equilibrium(mechanism: Mechanism, state: State, *, t=0.0) -> State:
    """A state of static equilibrium near a given one: at rest, with all forces in balance.

    The search goes downhill, so that it ends in a stable equilibrium unless it begins exactly in
    another one. Drives hold their joints where they are at time t [s]. Differentiable with
    respect to the numbers of the mechanism, to any order, and not to the state where it begins.

    **Raises:** `EquilibriumError` where the search does not come to rest, or cannot close the loops; inside
    JAX transformations nothing is raised, and coordinates are not finite then.
    """
    found, remaining, gap = _equilibrium(mechanism, state, jnp.asarray(t, float))
    if not all_known((found, remaining, gap)):
        return State(jnp.where((remaining <= BALANCED_STEP) & (gap <= CLOSED), found.q, jnp.nan), found.v)
    if not gap <= CLOSED:
        raise EquilibriumError(
            f"the loops stay open by {float(gap):.3g}, in radians or lengths of the mechanism; start from a state made "
            "with linkax.assemble, which says which joint is open",
            found,
        )
    if not remaining <= BALANCED_STEP:
        raise EquilibriumError(
            f"no equilibrium near this state: step {MOST_STEPS} was still one of {float(remaining):.3g}, in radians or "
            "lengths of the mechanism; start elsewhere, or add what holds the mechanism",
            found,
        )
    return found


@eqx.filter_jit
def _equilibrium(mechanism, state, t):
    system = _held_system(mechanism, state.q.dtype, t)
    q, longest = _at_rest(system, t, lax.stop_gradient(state.q))
    loops = gaps(configure(system, t, q))
    open_ = jnp.concatenate([loops.distance / system.length, loops.angle, loops.constraints / system.coupling_unit])
    gap = jnp.where(jnp.all(jnp.isfinite(state.v)), jnp.max(open_, initial=0.0), jnp.inf)
    return State(q, jnp.zeros(system.topology.num_speeds, system.dtype)), longest, gap


@eqx.filter_custom_jvp
def _at_rest(system, t, q):
    """Coordinates of an equilibrium, by a search from q; and the longest part of its last step."""
    method = BALANCED.method(system.dtype)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)

    def step(q):
        """Towards the lowest potential nearby: by the stiffness, all of whose directions count as stable."""
        tangent = _Tangent.at(system, method, t, q)
        stiffness = tangent.stiffness()
        values, vectors = jnp.linalg.eigh((stiffness + stiffness.T) / 2.0)
        stiff = jnp.abs(values) > NEUTRAL * jnp.max(jnp.abs(values))
        along = vectors.T @ tangent.acceleration(rest, rest)
        downhill = tangent.basis @ (vectors @ jnp.where(stiff, along / jnp.where(stiff, jnp.abs(values), 1.0), along))
        longest = jnp.max(jnp.abs(downhill / system.units))
        return downhill * jnp.minimum(1.0, LONGEST_STEP / jnp.where(longest > 0.0, longest, 1.0)), longest

    def unfinished(carry):
        count, _, longest = carry
        return (count < MOST_STEPS) & (longest > AT_REST)

    def improve(carry):
        count, q, _ = carry
        change, longest = step(q)
        q, _ = method.close(system, t, retract(system.topology, q, change), rest)
        return count + 1, q, longest

    start = method.close(system, t, q, rest)[0]
    return lax.while_loop(unfinished, improve, (jnp.zeros((), int), start, jnp.asarray(jnp.inf, system.dtype)))[1:]


@_at_rest.def_jvp
def _at_rest_jvp(primals, changes):
    """Where the forces stay in balance, to any order: the search has no derivative."""
    (system, t, begin), (system_change, t_change, _) = primals, changes
    q, longest = _at_rest(system, t, begin)
    tangent = _Tangent.at(system, BALANCED.method(system.dtype), t, q)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    acceleration = lambda system, t: dataclasses.replace(tangent, system=system, t=t).acceleration(rest, rest)
    _, unbalanced = eqx.filter_jvp(acceleration, (system, t), (system_change, t_change))
    change = jnp.linalg.pinv(tangent.stiffness(), rtol=NEUTRAL) @ unbalanced

    def moved(system, t, y):
        return tangent.method.close(system, t, retract(system.topology, q, tangent.basis @ y), rest)[0]

    _, q_change = eqx.filter_jvp(moved, (system, t, rest), (system_change, t_change, change))
    return (q, longest), (q_change, None)


class Linearisation(NamedTuple):
    """Small motions about a state: ÿ + damping ẏ + stiffness y = 0 on the tangent space, v = basis × ẏ.

    With d degrees of freedom:

    - `natural_frequencies`: undamped, (d,) [rad/s], rising. One that is negative is no frequency:
      its mode grows at that rate [1/s].
    - `modes`: speeds of the tree's joints in each mode, (n_v, d), of mass one.
    - `basis`: (n_v, d), orthonormal in the mass metric. `stiffness`, `damping`: (d, d) [1/s², 1/s].

    Differentiable, where no two frequencies are equal.
    """

    natural_frequencies: Float[Array, " d"]
    modes: Float[Array, "n_v d"]
    basis: Float[Array, "n_v d"]
    stiffness: Float[Array, "d d"]
    damping: Float[Array, "d d"]

    @property
    def eigenvalues(self) -> Complex[Array, " 2d"]:
        """Of the motion with damping [1/s]; with first derivatives alone."""
        nothing = jnp.zeros_like(self.stiffness)
        identity = nothing + jnp.eye(nothing.shape[-1])
        return jnp.linalg.eigvals(jnp.block([[nothing, identity], [-self.stiffness, -self.damping]]))


def linearise(mechanism: Mechanism, state: State, *, t=0.0, degrees_of_freedom: int | None = None) -> Linearisation:
    """Natural frequencies and modes about a state at rest, see `linkax.equilibrium`.

    **Arguments:** `degrees_of_freedom`: of the mechanism; needed inside JAX transformations, where
    they cannot be found.
    """
    t = jnp.asarray(t, float)
    if degrees_of_freedom is None:
        system = _held_system(mechanism, state.q.dtype, t)
        departure = BALANCED.method(system.dtype).departure(system, t, state.q)
        rank = known(departure.crossing.inverse.rank)
        if rank is None:
            raise ValueError("linearise inside a JAX transformation needs degrees_of_freedom=")
        degrees_of_freedom = system.topology.num_speeds - int(np.sum(rank))
    return _linearise(mechanism, state, t, degrees_of_freedom)


@eqx.filter_jit
def _linearise(mechanism, state, t, count):
    system = _held_system(mechanism, state.q.dtype, t)
    method = BALANCED.method(system.dtype)
    tangent = _Tangent.differentiable(system, method, t, state.q)
    rest = jnp.zeros(system.topology.num_speeds, system.dtype)
    columns = jnp.argsort(jnp.sum(tangent.basis**2, axis=0) == 0.0)[:count]
    at_columns = lambda matrix: matrix[columns[:, None], columns[None, :]]
    stiffness = at_columns(tangent.stiffness())
    damping = at_columns(-jax.jacfwd(tangent.acceleration, 1)(rest, rest))
    values, vectors = jnp.linalg.eigh((stiffness + stiffness.T) / 2.0)
    basis = tangent.basis[:, columns]
    return Linearisation(
        natural_frequencies=jnp.sign(values) * jnp.sqrt(jnp.where(values == 0.0, 1.0, jnp.abs(values))),
        modes=basis @ vectors,
        basis=basis,
        stiffness=stiffness,
        damping=damping,
    )
