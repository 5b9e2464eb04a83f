"""States on the loops and their accelerations by `TangentSpace`: values, tangents, limits in singular configurations.

Each function takes (method, system, t, q, v). What is differentiated are the equations that a state satisfies, see
`linkax.formulations.tangents`; close to a singular configuration values are limits, see
`linkax.formulations.singular_limit`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.constraint_rows import is_driven
from linkax.equations.coordinates import on_manifold, retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma, widest
from linkax.equations.motion import move
from linkax.equations.system import System
from linkax.formulations.formulation import linear_system
from linkax.formulations.singular_limit import Direction, Value, singular_limit
from linkax.formulations.tangents import Tangents, state_tangent, unbalanced_tangent
from linkax.linalg.block_elimination import Factors
from linkax.linalg.least_multipliers import least_multipliers
from linkax.linalg.while_falling import while_falling
from linkax.spatial.vectors import largest
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.derivatives import positive_or_one, ratio
from linkax.xla.tracing import jit_inline

ROUNDING_ULPS = 8.0
MOST_CORRECTIONS = 20
ALONG = (1e-4, 1e-3, 1e-2)  # radians or lengths of the mechanism, along which ranks of fronts show


# Of a `TangentSpace`, which calls these functions, and a state: (method, system, t, q, v).
Arguments = tuple[Any, System, ScalarLike, Float[Array, " n_q"], Float[Array, " n_v"]]


class Evaluated(NamedTuple):
    """A state on the loops, its acceleration and multipliers, and the split that they follow from."""

    q: Float[Array, " n_q"]
    v: Float[Array, " n_v"]
    acceleration: Float[Array, " n_v"]
    multipliers: Float[Array, " m"]
    split: Factors


@eqx.filter_custom_jvp
def evaluate(arguments: Arguments, correct: bool | Bool[Array, ""]) -> Evaluated:
    """The acceleration at a state, or at the one on the loops next to it: one factorisation, at q."""
    method, system, t, q, v = arguments
    linear = linear_system(system, t, q if correct is False else on_manifold(system.topology, q))
    split = method.split(linear)
    if correct is not False:
        linear = _corrected_position(method, system, t, linear, split, correct)
        v = jnp.where(correct, method.correct_velocity(linear, split, v, refinements=2), v)
    motion = move(linear.configuration, v)
    f, right = generalised_force(motion), gamma(motion)
    refinements = 1 if correct is False else 2
    acceleration, multipliers = method.solve_accelerations(linear, split, f, right, refinements)
    return Evaluated(linear.configuration.q, v, acceleration, multipliers, split)


@evaluate.def_jvp
def _evaluate_jvp(primals, tangents):
    (arguments, correct), (tangents, _) = primals, tangents
    method, system, t, _, _ = arguments
    found = evaluate(arguments, correct)
    linear = linear_system(system, t, found.q)
    state = _state_tangent(method, linear, found.v, None if correct is False else found.split, tangents[1:])
    sides = unbalanced_tangent(state, found.acceleration, found.multipliers)
    acceleration, multipliers = method.solve_accelerations(linear, found.split, *sides, refinements=2)
    return found, Evaluated(state.to_q, state.to_v, acceleration, multipliers, _constant(found.split))


@eqx.filter_custom_jvp
def correct(
    arguments: Arguments,
) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], Factors]:
    """The state on the loops next to one that is close, and the split that corrected it."""
    method, system, t, q, v = arguments
    linear = linear_system(system, t, on_manifold(system.topology, q))
    split = method.split(linear)
    linear = _corrected_position(method, system, t, linear, split, True)
    v = method.correct_velocity(linear, split, v, refinements=2)
    return linear.configuration.q, v, split


@correct.def_jvp
def _correct_jvp(primals, tangents):
    (arguments,), (tangents,) = primals, tangents
    method, system, t, _, _ = arguments
    q, v, split = correct(arguments)
    state = _state_tangent(method, linear_system(system, t, q), v, split, tangents[1:])
    return (q, v, split), (state.to_q, state.to_v, _constant(split))


@eqx.filter_custom_jvp
def close(arguments: Arguments) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"]]:
    """The state on the loops to rounding, with fresh factors, close to a singular configuration as a limit."""
    method, system, t, q, v = arguments
    (q, v), _ = _limit(_closed_at, (0, 1), method, system, t, q, v)
    return on_manifold(system.topology, q), v


@close.def_jvp
def _close_jvp(primals, tangents):
    (arguments,), (tangents,) = primals, tangents
    method, system, t, _, _ = arguments
    q, v = close(arguments)
    # Apart from their structure: that of a system says what is known of its numbers, and not of their tangents.
    return (q, v), _closed_tangent((method, system, t, q, v), *jax.tree.flatten(tangents[1:]))


@jit_inline
def _closed_tangent(arguments, tangents, structure):
    method, system, t, q, v = arguments
    linear = linear_system(system, t, q)
    state = _state_tangent(method, linear, v, method.split(linear), jax.tree.unflatten(structure, tangents))
    return state.to_q, state.to_v


def approach(
    method: Any, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> tuple[Float[Array, " n_q"], Float[Array, " n_v"], Float[Array, ""]]:
    """Newton steps on q until the loops close to rounding or stop closing further, then v: (q, v, d)."""
    small = ROUNDING_ULPS * jnp.finfo(q.dtype).eps

    def improve(state, before):
        return _improved((method, system, t, state[0], v), before, small)

    begin = on_manifold(system.topology, q), v, jnp.ones((), q.dtype)
    return while_falling(improve, begin, MOST_CORRECTIONS, small, q.dtype)


@jit_inline
def _improved(arguments, before, small):
    """The state after a Newton step from q, as long as gaps fall, and the gap at q."""
    method, system, t, q, v = arguments
    linear = linear_system(system, t, q)
    split = method.split(linear)
    gap = widest(linear.configuration)
    done = (gap <= small) | (gap >= before)
    q = jnp.where(done, q, method.correct_position(linear, split, linear.configuration))
    return (q, method.correct_velocity(linear, split, v, refinements=1), split.distance), gap


def ranks_along(
    method: Any,
    system: System,
    t: ScalarLike,
    q: Float[Array, " n_q"],
    v: Float[Array, " n_v"],
    rank: Int[Array, " n_islands"],
) -> Int[Array, " k"]:
    """Predict the ranks of J along the motion from q with speeds v: of each front, or of each island without fronts.

    `rank`: of each island. Ranks of fronts show at states a little farther on; where they do not add up to it there,
    a front has as many independent rows as the tolerance says.
    """
    plan = system.structure.elimination
    if plan is None:
        return rank
    duration = ratio(1.0, system.fastest(v), 0.0)

    def found(share):
        later = t + share * duration if is_driven(system) else t
        near = retract(system.topology, q, share * duration * v)
        closed, _, _ = approach(method, system, later, near, v)
        return method.split(linear_system(system, later, closed)).rank

    ranks = jnp.max(lax.map(found, jnp.asarray(ALONG, q.dtype)), axis=0)
    adds_up = jnp.all(system.structure.ranks_of_islands(ranks) == rank)
    return jnp.where(adds_up, ranks, plan.most_independent)


def limit_of_acceleration(
    method: Any, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> Float[Array, " n_v"]:
    """v̇ at a state on the loops, close to a singular configuration as a limit along the motion."""
    (_, acceleration), _ = _limit(_acceleration_at, (0, 2), method, system, t, q, v)
    return acceleration


def limit_of_multipliers(
    method: Any, system: System, t: ScalarLike, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
) -> Float[Array, " m"]:
    """λ of minimum norm at a state on the loops, close to a singular configuration as a limit along the motion."""
    (_, per_inertia), _ = _limit(_multipliers_at, (0, 2), method, system, t, q, v)
    return per_inertia * _inertia(system)


def _corrected_position(method, system, t, linear, split, correct):
    """The linear system after the method's number of corrections of q, all with the same factors."""
    first = linear
    for _ in range(method.corrections):
        q = method.correct_position(first, split, linear.configuration, correct)
        linear = linear_system(system, t, q)
    return linear


