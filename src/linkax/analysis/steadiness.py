"""How steady a motion is, so that its linearisation is constant, and errors where it is not."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Bool, Float

from linkax.analysis.eigenpairs import eigh
from linkax.analysis.linearisation import StateSlopes
from linkax.analysis.moving import Coefficients, Moving
from linkax.analysis.steady import AGREES, largest_force, limit, missed_rates, of_missed_rate
from linkax.equations.configuration import configure
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.initial_state import moving_joints
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio

NEAR = 1e-6  # distance from an equilibrium up to which a state counts as in it [rad, lengths of the mechanism]
SLOW = 1e-3  # of the fastest speed: the rate that accelerations of what nothing holds are next to
UNFELT = 1e-9  # forces that rounding leaves, relative to all forces
CONSTANT = 1e-5  # relative change of coefficients and loops up to which they count as constant
ROUNDING_ULPS = 1e5  # error of a stiffness, in units of rounding of the largest one


class Steadiness(NamedTuple):
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

    @staticmethod
    def of(
        moving: Moving,
        history: Coefficients,
        states: StateSlopes,
        rates: Float[Array, " n_s"],
        units: Float[Array, " n_s"],
    ) -> "Steadiness":
        """How steady a motion is, see `Moving.history` and `Moving.states`; `units`: scales of internal states."""
        system, v, count = moving.system, moving.v, moving.degrees_of_freedom
        stiffness = history.by_places[0, :count, :count]
        # Distances and changes are measured in undamped modes of the symmetric stiffness.
        values, vectors = eigh((stiffness + stiffness.T) / 2.0)
        fastest = system.fastest(v)
        square = jnp.maximum(jnp.abs(values), fastest**2)
        size = jax.vmap(system.fastest, in_axes=1)(moving.free @ vectors)
        forces = largest_force(move(configure(system, moving.t, moving.q), v))
        along = jnp.abs(history.accelerations @ vectors)
        # Parts of a force may cancel, those of internal states among them.
        unfelt = limit(UNFELT, system.dtype)
        felt = along > unfelt * (size * forces + jnp.abs(vectors.T @ states.force) @ units)
        # A rotor may turn a thousand times as fast as what carries it falls.
        held = jnp.maximum(jnp.abs(values), (SLOW * fastest) ** 2)
        distance = jnp.where(felt, size * along, 0.0) / jnp.where(felt, held, 1.0)
        worst = jnp.argmax(jnp.max(distance, axis=1, initial=0.0))

        # Relative to the geometric mean of two modes' stiffnesses, and beyond rounding of the stiffest one.
        barred = moving.basis.shape[1] - count
        vectors = block_diag(vectors, jnp.eye(barred, dtype=system.dtype))
        square = jnp.concatenate([square, jnp.broadcast_to(fastest**2, (barred,))])
        scale = jnp.sqrt(jnp.outer(square, square))

        def changes(matrices, scale):
            seen = vectors.T @ matrices @ vectors
            scale = scale + jnp.abs(seen[0])
            differences = jnp.abs(seen - seen[0])
            felt = differences > ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(scale, initial=0.0)
            return jnp.max(jnp.where(felt, differences, 0.0) / jnp.where(felt, scale, 1.0), initial=0.0)

        of_both = changes(history.by_places, scale), changes(history.by_rates, jnp.sqrt(scale))
        return Steadiness(
            missed=missed_rates(system, moving.t, moving.q, v) if moving.moves else jnp.zeros(0, system.dtype),
            off=jnp.max(distance, initial=0.0),
            acceleration=moving.free @ history.accelerations[worst],
            changes=jnp.max(jnp.stack([*of_both, jnp.max(history.opens)])),
            of_states=_of_states(moving, states, rates, units),
        )

    @property
    def is_steady(self) -> Bool[Array, ""]:
        """Whether all of them are negligible."""
        agrees, near, constant = self._limits
        still = jnp.max(self.of_states, initial=0.0) <= near
        return (jnp.max(self.missed, initial=0.0) <= agrees) & (self.off <= near) & (self.changes <= constant) & still

    @property
    def _limits(self):
        return [limit(most, self.off.dtype) for most in (AGREES, NEAR, CONSTANT)]

    def check(self, mechanism: Mechanism, state: State, t: Float[Array, ""]) -> None:
        """Raise a ValueError where the linearisation would not be constant."""
        missed, topology, when = np.asarray(self.missed), mechanism.topology, f"at t = {float(t):.6g} s"
        agrees, near, constant = self._limits
        if not np.max(missed, initial=0.0) <= agrees:
            told = of_missed_rate(mechanism, missed, int(np.argmax(missed)), t)
            raise ValueError(f"{told}, or give it speeds of zero, where drives hold")
        acceleration = np.asarray(self.acceleration)
        if not self.off <= near:
            system = system_of(mechanism, state.q.dtype)
            column = int(np.argmax(np.abs(acceleration / np.asarray(system.scales))))
            joint = next(name for name, columns in topology.speeds.items() if columns.start <= column < columns.stop)
            raise ValueError(
                f"the state is {float(self.off):.3g} off an equilibrium, in radians or lengths of the mechanism: "
                f"joint {joint!r} accelerates by {acceleration[column]:.6g} {when}; begin with linkax.equilibrium"
            )
        of_states = np.asarray(self.of_states)
        if not np.max(of_states, initial=0.0) <= near:
            names = [f"{name!r} of {force.display_name}" for force in mechanism.forces for name in force.states]
            counts = [entry.initial.size for force in mechanism.forces for entry in force.states.values()]
            worst = np.repeat(names, counts)[np.argmax(of_states)]
            raise ValueError(
                f"the internal state {worst} changes {when}: it is {np.max(of_states):.3g} of its scale off where it "
                "stands still; simulate until it rests"
            )
        if not self.changes <= constant:
            system = system_of(mechanism, state.q.dtype)
            names = ", ".join(map(repr, moving_joints(system, t, state.q, state.v[:, None])))
            raise ValueError(
                f"the motion of joints {names} is not steady: stiffness or loops change by {float(self.changes):.3g} "
                "as it goes on; simulate it, or give a state with speeds of zero"
            )


def _of_states(moving, states, rates, units):
    """How far each internal state is off where it stands still."""
    # The rate that each would have where all coordinates and states were off by one in their scales.
    size = jax.vmap(moving.system.fastest, in_axes=1)(moving.basis)
    sensitivity = jnp.abs(states.by_coordinates) @ ratio(jnp.ones_like(size), size, 0.0)
    sensitivity = sensitivity + jnp.abs(states.by_states) @ units
    felt = jnp.abs(rates) > UNFELT * sensitivity
    return jnp.where(felt, ratio(jnp.abs(rates), sensitivity, jnp.inf), 0.0)
