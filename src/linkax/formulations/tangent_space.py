"""The paper's method: tangent and normal space by column-pivoted QR.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
Positions and velocities are corrected along the normal space before the equations of motion are
formed; accelerations and multipliers follow from the same split. `notebooks/method.ipynb` goes through it formula by
formula.
"""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import Configuration
from linkax.equations.coordinates import on_manifold, retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma, rate, residual, widest
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations import projected_state
from linkax.formulations.constraint_split import AtRest, ConstraintSplit
from linkax.formulations.formulation import AbstractFormulation, Dynamics, LinearSystem, linear_system
from linkax.linalg.block_elimination import (
    BlockInverse,
    Factors,
    SaddlePointInFronts,
    invert_by_blocks,
    with_identity_metric,
)
from linkax.linalg.constrained_solve import SaddlePoint, constrained_solve
from linkax.linalg.saddle_inverse import SaddleInverse, invert_apart, singularity_distance, with_mass
from linkax.model.numbers import Number, number, one_of, require, whole_number
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.tracing import jit_inline

Metric = Literal["mass", "identity"]


class TangentSpace(AbstractFormulation):
    """The paper's formulation: corrections, accelerations and multipliers from one split of the space of speeds.

    With A = L⁻¹Jᵀ, W = L Lᵀ the metric, column-pivoted QR gives A P = [Q₁ Q₂] [R₁₁ R₁₂; 0 0]: the columns of L⁻ᵀQ₁
    span the normal space, those of L⁻ᵀQ₂ the tangent space. In the mass metric each column of A is first
    scaled to the length of its row of J in radians and lengths of the mechanism, so that τ means the same in each
    metric; c, b and γ in the formulas below are scaled with it, and so is λ.

    **Arguments:**

    - `rank_tolerance`: τ; a loop row counts as independent where |R_kk| > τ max(|R₁₁|, 1).
      Default: 1e-6 in double, 1e-5 in single precision.
    - `metric`: W, in which corrections are smallest and normal and tangent space orthogonal:
      "mass" (default; W = M + JᵀDJ, definite where M is so on the tangent space; the added term, D diagonal,
      changes neither corrections nor accelerations) or "identity" (radians, and lengths of the mechanism).
    - `corrections`: position corrections in each evaluation and after each step.

    **Raises:** `ValueError` for a rank tolerance that is not a positive number of at most 1.
    """

    rank_tolerance: Float[Array, ""] | None
    rank_nearby: Int[Array, " k"] | None = eqx.field(init=False)
    metric: Metric = eqx.field(static=True)
    corrections: int = eqx.field(static=True)

    def __init__(self, rank_tolerance: Number | None = None, *, metric: Metric = "mass", corrections: int = 1) -> None:
        self.rank_tolerance = None
        if rank_tolerance is not None:
            within = lambda tolerance: (tolerance > 0.0) & (tolerance <= 1.0)
            remedy = "it must be positive, and at most 1, such as 1e-6"
            tolerance = number(rank_tolerance, (), "rank_tolerance")
            self.rank_tolerance = require(tolerance, within, "rank_tolerance", remedy)
        self.rank_nearby = None
        self.metric = one_of(metric, get_args(Metric), "metric")
        self.corrections = whole_number(corrections, "corrections")

    def prepared(self, dtype: np.dtype | type, rank_nearby: Int[Array, " k"] | None = None) -> "TangentSpace":
        """Fill in τ for a floating-point type, and the rank of J along the motion where it is known.

        `rank_nearby`: of each island of the mechanism, or of each front of its elimination plan, (k,), see
        `linkax.equations.structure`. In a singular configuration the rank itself is smaller.
        """
        double = np.finfo(dtype).bits == 64
        default = 1e-6 if double else 1e-5
        tolerance = jnp.asarray(default if self.rank_tolerance is None else self.rank_tolerance, dtype)
        ranks = self.rank_nearby if rank_nearby is None else rank_nearby
        numbers = lambda method: (method.rank_tolerance, method.rank_nearby)
        return eqx.tree_at(numbers, self, (tolerance, ranks), is_leaf=lambda leaf: leaf is None)

    @property
    def tolerance(self) -> Array:
        """τ of a formulation that was prepared."""
        assert self.rank_tolerance is not None
        return self.rank_tolerance

    @property
    def distance_floor(self) -> Array:
        """τ: below it rows count as dependent."""
        return self.tolerance

    @property
    def moves_after_steps(self) -> bool:
        """No: derivatives are those of the corrected state."""
        return False

    @property
    def closes_loops(self) -> bool:
        """Yes: with fresh factors, by Newton's method."""
        return True

    def split(self, linear: LinearSystem) -> Factors:
        """Factorise A P = Q R, front by front where that takes less."""
        if linear.configuration.system.structure.elimination is None:
            return self._split_at_once(linear)
        return self._split_by_blocks(linear, self._weight_blocks(linear))

    def correct_position(
        self,
        linear: LinearSystem,
        split: Factors,
        configuration: Configuration,
        correct: bool | Bool[Array, ""] = True,
    ) -> Float[Array, " n_q"]:
        """q ← q ⊕ δ with the smallest δ that has J δ = −c: δ = −L⁻ᵀ Q₁ R₁₁⁻ᵀ (Pᵀ c)ᵣ (paper, position correction).

        **Arguments:** `linear`, `split`: J and its factors, of this configuration or one close to it; `configuration`:
        the one to correct, where the loops are open by c; `correct`: δ is zero where this is False.
        """
        change = self.least_change(linear, split, -residual(configuration), refinements=0)
        change = change if correct is True else jnp.where(correct, change, 0.0)
        return retract(configuration.system.topology, configuration.q, change)

    def correct_velocity(
        self, linear: LinearSystem, split: Factors, v: Float[Array, " n_v"], refinements: int
    ) -> Float[Array, " n_v"]:
        """The speeds nearest to v with J v = b: v ← L⁻ᵀ [Q₂ Q₂ᵀ w + Q₁ R₁₁⁻ᵀ (Pᵀ b)ᵣ], w = Lᵀ v (paper, velocities).

        `refinements`: steps of iterative refinement, for factors of a configuration close by.
        """
        weight, configuration = self._weight(linear), linear.configuration
        b = rate(configuration)
        product = self._saddle_point(linear, weight, self._weight_blocks(linear))
        momentum = product(jnp.concatenate([v, jnp.zeros_like(b)]))[: len(v)]
        return constrained_solve(split, weight, linear.jacobian, momentum, b, refinements, product)[0]

    def solve_accelerations(
        self,
        linear: LinearSystem,
        split: Factors,
        f: Float[Array, " n_v"],
        gamma: Float[Array, " m"],
        refinements: int,
    ) -> tuple[Float[Array, " n_v"], Float[Array, " m"]]:
        """v̇ and λ of M v̇ = f + Jᵀλ, J v̇ = γ, by the projected equation (paper, equations of motion).

        With B = L⁻ᵀ: v̇ = B Q₁ R₁₁⁻ᵀ (Pᵀγ)ᵣ + B Q₂ ζ, where (B Q₂)ᵀ M (B Q₂) ζ = (B Q₂)ᵀ (f − M B Q₁ R₁₁⁻ᵀ (Pᵀγ)ᵣ);
        the multipliers of the independent rows are λ = P R₁₁⁻¹ (B Q₁)ᵀ (M v̇ − f), those of the others zero.
        In the mass metric (B Q₂)ᵀ M (B Q₂) = 1, and W in place of M has the multipliers λ + D γ.
        `linkax.linalg.saddle_inverse.invert` has the products of the factors.
        """
        inverse = self._with_mass(linear, split)
        product = self._saddle_point(linear, linear.mass, linear.blocks)
        return constrained_solve(inverse, linear.mass, linear.jacobian, f, gamma, refinements, product)

    def tangential_part(
        self, linear: LinearSystem, split: Factors, change: Float[Array, " n_v"]
    ) -> Float[Array, " n_v"]:
        """The part of a change that keeps the loops closed: L⁻ᵀ Q₂ Q₂ᵀ Lᵀ δ. Errors of a state have this part only."""
        product = self._saddle_point(linear, self._weight(linear), self._weight_blocks(linear))
        none = jnp.zeros(linear.jacobian.shape[0], change.dtype)
        along, _ = split.apply(product(jnp.concatenate([change, none]))[: len(change)], none)
        # The factors are those of the state before its correction.
        opened = product(jnp.concatenate([along, none]))[len(change) :]
        return along - split.apply(jnp.zeros_like(change), opened)[0]

    def least_change(
        self, linear: LinearSystem, split: Factors, rows: Float[Array, " m"], refinements: int
    ) -> Float[Array, " n_v"]:
        """The smallest change δ of coordinates or speeds with J δ = rows: L⁻ᵀ Q₁ R₁₁⁻ᵀ (Pᵀ rows)ᵣ."""
        weight = self._weight(linear)
        still = jnp.zeros(weight.shape[0], weight.dtype)
        product = self._saddle_point(linear, weight, self._weight_blocks(linear))
        return constrained_solve(split, weight, linear.jacobian, still, rows, refinements, product)[0]

    def _weight(self, linear):
        """W."""
        if self.metric == "mass":
            return linear.mass
        return jnp.diag(linear.configuration.system.scales**-2)

    def _weight_blocks(self, linear):
        """J and W by front; None without fronts."""
        system = linear.configuration.system
        if linear.blocks is None or self.metric == "mass":
            return linear.blocks
        return with_identity_metric(linear.blocks, system.structure.elimination, system.scales)

    def _split_at_once(self, linear) -> SaddleInverse:
        """The split with a basis of the tangent space."""
        weight = linear.mass if self.metric == "mass" else None
        system = linear.configuration.system
        islands, ranks = system.structure.islands, self._ranks_of_islands(system)
        return invert_apart(weight, linear.jacobian, system.scales, self.tolerance, islands, ranks)

    def _split_by_blocks(self, linear, blocks) -> BlockInverse:
        system = linear.configuration.system
        plan = system.structure.elimination
        return invert_by_blocks(blocks, system.scales, self.tolerance, plan, self.rank_nearby)

    def _with_mass(self, linear, split):
        """The inverse with M in place of W, for the same split."""
        if self.metric == "mass":
            return split
        if isinstance(split, BlockInverse):
            return self._split_by_blocks(linear, linear.blocks)
        return with_mass(split, linear.mass)

    def _saddle_point(self, linear, weight, blocks):
        """[[W, -Jᵀ], [J, 0]] as a function of one vector."""
        if blocks is None:
            return SaddlePoint(weight, linear.jacobian)
        plan = linear.configuration.system.structure.elimination
        return SaddlePointInFronts(blocks, plan, linear.jacobian.shape[::-1])

    def _ranks_of_islands(self, system):
        """`rank_nearby` of the islands."""
        return None if self.rank_nearby is None else system.structure.ranks_of_islands(self.rank_nearby)

    @jit_inline
    def derivative(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        correct: bool | Bool[Array, ""],
    ) -> tuple[Float[Array, " n_v"], Float[Array, " n_v"], Float[Array, " n_q"], Float[Array, ""]]:
        """v and v̇ at (t, q, v), corrected before the equations of motion are formed, q and d there."""
        found = projected_state.evaluate((self, system, t, q, v), correct if system.topology.num_rows > 0 else False)
        return found.v, found.acceleration, found.q, found.split.distance

    @jit_inline
    def correct(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        errors: tuple[Float[Array, " n_v"], ...] = (),
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], tuple[Float[Array, " n_v"], ...], Float[Array, ""]]:
        """q and v moved onto the manifold, for states close to it, and the distance d there.

        `errors`, of q and of v, (n_v,) each, are estimates of errors of the state. Of them only the
        part in the tangent space remains in the state, and only that is returned; what the
        correction leaves of the loops open counts as an error of all coordinates.
        """
        if system.topology.num_rows == 0:
            return on_manifold(system.topology, q), v, errors, jnp.ones((), q.dtype)
        q, v, split = projected_state.correct((self, system, t, q, v))
        if errors:
            linear = lax.stop_gradient(linear_system(system, t, q))
            in_q, in_v = jax.vmap(lambda error: self.tangential_part(linear, split, error))(jnp.stack(errors))
            if np.any(system.topology.slips):  # along which no correction of places takes errors out
                in_q = errors[0]
            open_ = widest(linear.configuration) * system.scales
            errors = jnp.where(jnp.abs(in_q) < open_, open_, in_q), in_v
        return q, v, errors, split.distance

    @jit_inline
    def close(
        self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"]]:
        """q and v on the manifold to rounding, from any state near it, with fresh factors."""
        if system.topology.num_rows == 0:
            return on_manifold(system.topology, q), v
        return projected_state.close((self, system, t, q, v))

    @jit_inline
    def dynamics(self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Dynamics:
        """Accelerations and multipliers at a state on the manifold."""
        linear = linear_system(system, t, q)
        split = self.split(linear)
        motion = move(linear.configuration, v)
        f, right = generalised_force(motion), gamma(motion)
        if system.topology.num_rows == 0:
            acceleration, multipliers = self.solve_accelerations(linear, split, f, right, refinements=1)
        else:
            acceleration = projected_state.limit_of_acceleration(self, system, t, q, v)
            _, multipliers = self.solve_accelerations(linear, split, f, linear.jacobian @ acceleration, refinements=1)
        violation = linear.jacobian @ acceleration - right
        return Dynamics(acceleration, multipliers, violation)

    @jit_inline
    def least_multipliers(
        self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> Float[Array, " m"]:
        """Multipliers of minimum norm at a state on the manifold, close to a singular configuration as a limit.

        There J has fewer independent rows than the motion needs. Not numbers where motion goes through it and they
        have no limit: forces that press against it make them grow without bound, and change sign in it.
        """
        return projected_state.limit_of_multipliers(self, system, t, q, v)

    def constraint_split(self, system: System, t: ScalarLike, q: Float[Array, " n_q"]) -> ConstraintSplit:
        """J and its split, with a basis of the tangent space, at coordinates q."""
        linear = linear_system(system, t, q)
        return ConstraintSplit(linear.configuration, linear.jacobian, self._split_at_once(linear))

    @jit_inline
    def right_inverse(
        self, system: System, t: ScalarLike, q: Float[Array, " n_q"]
    ) -> tuple[Float[Array, "m n_v"], Float[Array, "n_v m"], Float[Array, ""]]:
        """J, (m, n_v), a right inverse G of its independent rows, (n_v, m), and d at coordinates q."""
        linear = linear_system(system, t, q)
        split, (rows, n) = self.split(linear), linear.jacobian.shape
        column = lambda gamma: split.apply(jnp.zeros(n, gamma.dtype), gamma)[0]
        return linear.jacobian, jax.vmap(column, out_axes=1)(jnp.eye(rows, dtype=q.dtype)), split.distance

    def distance(self, system: System, t: ScalarLike, q: Float[Array, " n_q"]) -> Float[Array, ""]:
        """The distance d from the nearest singular configuration, with derivatives."""
        linear = linear_system(system, t, q)
        weight = linear.mass if self.metric == "mass" else None
        islands, ranks = system.structure.islands, self._ranks_of_islands(system)
        return singularity_distance(weight, linear.jacobian, system.scales, self.tolerance, islands, ranks)

    def at_rest(self, system: System, t: ScalarLike, q: Float[Array, " n_q"]) -> AtRest:
        """The acceleration from rest at coordinates q, and what selects its branch."""
        linear = linear_system(system, t, q)
        split, rest = self._split_at_once(linear), jnp.zeros(system.topology.num_speeds, system.dtype)
        inverse = self._with_mass(linear, split)
        motion = move(linear.configuration, rest)
        acceleration, _ = inverse.apply(generalised_force(motion), gamma(motion))
        at = ConstraintSplit(linear.configuration, linear.jacobian, split)
        return AtRest(at, linear.mass, acceleration, inverse.definiteness)
