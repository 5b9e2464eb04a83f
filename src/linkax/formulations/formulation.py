"""What a formulation is: how equations of motion with loops become an ordinary differential equation."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import Configuration, configure
from linkax.equations.dynamics import mass_entries
from linkax.equations.loops import jacobian_entries
from linkax.equations.system import System
from linkax.linalg.block_elimination import Blocks, in_fronts
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.tracing import jit_inline


class LinearSystem(NamedTuple):
    """J and M of M v̇ = f + Jᵀλ, J v̇ = γ at a configuration.

    - `blocks`: the entries of both by front, where the mechanism has an elimination plan.
    """

    configuration: Configuration
    jacobian: Float[Array, "m n_v"]
    mass: Float[Array, "n_v n_v"]
    blocks: Blocks | None


@jit_inline
def linear_system(system: System, t: ScalarLike, q: Float[Array, " n_q"]) -> LinearSystem:
    """Compute J and M at coordinates q."""
    configuration = configure(system, t, q)
    rows, mass, plan = jacobian_entries(configuration), mass_entries(configuration), system.structure.elimination
    # XLA leaves out what is not used.
    return LinearSystem(
        configuration, rows.dense(), mass.dense(), None if plan is None else in_fronts(plan, mass, rows)
    )


class Dynamics(NamedTuple):
    """Accelerations and multipliers at a state.

    - `acceleration`: v̇, (n_v,). `multipliers`: λ, (m,). `violation`: J v̇ − γ, (m,).
    """

    acceleration: Float[Array, " n_v"]
    multipliers: Float[Array, " m"]
    violation: Float[Array, " m"]


class AbstractFormulation(eqx.Module):
    """A way to accelerations of a mechanism with loops, and to states that keep the loops closed.

    Pure functions of (system, t, q, v); see `linkax.TangentSpace` and `linkax.ClassicalFormulation`.
    """

    def prepared(self, dtype: np.dtype | type, rank_nearby: Int[Array, " k"] | None = None) -> "AbstractFormulation":
        """The same formulation for a floating-point type, and for the ranks of J along the motion, if it uses them."""
        return self

    @property
    @abc.abstractmethod
    def distance_floor(self) -> ScalarLike:
        """The distance d from a singular configuration below which rounding grows no more."""

    @property
    @abc.abstractmethod
    def moves_after_steps(self) -> bool:
        """Whether `correct` moves a state to where its derivative is another one."""

    @abc.abstractmethod
    def derivative(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        correct: bool | Bool[Array, ""],
    ) -> tuple[Float[Array, " n_v"], Float[Array, " n_v"], Float[Array, " n_q"], Float[Array, ""]]:
        """Compute (v, v̇, q, d): speeds, accelerations, where they hold, and the distance from a singular
        configuration.

        `correct`: put the state on the loops before the equations of motion are formed; False, or a bool array. d is
        one where the formulation does not measure it.
        """

    @abc.abstractmethod
    def correct(
        self,
        system: System,
        t: ScalarLike,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        errors: tuple[Float[Array, " n_v"], ...] = (),
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], tuple[Float[Array, " n_v"], ...], Float[Array, ""]]:
        """Correct the state after a step: (q, v, what remains of `errors` in it, d)."""

    @abc.abstractmethod
    def close(
        self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"]]:
        """Compute q and v as they are saved and read."""

    @abc.abstractmethod
    def dynamics(self, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> Dynamics:
        """Compute accelerations and multipliers at a saved state."""
