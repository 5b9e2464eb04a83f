"""Natural frequencies, modes and eigenvalues about an equilibrium or a steady motion."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Int

from linkax.analysis.eigenpairs import symmetric_spectrum
from linkax.analysis.linearisation import Linearisation, StateSlopes, gyroscopic_frequencies, state_matrix
from linkax.analysis.moving import Moving
from linkax.analysis.steadiness import ROUNDING_ULPS, UNFELT, Steadiness
from linkax.analysis.steady import may_move, system_in
from linkax.analysis.symmetry import find_turns, num_turns
from linkax.equations.internal_states import bound
from linkax.equations.system import system_of
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.forces.internal_states import scales
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import whole_number
from linkax.simulation.explain.diagnosis import massless_bodies
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, marked
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, concrete
from linkax.xla.undefined import nan_where
from scalarjit import scalarised


def linearise(
    mechanism: Mechanism, state: State, *, t: ArrayLike = 0.0, degrees_of_freedom: int | None = None
) -> Linearisation:
    """Find natural frequencies and modes about an equilibrium or a steady motion, see `linkax.equilibrium`.

    Where all speeds of the state are zero, drives hold their joints in their positions at time t [s]. Else drives go
    on, at rates that the state must have. In a steady motion joints go on at constant speeds, driven or not, and
    neither the loops nor the forces in axes that turn with the joints change.

    **Arguments:**

    - `mechanism`, `state`: see `linkax.simulate`. `t`: time [s].
    - `degrees_of_freedom`: number d of the mechanism. JAX transformations need it, since they cannot count.

    **Returns:** a `Linearisation`.

    Internal states of force elements, such as pressures, are those of the state, and stand still there too; what they
    add, and what displacements that slips bar do, is in `states` and `eigenvalues`.

    **Raises:** `ValueError` for a state that is neither in equilibrium nor in steady motion. Inside JAX transformations
    nothing is raised, and the numbers are NaN.

    A state in single precision counts as steady where it is so to 1e-2; eigenvalues are as accurate, next to the
    fastest rate.
    """
    state = checked_state(mechanism, state)
    t = jnp.asarray(checked_time(t, "t"), state.q.dtype)
    if degrees_of_freedom is None:
        rank = concrete(_rank(mechanism, state, t))
        if rank is None:
            raise ValueError("linearise inside a JAX transformation needs degrees_of_freedom=; give their number")
        degrees_of_freedom = mechanism.topology.num_speeds - int(rank)
    asked = whole_number(degrees_of_freedom, "degrees_of_freedom", least=0)
    most = min(asked, mechanism.topology.num_speeds)
    linearisation, steadiness, counted = _along_symmetry(mechanism, state, t, most, may_move(state))
    if concrete(counted) is not None and counted != asked:
        raise ValueError(f"degrees_of_freedom is {asked}; the mechanism has {counted} here: give that, or leave it out")
    if not all_concrete((linearisation, steadiness)):
        unsteady = jnp.logical_not(steadiness.is_steady)
        return marked(mechanism, nan_where(unsteady, linearisation, (mechanism, state, t)))
    if not np.all(np.isfinite(linearisation.natural_frequencies)):
        system = system_of(mechanism, state.q.dtype)
        massless = massless_bodies(system, TangentSpace().prepared(system.dtype), t, state.q)
        why = f"bodies {', '.join(map(repr, massless))} move without mass" if massless else "forces are not finite"
        raise ValueError(f"frequencies are not finite, because {why}; give mass and inertia, or finite numbers")
    steadiness.check(mechanism, state, t)
    return marked(mechanism, linearisation)


@scalarised
def _rank(mechanism, state, t):
    """Number of independent constraints, drives included."""
    system = system_in(mechanism, state, t, False)
    return jnp.sum(TangentSpace().prepared(system.dtype).constraint_split(system, t, state.q).inverse.rank)


def _along_symmetry(mechanism, state, t, count, moves):
    """`_linearise` along a symmetry that has a steady motion: of all joints at constant speeds, or with turns."""
    along = partial(_linearise, mechanism, state, t, count, moves)
    constant = jnp.zeros((1, num_turns(mechanism.topology) if moves else 0), state.q.dtype)
    if constant.size and not all_concrete((mechanism, state, t)):
        turns = _turns(mechanism, state, t, count)
        # Derivatives of the motion may need turns where it does not.
        return along(jnp.concatenate([turns - lax.stop_gradient(turns), turns]))
    found = along(constant)
    if constant.size and not found[1].is_steady:
        turned = along(_turns(mechanism, state, t, count))
        return turned if turned[1].is_steady else found
    return found


def _moving(mechanism, state, t, count, moves):
    """The mechanism at the state, and the degrees of freedom counted there."""
    system = bound(system_in(mechanism, state, t, moves), state.internal)
    v = state.v if moves else jnp.zeros(system.topology.num_speeds, system.dtype)
    return Moving.of(system, TangentSpace().prepared(system.dtype), t, state.q, v, count, moves)


@scalarised
def _turns(mechanism, state, t, count):
    """Turns of a symmetry that the motion may go on along, (1, m)."""
    moving, _ = _moving(mechanism, state, t, count, True)
    turns = find_turns(moving.symmetry, moving.system, moving.method, t, state.q, moving.basis, moving.free)
    return jnp.where(jnp.all(jnp.isfinite(turns)), turns, 0.0)[None]


@scalarised
def _linearise(mechanism, state, t, count, moves, turns) -> tuple[Linearisation, Steadiness, Int[Array, ""]]:
    """A `Linearisation`, its `Steadiness`, along the first of `turns`, (k, m), that has a steady motion, or the first.

    And the degrees of freedom counted at the state.
    """
    still, counted = _moving(mechanism, state, t, count, moves)
    if not turns.size:
        return *_of_moving(mechanism, state, still), counted
    found, steadiness = lax.map(lambda each: _of_moving(mechanism, state, still.along(each)), turns)
    needed = jnp.argmax(jax.vmap(lambda each: each.is_steady)(steadiness))
    return *jax.tree.map(lambda leaf: leaf[needed], (found, steadiness)), counted


def _of_moving(mechanism, state, moving):
    """A `Linearisation` and its `Steadiness`."""
    count, history = moving.degrees_of_freedom, moving.history()
    by_places, by_rates = history.by_places[0], history.by_rates[0]
    # Slopes along directions that are not numbers, where bodies move without mass, may be known to be zeros.
    exists = jnp.all(jnp.isfinite(moving.basis))
    stiffness, damping = (jnp.where(exists, each[:count, :count], jnp.nan) for each in (by_places, by_rates))
    units = jnp.zeros(0, state.q.dtype) if state.internal is None else scales(mechanism.forces, state.q.dtype)
    rates, states = moving.states(state.internal, units)
    frequencies, modes = _frequencies(moving, (stiffness + stiffness.T) / 2.0, damping)
    linearisation = Linearisation(
        natural_frequencies=frequencies,
        modes=modes,
        basis=moving.free,
        stiffness=stiffness,
        damping=damping,
        states=_with_barred(states, by_places[:count, count:], by_rates[count:]),
    )
    return linearisation, lax.stop_gradient(Steadiness.of(moving, history, states, rates, units))


def _with_barred(states, stiffness, rates):
    """Displacements that slips bar as further states; None without either.

    **Arguments:** `states`: by all of y; `stiffness`: by what is barred, (d, b); `rates`: slopes of this, (b, d + b).
    """
    degrees, barred = stiffness.shape
    if states.force.shape[1] + barred == 0:
        return None
    split = lambda matrix: jnp.split(matrix, [degrees], axis=1)
    (by_free, by_barred), (of_free, of_barred) = split(states.by_coordinates), split(rates)
    none = jnp.zeros((barred, degrees + len(by_free)), rates.dtype)
    return StateSlopes(
        force=jnp.concatenate([states.force, -stiffness], axis=1),
        by_coordinates=jnp.concatenate([by_free, of_free]),
        by_speeds=jnp.concatenate([states.by_speeds, none[:, :degrees]]),
        by_states=jnp.block([[states.by_states, by_barred], [none[:, degrees:], of_barred]]),
    )


def _frequencies(moving, symmetric, damping):
    """Natural frequencies, and speeds of the tree's joints in each mode, NaN where gyroscopic terms couple them."""
    system, couples, gyroscopic = moving.system, jnp.zeros((), bool), (damping - damping.T) / 2.0
    may_couple = moving.moves and damping.size
    if may_couple:
        rounding = ROUNDING_ULPS * jnp.finfo(system.dtype).eps * jnp.max(jnp.abs(damping))
        couples = jnp.max(jnp.abs(gyroscopic)) > UNFELT * system.fastest(moving.v) + rounding
    # The eigenproblem that is not used gets eigenvalues apart from each other, so that its derivatives are finite.
    apart = jnp.diag(jnp.arange(1.0, len(symmetric) + 1.0, dtype=system.dtype) ** 2)
    values, vectors = symmetric_spectrum(jnp.where(couples, apart, symmetric))
    frequencies = jnp.sign(values) * jnp.sqrt(jnp.where(values == 0.0, 1.0, jnp.abs(values)))
    if may_couple:
        matrix = state_matrix(jnp.where(couples, symmetric, apart), jnp.where(couples, gyroscopic, 0.0))
        frequencies = jnp.where(couples, gyroscopic_frequencies(matrix), frequencies)
    return frequencies, jnp.where(couples, jnp.nan, moving.free @ vectors)
