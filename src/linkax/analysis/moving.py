"""The equations of motion linearised about an equilibrium or a steady motion, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from linkax.analysis.linearisation import StateSlopes
from linkax.analysis.steady import Nearby, instants, missed_rates, widest_gap
from linkax.analysis.symmetry import Symmetry
from linkax.equations.configuration import configure
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.loops import jacobian
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations.formulation import linear_system
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.linalg.saddle_inverse import invert_apart
from linkax.linalg.triangular import cholesky_inverse_by_elimination
from linkax.spatial.vectors import largest, length
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

IMPLIED_ULPS = 1e4  # mobility along a slip that rounding leaves where other rows imply it, of the largest one


class Coefficients(NamedTuple):
    """Of small motions at a state, or at several, in coordinates y of what is free and of what slips bar.

    - `accelerations`: ÿ at y = ẏ = 0, (d,).
    - `by_places`: −∂/∂y of ÿ, with zeros below. `by_rates`: −∂/∂ẏ of ÿ, with ∂/∂y of ẏ of what is barred below.
    - `opens`: the largest gap of the loops, rate that speeds miss, or slope at which T opens the loops; zero at rest.
    """

    accelerations: Float[Array, "*k d"]
    by_places: Float[Array, "*k h h"]
    by_rates: Float[Array, "*k h h"]
    opens: Float[Array, "*k"]


class Moving(Nearby):
    """A mechanism near coordinates q and speeds v.

    T = [T_f, T_b] has the directions of the d speeds that constraints leave free, and those of displacements that slips
    alone bar, one for each row of slips, zero where other rows imply it. Tᵀ M T = 1, also where the mechanism's numbers
    change.
    """

    symmetry: Symmetry
    degrees_of_freedom: int = eqx.field(static=True)
    moves: bool = eqx.field(static=True)

    @staticmethod
    def of(
        system: System,
        method: TangentSpace,
        t: Float[Array, ""],
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        degrees_of_freedom: int,
        moves: bool,
    ) -> tuple["Moving", Int[Array, ""]]:
        """The mechanism there, all joints at constant speeds, and how many degrees of freedom it has.

        `moves`: whether there may be speeds.
        """
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
        moving = Moving(system, method, t, q, basis, basis.T @ mass, symmetry, degrees_of_freedom, moves)
        return moving, jnp.sum(jnp.logical_not(empty))

    def along(self, turns: Float[Array, " m"]) -> "Moving":
        """The same state, which goes on along the symmetry with these turns."""
        return dataclasses.replace(self, symmetry=self.symmetry.turning(self.q, turns))

    @property
    def v(self) -> Float[Array, " n_v"]:
        return self.symmetry.speeds(self.q)

    @property
    def free(self) -> Float[Array, "n_v d"]:
        """T_f."""
        return self.basis[:, : self.degrees_of_freedom]

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

    def coefficients(self) -> Coefficients:
        """At the state."""
        count = self.basis.shape[1]
        degrees = self.degrees_of_freedom
        of_both = lambda both: self.rates(*jnp.split(both, [count]))[0]
        rates, slopes = self.slopes(of_both, jnp.zeros(count + degrees, self.basis.dtype))
        by_place, by_rate = jnp.split(-slopes, [count], axis=1)
        is_free = jnp.arange(count)[:, None] < degrees
        damping = jnp.pad(by_rate, ((0, 0), (0, count - degrees)))
        return Coefficients(
            accelerations=rates[:degrees],
            by_places=jnp.where(is_free, by_place, 0.0),
            by_rates=jnp.where(is_free, damping, -by_place),
            opens=self._opens() if self.moves else jnp.zeros((), self.basis.dtype),
        )

    def history(self) -> Coefficients:
        """At the state, and later as the motion goes on, with T carried along, where derivatives are none; (k, ...)."""
        if not self.moves:
            return jax.tree.map(lambda part: part[None], self.coefficients())

        def after(duration):
            t, (q, basis) = still.t + duration, still.symmetry.follow(still.q, still.basis, duration)
            return t, q, basis, basis.T @ linear_system(still.system, t, q).mass

        def coefficients(instant):
            t, q, basis, dual = instant
            return dataclasses.replace(self, t=t, q=q, basis=basis, dual=dual).coefficients()

        still, now = lax.stop_gradient(self), (self.t, self.q, self.basis, self.dual)
        later = lax.map(after, instants(still.system, still.v))
        # Of all instants at once, so that it is compiled once.
        return lax.map(coefficients, jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), now, later))

    def states(
        self, internal: Float[Array, " n_s"] | None, units: Float[Array, " n_s"]
    ) -> tuple[Float[Array, " n_s"], StateSlopes]:
        """Rates of internal states, and what these add, by all of y."""
        still, degrees = jnp.zeros(self.basis.shape[1], units.dtype), self.degrees_of_freedom
        if internal is None:
            nothing = jnp.zeros((0, 0), units.dtype)
            shaped = nothing.reshape(degrees, 0), nothing.reshape(0, len(still)), nothing.reshape(0, degrees), nothing
            return units, StateSlopes(*shaped)
        at = still, still[:degrees], internal
        (_, rates), slopes = self.rates(*at), jax.jacfwd(self.rates, (0, 1, 2))(*at)
        (_, _, force), (by_coordinates, by_speeds, by_states) = slopes
        return rates, StateSlopes(force[:degrees], by_coordinates, by_speeds, by_states)

    def _opens(self):
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