def _state_tangent(method, linear, v, split, tangents):
    """How the state on the loops here changes with a system's numbers, time, and a state near it."""
    onto = None if split is None else lambda rows: method.least_change(linear, split, rows, refinements=2)
    system, t, q = (getattr(linear.configuration, name) for name in ("system", "t", "q"))
    return state_tangent(onto, system, t, q, v, Tangents(*tangents))


def _constant(tree):
    """The tangent of what does not change."""
    return jax.tree.map(lambda _: None, tree)


def _limit(function, powers, method, system, t, q, v):
    """Evaluate a function of ((method, system, v), t, q), near a singular configuration as a limit along v."""
    step = lambda q, change: retract(system.topology, q, change)
    direction = Direction(t, q, v, system.fastest(v), step, is_driven(system))
    return singular_limit(function, powers, (method, system, v), direction)


@jit_inline
def _acceleration_at(arguments, t, q) -> Value:
    found, gap = _evaluate_near(arguments, t, q)
    return Value((found.q, found.acceleration), found.split.distance, gap)


@jit_inline
def _multipliers_at(arguments, t, q) -> Value:
    method, system, v = arguments
    found, gap = _evaluate_near(arguments, t, q)
    rows, rank = linear_system(system, t, found.q).jacobian, jnp.sum(found.split.rank)
    least = least_multipliers(rows, found.multipliers, system.scales, method.tolerance, rank)
    undefined = (found.split.distance < method.tolerance) & jnp.any(v != 0.0)
    per_inertia = jnp.where(undefined, jnp.nan, least.multipliers / _inertia(system))
    return Value((found.q, per_inertia), found.split.distance, gap)


def _evaluate_near(arguments, t, q) -> tuple[Evaluated, Float[Array, ""]]:
    """The evaluation on the loops, and how far q is from them: a correction of rounding alone would be amplified."""
    method, system, v = arguments
    gap = _gap(system, t, q)
    return evaluate((method, system, t, q, v), gap > ROUNDING_ULPS * jnp.finfo(q.dtype).eps), gap


@jit_inline
def _closed_at(arguments, t, q) -> Value:
    method, system, v = arguments
    gap = _gap(system, t, q)
    q, v, distance = approach(method, system, t, q, v)
    return Value((q, v), distance, gap)


def _gap(system, t, q):
    return widest(configure(system, t, q))


def _inertia(system):
    """Of the magnitude of the mechanism's [kg m²]: multipliers over it are of that of accelerations."""
    found = jnp.sum(system.mass) * system.length**2 + largest(system.inertia)
    if system.joint_inertia is not None:
        found = found + largest(system.joint_inertia * system.scales**2)
    return lax.stop_gradient(positive_or_one(found))
