"""The ordinary differential equation of a mechanism's motion."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from linkax.equations.coordinates import rates, speeds
from linkax.equations.system import System
from linkax.formulations.formulation import AbstractFormulation
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.diffrax_contract import integral_of_distance, pack, unpack
from linkax.simulation.integrate.switches import Sides, held, values
from linkax.simulation.start.state import State
from linkax.straight_line.transform import straight_line
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline

Errors = tuple[Float[Array, " n_v"], Float[Array, " n_v"]]  # of coordinates and speeds, as changes of both


class Problem(eqx.Module):
    """The arguments of the right-hand side: a mechanism, its numbers, the method that solves it, how well.

    From a state that motion cannot start from, no step is taken (`can_start`). At `closed_at` [s] the state is on the
    loops already: there a correction would be rounding alone, which close to a singular configuration is amplified.
    `from_singular`: the run starts in one. Vectors y: see `linkax.simulation.integrate.diffrax_contract`.
    """

    mechanism: Mechanism
    system: System
    method: AbstractFormulation
    accuracy: Accuracy
    can_start: Bool[Array, ""] | bool = True
    closed_at: Float[Array, ""] | float = np.inf
    from_singular: Bool[Array, ""] | bool = False

    def packed(self, q: Float[Array, " n_q"], v: Float[Array, " n_v"], sides: Sides = ()) -> Float[Array, " n"]:
        """The vector y of a state where the run begins."""
        return pack(sides, q, v, 0.0)

    def unpacked(self, y: Float[Array, "*batch n"]) -> tuple[Float[Array, "*batch n_q"], Float[Array, "*batch n_v"]]:
        """q and v of vectors y."""
        return unpack(self.system.topology, y)[1:]

    def sides(self, y: Float[Array, " n"]) -> Sides:
        """The sides of switches on which force elements are held, (m,); none where steps do not adapt to them."""
        sides = unpack(self.system.topology, y)[0]
        return sides if len(sides) else ()

    def on_sides(self, y: Float[Array, " n"], sides: Float[Array, " m"]) -> Float[Array, " n"]:
        """The same vector with other sides."""
        return jnp.concatenate([sides, y[len(sides) :]])

    def switches(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Float[Array, " m"]:
        """Values of the switches at a vector, (m,)."""
        return values(self.system, t, *self.unpacked(y))

    def errors(self, y: Float[Array, " n"], error: Float[Array, " n"]) -> Errors:
        """Error estimates of q and v at a vector y, as changes (n_v,) of both."""
        of_q, of_v = self.unpacked(error)
        return speeds(self.system.topology, self.unpacked(y)[0], of_q), of_v

    @jit_inline
    @straight_line
    def derivative(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Float[Array, " n"]:
        """ẏ = (0, q̇, v̇, d) at (t, y)."""
        correct = self.accuracy.projection in ("both", "stage") and t != self.closed_at
        sides = self.sides(y)
        system = held(self.system, sides) if len(sides) else self.system
        v, acceleration, q, distance = self.method.derivative(system, t, *self.unpacked(y), correct)
        still = jax.tree.map(jnp.zeros_like, sides)
        return pack(still, rates(system.topology, q, v), acceleration, distance)

    @jit_inline
    @straight_line
    def corrected(
        self, t: Float[Array, ""], y: Float[Array, " n"], error: Float[Array, " n"] | None = None
    ) -> tuple[Float[Array, " n"], tuple[Float[Array, " n_v"], ...] | None, Float[Array, ""]]:
        """A vector after a step and its error estimate, both corrected, and the distance d there."""
        errors = () if error is None else self.errors(y, error)
        q, v, errors, distance = self.method.correct(self.system, t, *self.unpacked(y), errors)
        return pack(self.sides(y), q, v, integral_of_distance(y)), None if error is None else errors, distance

    def close(self, t: Float[Array, ""], y: Float[Array, " n"]) -> State:
        """The `State` on the manifold to rounding."""
        return State(*self.method.close(self.system, t, *self.unpacked(y)), self.system.topology)


def derivative(t: Any, y: Float[Array, " n"], problem: Problem) -> Float[Array, " n"]:
    """The right-hand side of diffrax: `Problem.derivative`."""
    return problem.derivative(t, y)
