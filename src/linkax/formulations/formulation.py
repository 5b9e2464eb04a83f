"""What a formulation is: how equations of motion with loops become an ordinary differential equation."""

import abc
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from linkax.equations.configuration import Configuration, configure
from linkax.equations.dynamics import mass_entries
from linkax.equations.loops import jacobian_entries
from linkax.equations.system import System
from linkax.linalg.chained_inverse import Blocks, in_cells
from linkax.tracing import traced_once


class Coefficients(NamedTuple):
    """J and M of M v̇ = f + Jᵀλ, J v̇ = γ at a configuration.

    - `blocks`: what the cells of the mechanism's chain have of both, where it has one.
    """

    configuration: Configuration
    jacobian: Float[Array, "m n_v"]
    mass: Float[Array, "n_v n_v"]
    blocks: Blocks | None


@traced_once
def coefficients(system: System, t, q) -> Coefficients:
    """Loop rows and mass matrix at coordinates q."""
    configuration = configure(system, t, q)
    rows, mass, chain = jacobian_entries(configuration), mass_entries(configuration), system.topology.chain
    # XLA leaves out what is not used.
    return Coefficients(
        configuration, rows.dense(), mass.dense(), None if chain is None else in_cells(chain, mass, rows)
    )


class Dynamics(NamedTuple):
    """What holds at a state.

    - `acceleration`: v̇, (n_v,). `multipliers`: λ, (m,). `violation`: J v̇ − γ, (m,).
    """

    acceleration: Float[Array, " n_v"]
    multipliers: Float[Array, " m"]
    violation: Float[Array, " m"]


class AbstractFormulation(eqx.Module):
    """A way to accelerations of a mechanism with loops, and to states that keep the loops closed.

    Pure functions of (system, t, q, v); see `linkax.TangentSpace` and `linkax.ClassicalFormulation`.
    """

    @property
    @abc.abstractmethod
    def nearest(self):
        """The distance from a singular configuration below which rounding grows no more."""

    @property
    @abc.abstractmethod
    def moves_after_steps(self) -> bool:
        """Whether `correct` moves states to where the derivative is another one than before."""

    @abc.abstractmethod
    def derivative(self, system: System, t, q, v, correct):
        """v, v̇, the coordinates that they hold at, and the distance d from the nearest singular configuration.

        `correct`: put the state on the loops before the equations of motion are formed; False, or a bool array. d is
        one where the formulation does not measure it.
        """

    @abc.abstractmethod
    def correct(self, system: System, t, q, v, errors=()):
        """The state after a step, as the next step begins with it, what remains of `errors` in it, and d."""

    @abc.abstractmethod
    def close(self, system: System, t, q, v):
        """q and v as they are saved and read."""

    @abc.abstractmethod
    def dynamics(self, system: System, t, q, v) -> Dynamics:
        """Accelerations and multipliers at a saved state."""
