"""The classical formulations: accelerations from a linear system, stabilised or corrected after steps."""

import abc
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.coordinates import on_manifold, retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations.formulation import AbstractFormulation, Dynamics, LinearSystem, linear_system
from linkax.model.numbers import Number, whole_number, zero_or_more
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.batches import one_by_one
from linkax.xla.tracing import jit_inline


def parameter(default: float, what: str) -> Any:
    """Make a field for a traced number of a method, zero or more; `what` names it in errors."""
    return eqx.field(default=default, converter=partial(zero_or_more, what=what))


class AbstractAcceleration(eqx.Module):
    """A way to solve M v̇ = f + Jᵀλ, J v̇ = γ: numbers only, speeds in radians and lengths of the mechanism."""

    @abc.abstractmethod
    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Solve for v̇ and λ, of at least one row; not finite where the way fails."""


class AbstractCorrection(eqx.Module):
    """A way back onto the loops, along a right inverse of J."""

    @abc.abstractmethod
    def right_inverse(self, mass: Float[Array, "n n"], jacobian: Float[Array, "m n"]) -> Float[Array, "n m"]:
        """G with J G r = r for r in the range of J; the change −G c closes the loops."""


class Baumgarte(eqx.Module):
    """Stabilisation by feedback: γ − 2α (J v − b) − β² c in place of γ.

    Baumgarte, Computer Methods in Applied Mechanics and Engineering 1, 1972. α = β is critical
    damping; 5 to 10 1/s are the values in use.

    - `alpha`, `beta` [1/s]: zero for none.
    """

    alpha: Number = parameter(5.0, "alpha of Baumgarte [1/s]")
    beta: Number = parameter(5.0, "beta of Baumgarte [1/s]")


_solve = one_by_one(jnp.linalg.solve)
_accelerate = one_by_one(lambda acceleration, *equations: acceleration(*equations))
_right_inverse = one_by_one(lambda correction, mass, jacobian: correction.right_inverse(mass, jacobian))


def _in_scales(at: LinearSystem):
    """M and J for speeds in radians and lengths of the mechanism."""
    scales = at.configuration.system.scales
    return at.mass * scales[:, None] * scales, at.jacobian * scales


class ClassicalFormulation(AbstractFormulation):
    """Accelerations of one of the classical methods, with a stabilisation and a correction as one likes.

    ```python
    lx.simulate(mechanism, state, t1=5.0, formulation=lx.ClassicalFormulation(
        lx.LagrangeMultipliers(), stabilisation=lx.Baumgarte(10.0, 10.0), correction=lx.MassOrthogonalProjection()))
    ```

    Where `Accuracy.projection` is "both" or "step", states are corrected after each step, and saved states
    always. Without a correction they are left as they are, so that what a method leaves of the loops open
    can be seen. For comparison: through singular configurations, and for derivatives, take the paper's method.

    - `acceleration`, `correction`: see there.
    - `sweeps`: of the correction of positions after each step, Newton's method.
    """

    acceleration: AbstractAcceleration
    stabilisation: Baumgarte = Baumgarte(0.0, 0.0)
    correction: AbstractCorrection | None = None
    sweeps: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        for what, kind in (
            ("acceleration", AbstractAcceleration),
            ("stabilisation", Baumgarte),
            ("correction", AbstractCorrection | None),
        ):
            if not isinstance(getattr(self, what), kind):
                raise ValueError(f"{what} of ClassicalFormulation is {getattr(self, what)!r}, which is none")
        whole_number(self.sweeps, "sweeps of ClassicalFormulation")

    @property
    def distance_floor(self) -> float:
        """Distances are not measured, and count as one."""
        return 1.0

    @property
    def moves_after_steps(self) -> bool:
        return self.correction is not None

    @property
    def closes_loops(self) -> bool:
        """No: without a correction states are left as they are, and with one they get a fixed number of sweeps."""
        return False

    def _solved(self, at: LinearSystem, v) -> Dynamics:
        """Solve for v̇ and λ, and for what v̇ violates of the rows without stabilisation."""
        system, motion = at.configuration.system, move(at.configuration, v)
        force, right, scales = generalised_force(motion), gamma(motion), system.scales
        mass, rows = _in_scales(at)
        if system.topology.num_rows == 0:
            return Dynamics(scales * _solve(mass, scales * force), right, right)
        open_, rate_open = residual(at.configuration), at.jacobian @ v - rate(at.configuration)
        alpha, beta = self.stabilisation.alpha, self.stabilisation.beta
        stabilised = right - 2.0 * alpha * rate_open - beta**2 * open_
        acceleration, multipliers = _accelerate(self.acceleration, mass, rows, scales * force, stabilised)
        acceleration = scales * acceleration
        return Dynamics(acceleration, multipliers, at.jacobian @ acceleration - right)

    @jit_inline
    def derivative(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        correct: bool | Bool[Array, ""],
    ) -> tuple[Float[Array, " n_v"], Float[Array, " n_v"], Float[Array, " n_q"], Float[Array, ""]]:
        q = on_manifold(system.topology, q)
        solved = self._solved(linear_system(system, t, q), v)
        return v, solved.acceleration, q, jnp.ones((), q.dtype)

    @jit_inline
    def correct(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        errors: tuple[Float[Array, " n_v"], ...] = (),
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], tuple[Float[Array, " n_v"], ...], Float[Array, ""]]:
        q, one = on_manifold(system.topology, q), jnp.ones((), q.dtype)
        if self.correction is None or system.topology.num_rows == 0:
            return q, v, errors, one

        def inverse(q):
            at = linear_system(system, t, q)
            return at, system.scales[:, None] * _right_inverse(self.correction, *_in_scales(at))

        def closer(_, q):
            at, back = inverse(q)
            return retract(system.topology, q, -back @ residual(at.configuration))

        q = lax.fori_loop(0, self.sweeps, closer, q)
        at, back = inverse(q)
        remaining = tuple(error - back @ (at.jacobian @ error) for error in errors)
        return q, v - back @ (at.jacobian @ v - rate(at.configuration)), remaining, one

    def close(
        self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"]]:
        q, v, _, _ = self.correct(system, t, q, v)
        return q, v

    def dynamics(self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Dynamics:
        return self._solved(linear_system(system, t, q), v)
