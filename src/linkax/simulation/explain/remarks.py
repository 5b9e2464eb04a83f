"""Remarks on a run that ended well, see `linkax.REMARKS`, and their causes with the elements to blame."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from linkax.equations.configuration import along_speeds, configure
from linkax.equations.coordinates import retract
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.linalg.spectral_radius import spectral_radius
from linkax.linalg.triangular import cholesky_inverse
from linkax.model.forces.internal_states import shapes_of, size_of
from linkax.simulation.explain.diagnosis import lost_inertia
from linkax.simulation.integrate.results import ENDED_WELL, REMARKS, RESULTS, Solution
from linkax.simulation.integrate.rosenbrock import Rodas5P
from linkax.xla.enumerations import code, item
from linkax.xla.tracing import all_concrete
from scalarjit import scalarised

UNSEEN = 10.0  # tolerances: rounding of accelerations that adds little to the errors of steps
UNSEEN_ULPS = 1e5
TO_BLAME = 100.0  # times the definiteness of the mass matrix: share of an inertia that explains it
LINGERS = 3e-5  # mean distance from a singular configuration of a motion that does not leave it
STAYS_ULPS = 8.0  # the same of what stands still in it
# Distance from a singular configuration that branches are told apart from in single precision: stages of steps at
# rtol = 1e-4 come as close as 0.04 to one that they pass.
PASSES = 5e-2
MANY_STEPS = 1000
SHORT = 3e-2  # what the motion turns, or moves in lengths of the mechanism, in a mean step that it does not choose
FAST = 0.5  # rate of an element that chooses the steps, times their mean length
RESOLVED = 5.0  # the same, below which an explicit solver takes about as many steps: Dopri8's reach 2 to 4
UNSTABLE = 2.0  # the same, from which stability bounds Dopri8's steps, and below which their errors do
SETTLES = 100.0  # decay of damped waves over a run, which rests for most of it
LOOSE = 1e-5  # tolerance that waves are far below


def remark(solution: Solution) -> Any:
    """The first of `REMARKS` that applies to a run that ended well, or to each of a batch."""
    known, found = _known(solution), np.zeros(solution.t_end.shape, np.int32)
    numeric = np if known is np.asarray else jnp
    if solution.run.is_integrated:
        well = numeric.isin(known(code(solution.result)), _WELL)
        for name, (applies, _) in reversed(_FINDINGS.items()):
            found = numeric.where(well & applies(solution, known), code(getattr(REMARKS, name)), found)
    # An entry of an array of NumPy would be none of an enumeration.
    return item(jnp.asarray(found, jnp.int32) if found.shape else found, REMARKS)


def in_words(solution: Solution, *names: str) -> str:
    """Explain the first of these `REMARKS` that applies to a run, ended well or not, with numbers and elements; or
    nothing.
    """
    for applies, tell in (_FINDINGS[name] for name in names):
        if applies(solution, np.asarray):
            return tell(solution)
    return ""


def _known(solution):
    """The function that makes numbers of a run NumPy arrays, which compile nothing, or of traced ones JAX arrays."""
    found = solution.t_end, solution.v, solution.stats, solution.result, solution.average, solution.definiteness
    return np.asarray if all_concrete(found) else jnp.asarray


def _loses_accuracy(solution, known):
    """Whether rounding keeps accelerations from the tolerance."""
    definiteness, eps = known(solution.definiteness), jnp.finfo(solution.definiteness.dtype).eps
    seen = UNSEEN_ULPS * definiteness < 1.0
    if known is np.asarray and not np.any(seen):
        return seen
    return seen & (eps > UNSEEN * definiteness * known(_rtol(solution)))


def _rtol(solution):
    rtol, _ = solution.run.control.tolerances((solution.accuracy.rtol, None))
    return rtol


def _lost_accuracy(solution):
    definiteness, rtol = float(solution.definiteness), float(_rtol(solution))
    system = system_of(solution.mechanism, solution.definiteness.dtype)
    why = lost_inertia(system, below=TO_BLAME * definiteness)
    many = " Some bodies carry others far larger, or very many; ask for a larger rtol."
    rounding = jnp.finfo(system.dtype).eps / definiteness
    off = f" Rounding alone puts accelerations off by {rounding:.0e} of their size, and rtol is {rtol:.0e}."
    return off + (why or many)


def _passes(solution, known):
    """Whether branches cross closer than single precision tells them apart."""
    closest = known(solution.closest)
    return (closest < PASSES) & (jnp.finfo(closest.dtype).bits < 64)


def _passed(solution):
    return (
        f" The motion passes a singular configuration, where branches of motion cross, at a distance of "
        f"{float(solution.closest):.0e}: rounding of single precision may move it to another; compare with double "
        "precision."
    )


def _lingers(solution, known):
    """Whether rounding may confuse the branches that the motion is close to all the time."""
    average = known(solution.average)
    return (average > STAYS_ULPS * jnp.finfo(average.dtype).eps) & (average < LINGERS)


def _lingered(solution):
    return (
        f" The motion does not leave a singular configuration, where branches of motion cross, by more than about "
        f"{float(solution.average):.0e}: rounding may move it from one to another, which puts it off by more than that."
    )


def _is_stiff(solution, known):
    """Whether the rate of an element, and not the motion, chooses the steps; computed only where steps are many."""
    never = np.zeros(solution.t_end.shape, bool)
    suspect = known(solution.stats["num_steps"]) >= MANY_STEPS
    if solution.v is None or not solution.mechanism.forces or (known is np.asarray and not np.any(suspect)):
        return never
    if not solution.run.control.is_adaptive:
        return never
    step = known(_mean_step(solution))
    suspect = suspect & (known(_mean_speed(solution)) * step < SHORT)
    if known is np.asarray and not np.any(suspect):
        return never
    rates, damping = map(known, _rates(*_ends(solution)))
    turned = rates.max(axis=-1) * step
    if _is_implicit(solution):
        suspect = suspect & (turned < RESOLVED) & ~_suits_implicit(solution, known, damping)
    return suspect & (turned > FAST)


def _suits_implicit(solution, known, damping):
    """Whether an implicit solver may step over fast waves. The solver of the run has no part in it: of two runs that
    differ in it, at most one advises the other's.
    """
    decay = damping / 2.0 * known(solution.run.t1 - solution.run.t0)
    return (known(_rtol(solution)) >= LOOSE) | (decay > SETTLES)


def _is_implicit(solution):
    return isinstance(solution.run.options.solver, diffrax.AbstractImplicitSolver | Rodas5P)


def _stiff(solution):
    (rates, damping), step = map(np.asarray, _rates(*_ends(solution))), float(_mean_step(solution))
    fastest = int(np.argmax(rates))
    suits_implicit = _suits_implicit(solution, np.asarray, damping)
    element = solution.mechanism.forces[fastest]
    other = "a force without its internal states" if element.states else "a rigid joint or constraint"
    if element.has_switch:  # it comes and goes, which no constraint does
        other = "one with less stiffness and damping, or for a stop a linkax.Impact,"
    advice = f"take {other} in its place"
    if _is_implicit(solution) and not suits_implicit:
        advice = "solver=diffrax.Dopri8() takes about as many, each much cheaper"
    elif not _is_implicit(solution) and suits_implicit and rates[fastest] * step > UNSTABLE:
        advice = (
            "take solver=linkax.Rodas5P(), which steps over it where it has come to rest or the tolerance is loose, or "
            f"{other} in its place"
        )
    return (
        f" {element.display_name}, whose fastest rate is {rates[fastest]:.1e} 1/s, and not "
        f"the motion, chooses the {int(solution.stats['num_steps'])} steps, {step:.1e} s each; {advice}."
    )


_WELL = np.array([code(getattr(RESULTS, name)) for name in ENDED_WELL])
# Of each of `REMARKS`, the first to be told first: whether it applies, and what there is to say.
_FINDINGS = {
    "rounding": (_loses_accuracy, _lost_accuracy),
    "single_precision": (_passes, _passed),
    "lingers": (_lingers, _lingered),
    "stiff": (_is_stiff, _stiff),
}


def _mean_step(solution):
    return (solution.t_end - solution.run.t0) / jnp.maximum(solution.stats["num_steps"], 1)


def _mean_speed(solution):
    """Mean speed of the fastest joint over saved times; NaN where none was reached."""
    scales = _per_member(_scales, *_ends(solution))
    turns, reached = (
        jnp.max(jnp.abs(solution.v / scales[..., None, :]), axis=-1, initial=0.0),
        jnp.isfinite(solution.ts),
    )
    return jnp.sum(jnp.where(reached, turns, 0.0), axis=-1) / jnp.sum(reached, axis=-1)


def _ends(solution):
    return solution.mechanism, solution.run.tangent_space, solution.t_end, solution.end


def _per_member(function, mechanism, tangent_space, t, state):
    """Map a function of the end of a run over the members of a batch."""
    for _ in range(t.ndim):
        function = eqx.filter_vmap(function)
    return function(mechanism, tangent_space, t, state)


def _scales(mechanism, tangent_space, t, state):
    return system_of(mechanism, state.q.dtype).scales


@scalarised
def _rates(mechanism, tangent_space, t, state):
    """The fastest rate of each force element [1/s], (..., n), √(k / m), c / m or that of its internal states; and the
    largest c / m, or rate at which such states settle by themselves, (...).
    """
    return _per_member(_rates_of_elements, mechanism, tangent_space, t, state)


def _rates_of_elements(mechanism, tangent_space, t, state):
    gram, *matrices, whole = _elements(mechanism, tangent_space, t, state)
    stays = jnp.diagonal(gram) <= 0.0
    to_speeds, _ = cholesky_inverse(gram + jnp.diag(stays.astype(gram.dtype)))
    largest = lambda of: spectral_radius(to_speeds @ of @ to_speeds.T)
    stiffness, damping = map(largest, matrices)
    rates = jnp.maximum(jnp.sqrt(stiffness), damping)
    if whole is None:
        return rates, jnp.max(damping)
    of_states, settling = whole(to_speeds @ to_speeds.T)
    return jnp.maximum(rates, of_states), jnp.maximum(jnp.max(damping), jnp.max(settling))


def _elements(mechanism, tangent_space, t, state):
    """Mass matrix on the tangent space, and stiffness and damping of each force element there, (n, n_v, n_v); and what
    internal states add, see `_with_states`, None without any.
    """
    system = bound(system_of(mechanism, state.q.dtype), state.internal)
    found = tangent_space.prepared(system.dtype).at_rest(system, t, state.q)
    basis, still = found.split.inverse.basis, jnp.zeros_like(state.v)

    def moved(change, faster, internal):
        place = retract(system.topology, state.q, basis @ change)
        return move(configure(bound(system, internal), t, place), state.v + basis @ faster)

    def forces(change, faster, internal=state.internal):
        motion = moved(change, faster, internal)
        loads = [force.applied(t, motion) for force in motion.system.forces]
        along = lambda load: load.joint_force + along_speeds(motion.configuration, load.force, load.moment)
        return jnp.stack([along(load) @ basis for load in loads])

    gram = basis.T @ found.mass @ basis
    if state.internal is None:
        return gram, *jax.jacfwd(forces, (0, 1))(still, still), None
    rates = lambda *changes: internal_rates(moved(*changes))
    of_forces, of_rates = (jax.jacfwd(of, (0, 1, 2))(still, still, state.internal) for of in (forces, rates))
    counts = [size_of(shapes_of(force.states)) for force in mechanism.forces]
    owns = np.repeat(np.arange(len(counts)), counts) == np.arange(len(counts))[:, None]
    return gram, *of_forces[:2], functools.partial(_with_states, of_forces, of_rates, owns)


def _with_states(of_forces, of_rates, owns, inverse_mass):
    """The fastest rate of each force element with its internal states, and that of the states alone, (n,) each.

    **Arguments:** derivatives of forces, (n, n_v, …), and rates, (n_s, …), by coordinates, speeds and states; which
    states each element `owns`, (n, n_s); the inverse of the mass matrix.
    """
    own = jnp.asarray(owns, inverse_mass.dtype)
    stiffness, damping, by_states = (inverse_mass @ part for part in of_forces)
    by_states = by_states * own[:, None, :]
    by_q, by_v, alone = (part * own[:, :, None] for part in of_rates)
    alone = alone * own[:, None, :]
    speeds = jnp.broadcast_to(jnp.eye(len(inverse_mass), dtype=own.dtype), damping.shape)
    rows = [
        [jnp.zeros_like(damping), speeds, jnp.zeros_like(by_states)],
        [stiffness, damping, by_states],
        [by_q, by_v, alone],
    ]
    return spectral_radius(jnp.block(rows)), spectral_radius(alone)
