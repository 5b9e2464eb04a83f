"""The ordinary differential equation of a mechanism's motion."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.equations.configuration import configure
from linkax.equations.constraint_rows import constraint_rate, constraint_residual
from linkax.equations.coordinates import on_manifold, rates, speeds
from linkax.equations.internal_states import bound, internal_rates, num_states
from linkax.equations.loops import widest
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations.formulation import AbstractFormulation
from linkax.model.forces.internal_states import scales
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.diffrax_contract import integral_of_distance, pack, unpack
from linkax.simulation.integrate.impacts import has_ended, impacts_of
from linkax.simulation.integrate.switches import Sides, are_apart, held, turning, values
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import jit_inline

# Of coordinates and speeds, as changes of both, and of internal states where there are some.
Errors = tuple[Float[Array, " _"], ...]


class Problem(eqx.Module):
    """The arguments of the right-hand side: a mechanism, its numbers, the method that solves it, how well.

    From a state that motion cannot start from, no step is taken (`can_start`). At `closed_at` [s] the state is on the
    loops already: there a correction would be rounding alone, which close to a singular configuration is amplified.
    `from_singular`: the run starts in one. `times`: at which steps end, sorted [s]; None for none. `until`: the end of
    the step that is taken, see `stage_time`. Vectors y: see `linkax.simulation.integrate.diffrax_contract`.
    """

    mechanism: Mechanism
    system: System
    method: AbstractFormulation
    accuracy: Accuracy
    can_start: Bool[Array, ""] | bool = True
    closed_at: Float[Array, ""] | float = np.inf
    from_singular: Bool[Array, ""] | bool = False
    times: Float[Array, " n"] | None = None
    until: Float[Array, ""] | None = None

    def stage_time(self, t: Float[Array, ""], until: Float[Array, ""] | None) -> Float[Array, ""]:
        """The time of a stage, just before the end of its step: steps end where laws may jump."""
        if self.times is None or until is None:
            return t
        end = lax.stop_gradient(until)
        return jnp.minimum(t, until + (jnp.nextafter(end, -jnp.inf) - end))

    def packed(
        self,
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
        sides: Sides = (),
        internal: Float[Array, " n_s"] | None = None,
    ) -> Float[Array, " n"]:
        """The vector y of a state where the run begins."""
        return pack(sides, q, v, internal, 0.0)

    def unpacked(self, y: Float[Array, "*batch n"]) -> tuple[Float[Array, "*batch n_q"], Float[Array, "*batch n_v"]]:
        """q and v of vectors y."""
        return self._parts(y)[1:3]

    def internal(self, y: Float[Array, "*batch n"]) -> Float[Array, "*batch n_s"] | None:
        """Internal states of force elements in vectors y; None where they have none."""
        return self._parts(y)[3] if num_states(self.system) else None

    def _parts(self, y):
        return unpack(self.system.topology, num_states(self.system), y)

    @property
    def scales(self) -> tuple[Float[Array, " _"], ...]:
        """Scales of `Errors`: of coordinates and of speeds, and of internal states where there are some."""
        of_motion, forces = self.system.scales, self.system.forces
        return of_motion, of_motion, *([scales(forces, of_motion.dtype)] if num_states(self.system) else [])

    def sides(self, y: Float[Array, " n"]) -> Sides:
        """What y keeps of switches, the sides on which force elements are held; none where steps do not adapt."""
        sides = self._parts(y)[0]
        return sides if len(sides) else ()

    def on_sides(self, y: Float[Array, " n"], sides: Float[Array, " kept"]) -> Float[Array, " n"]:
        """The same vector with other sides."""
        return jnp.concatenate([sides, y[len(sides) :]])

    def with_speeds(self, y: Float[Array, " n"], v: Float[Array, " n_v"]) -> Float[Array, " n"]:
        """The same vector with other speeds."""
        first = len(self.sides(y)) + self.system.topology.num_coordinates
        return jnp.asarray(y).at[first : first + len(v)].set(v)

    def can_go_on(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Bool[Array, ""] | bool:
        """Whether a step may be taken from a vector."""
        goes_on = self.can_start & jnp.logical_not(self.pressed_through(t, y))
        if not impacts_of(self.system):
            return goes_on
        return goes_on & jnp.logical_not(has_ended(self.system, jnp.asarray(self.sides(y))))

    def pressed_through(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Bool[Array, ""]:
        """Whether bodies are pressed through each other at a vector."""
        configuration = configure(self.system, t, self.unpacked(y)[0])
        return jnp.any(jnp.array([force.pressed_through(configuration) for force in self.system.forces], bool))

    def switches(
        self, t: Float[Array, ""], y: Float[Array, " n"], apart: Bool[Array, " m"] | None = None
    ) -> Float[Array, " m"]:
        """Values of the switches at a vector, (m,), see `switches.values`."""
        return values(bound(self.system, self.internal(y)), t, *self.unpacked(y), apart)

    def are_apart(self, t: Float[Array, ""], y: Float[Array, " n"], least: Float[Array, " m"]) -> Bool[Array, " m"]:
        """Which elements with a switch are from where they may act, (m,), see `switches.are_apart`."""
        return are_apart(self.system, t, *self.unpacked(y), least)

    def turning(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Float[Array, ""] | None:
        """How fast joints between bodies whose force elements switch turn at a vector [rad/s]; None without such."""
        return turning(self.system, t, *self.unpacked(y))

    def errors(self, y: Float[Array, " n"], error: Float[Array, " n"]) -> Errors:
        """Error estimates of q and v at a vector y, as changes (n_v,) of both, and of internal states, if any."""
        _, of_q, of_v, of_internal = self._parts(error)
        of_motion = speeds(self.system.topology, self.unpacked(y)[0], of_q), of_v
        return of_motion if of_internal is None else (*of_motion, of_internal)

    @jit_inline
    def derivative(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Float[Array, " n"]:
        """ẏ = (0, q̇, v̇, ṡ, d) at (t, y), ṡ of internal states."""
        correct = self.accuracy.projection in ("both", "stage") and t != self.closed_at
        sides, internal = self.sides(y), self.internal(y)
        system = bound(self.system, internal)
        system = held(system, sides) if len(sides) else system
        v, acceleration, q, distance = self.method.derivative(system, t, *self.unpacked(y), correct)
        still = jax.tree.map(jnp.zeros_like, sides)
        changes = None if internal is None else internal_rates(move(configure(system, t, q), v))
        return pack(still, rates(system.topology, q, v), acceleration, changes, distance)

    @jit_inline
    def corrected(
        self, t: Float[Array, ""], y: Float[Array, " n"], error: Float[Array, " n"] | None = None
    ) -> tuple[Float[Array, " n"], Errors | None, Float[Array, ""]]:
        """A vector after a step and its error estimate, both corrected, and the distance d there."""
        errors = () if error is None else self.errors(y, error)
        of_motion, of_internal = errors[:2], errors[2:]
        q, v, of_motion, distance = self.method.correct(self.system, t, *self.unpacked(y), of_motion)
        errors = None if error is None else (*of_motion, *of_internal)
        return pack(self.sides(y), q, v, self.internal(y), integral_of_distance(y)), errors, distance

    @jit_inline
    def opens(self, t: Float[Array, ""], y: Float[Array, " n"]) -> Float[Array, ""]:
        """The largest gap of the loops at a vector [rad, lengths of the mechanism]."""
        q = on_manifold(self.system.topology, self.unpacked(y)[0])
        return widest(configure(self.system, t, q))

    @jit_inline
    def drives_on(self, t: Float[Array, ""], y: Float[Array, " n"], ahead: Float[Array, ""]) -> Float[Array, ""]:
        """How long drives would take at their speeds so far to go as far as they go in a time ahead [s]."""
        q, _ = self.unpacked(y)
        asked = constraint_rate(configure(self.system, self.stage_time(t, t), q))
        asked = jnp.where(self.system.topology.slips[-len(asked) :], 0.0, asked)
        return ratio(-(asked @ constraint_residual(configure(self.system, t + ahead, q))), asked @ asked, 0.0)

    def close(self, t: Float[Array, ""], y: Float[Array, " n"]) -> tuple[State, Bool[Array, ""] | bool]:
        """The `State` on the manifold to rounding, and whether it is there, on the branch that y is next to."""
        q, v, holds = self.method.close_near(self.system, t, *self.unpacked(y))
        return State(q, v, self.system.topology, self.internal(y)), holds


def derivative(t: Any, y: Float[Array, " n"], problem: Problem) -> Float[Array, " n"]:
    """The right-hand side of diffrax: `Problem.derivative`."""
    return problem.derivative(problem.stage_time(t, problem.until), y)
