"""Why a simulation failed, or is not to be relied upon: the elements to blame, found after the run."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from linkax.equations.configuration import along_speeds, configure
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import mass_matrix
from linkax.equations.loops import gaps, jacobian, residual
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.formulations.branches import Crossing
from linkax.formulations.classical import ClassicalFormulation
from linkax.linalg.constrained_solve import invert
from linkax.linalg.spectral_radius import spectral_radius
from linkax.linalg.triangular import cholesky_inverse
from linkax.model.constraints import Drive
from linkax.simulation.outset import MOVES, moving_joints
from linkax.simulation.results import ENDED_WELL, REMARKS, RESULTS
from linkax.tracing import all_known, runs_once

AHEAD = 10.0 ** np.arange(-14, 0)  # of the time of the run: how far ahead of its end a cause is looked for
OPEN_ULPS = 1e3  # that loops are open where constraints contradict each other
LOST = 1e-9  # of an inertia: what is below leaves too few digits of double precision
UNSEEN = 10.0  # tolerances: rounding of accelerations that adds little to the errors of steps
UNSEEN_ULPS = 1e5
TO_BLAME = 100.0  # times the definiteness of the mass matrix: share of an inertia that explains it
LINGERS = 3e-5  # mean distance from a singular configuration of a motion that does not leave it
STAYS_ULPS = 8.0  # the same of what stands still in it
PASSES = 3e-2  # distance from a singular configuration that branches are told apart from in single precision
MANY_STEPS = 1000
SHORT = 3e-2  # what the motion turns, or moves in lengths of the mechanism, in a mean step that it does not choose
FAST = 0.5  # rate of an element that chooses the steps, times their mean length
RESOLVED = 5.0  # the same, below which an explicit solver takes about as many steps: Dopri8's reach 2 to 3
NULL = 1e-10  # eigenvalue of a mass matrix of ones


def cause(solution, state) -> str:
    """A sentence that names the elements at fault, or nothing where none is found.

    **Arguments:** a failed `Solution`, and the `State` that it was to start from.
    """
    system = system_of(solution.mechanism, state.q.dtype)
    method = solution.accuracy.method(state.q.dtype)
    result, t = solution.result, solution.t_end
    if result == RESULTS.not_finite:
        return _not_finite(solution.mechanism) or _forces(solution, system, t, state) or _laws(solution.mechanism, t)
    if result == RESULTS.not_closed:
        return _open(system, solution.mechanism, t, method.close(system, t, state.q, state.v)[0])
    if result == RESULTS.massless:
        found = massless_bodies(system, method, t, state.q)
        return f" They are {_listed(found)}." if found else _lost_inertia(system)
    if (result == RESULTS.no_branch) | (result == RESULTS.not_unique):
        basis = Crossing.at(system, t, state.q, method.rank_tolerance).inverse.basis
        return f" The branches cross in the motion of joints {_listed(moving_joints(system, t, state.q, basis))}."
    return (
        _no_acceleration(solution, system, method, t)
        or _drives(solution, system, t)
        or _ahead(solution, system, t)
        or _contradiction(solution, system, t)
        or _lost_inertia(system)
    )


def _listed(names):
    return ", ".join(map(repr, names)) or "none"


def _not_finite(mechanism):
    for path, leaf in jax.tree_util.tree_flatten_with_path(mechanism)[0]:
        if eqx.is_inexact_array(leaf) and not np.all(np.isfinite(leaf)):
            place, which, *rest = path
            owner = getattr(getattr(mechanism, place.name)[which.idx], "name", type(leaf).__name__)
            return f" {owner!r}{jax.tree_util.keystr(rest)} is {np.asarray(leaf).tolist()}."
    return ""


def _forces(solution, system, t, state):
    """Force elements whose load is not finite."""
    motion = move(configure(system, jnp.asarray(t), state.q), state.v)
    for force in solution.mechanism.forces:
        load = force.applied(jnp.asarray(t), motion)
        if not all(bool(jnp.all(jnp.isfinite(part))) for part in load):
            return f" The load of {force.described} is not finite at t = {float(t):.6g} s."
    return ""


def _laws(mechanism, t):
    """Constraints whose function of time, or its first two derivatives, is not finite."""
    for constraint in mechanism.constraints:
        rate = jax.jacfwd(constraint.right_side)
        if not all(bool(jnp.isfinite(law(t))) for law in (constraint.right_side, rate, jax.jacfwd(rate))):
            when = f"at t = {float(t):.6g} s"
            return f" The function of {constraint.described}, or a derivative of it, is not finite {when}."
    return ""


def _ahead(solution, system, t):
    """The same a little after the end of the run, where its last step failed."""
    for ahead in AHEAD * float(jnp.max(jnp.abs(t)) + 1.0):
        if found := _forces(solution, system, t + ahead, solution.end):
            return found
    return ""


def _no_acceleration(solution, system, method, t):
    """A classical formulation that finds no acceleration where the run ends."""
    if not isinstance(solution.formulation, ClassicalFormulation):
        return ""
    end = solution.end
    acceleration = solution.formulation.dynamics(system, t, end.q, end.v).acceleration
    if np.all(np.isfinite(acceleration)):
        return ""
    rank, rows = int(np.sum(method.crossing(system, t, end.q).inverse.rank)), system.topology.num_rows
    mass = "the mass matrix of the tree is singular"
    why = f"{rank} of the {rows} loop rows are independent" if rank < rows else mass
    return f" The formulation finds no finite acceleration there: {why}. The default formulation needs neither."


def _drives(solution, system, t):
    """Drives that ask for what the loops do not allow just after the end of the run."""
    drives = [constraint for constraint in solution.mechanism.constraints if isinstance(constraint, Drive)]
    method, end = solution.accuracy.method(system.dtype, solution.rank_nearby), solution.end
    small = jnp.sqrt(jnp.finfo(system.dtype).eps)
    for ahead in AHEAD * float(jnp.abs(t) + 1.0) if drives else ():
        q, _ = method.close(system, t + ahead, end.q, end.v)
        if not float(jnp.max(jnp.abs(residual(configure(system, t + ahead, q))))) < small:
            asked = [f"{drive.described} of joint {drive.joints[0]!r}" for drive in drives]
            return f" The {' and the '.join(asked)} asks for what the loops do not allow after t = {float(t):.6g} s."
    return ""


def _contradiction(solution, system, t):
    """Loops that stay open where a step failed, by more than rounding."""
    end = solution.end
    if solution.result != RESULTS.dt_min_reached or not system.topology.num_rows or not np.all(np.isfinite(end.q)):
        return ""
    name, size = _widest(system, solution.mechanism, t, end.q)
    if size <= OPEN_ULPS * jnp.finfo(system.dtype).eps:
        return ""
    return (
        f" Joint {name!r} stays open by {size:.3g}, in radians or lengths of the mechanism: constraints that are "
        "nearly redundant contradict each other by so much. Correct lengths and axes, or ask for a tolerance (rtol) "
        "above it."
    )


def _open(system, mechanism, t, q):
    """Where the loops are open."""
    name, size = _widest(system, mechanism, t, q)
    return f" Joint {name!r} is open by {size:.3g}, in radians or lengths of the mechanism."


def _widest(system, mechanism, t, q):
    """The joint or constraint at which the loops are widest open, and by how much."""
    gap, topology = gaps(configure(system, t, q)), mechanism.topology
    names = [*topology.joints[topology.num_bodies :], *topology.constraints]
    sizes = np.concatenate(
        [np.maximum(gap.distance / system.length, gap.angle), gap.constraints / system.coupling_unit]
    )
    widest = int(np.argmax(sizes))
    return names[widest], float(sizes[widest])


def remark(solution) -> REMARKS:
    """What there is to say of a run that ended well, or of each of a batch: the first of `REMARKS` that applies."""
    known, found = _known(solution), np.zeros(solution.t_end.shape, np.int32)
    numeric = np if known is np.asarray else jnp
    if solution.repeat is not None:  # else it is no run
        well = numeric.isin(known(solution.result._value), _WELL)
        for name, (applies, _) in reversed(_FINDINGS.items()):
            found = numeric.where(well & applies(solution, known), getattr(REMARKS, name)._value, found)
    # An entry of an array of NumPy would be none of an enumeration.
    return type(REMARKS.none)(jnp.asarray(found, jnp.int32) if found.shape else found, REMARKS)


def in_words(solution, *names) -> str:
    """The first of these `REMARKS` that applies to a run, ended well or not, with numbers and elements; or nothing."""
    for applies, tell in map(_FINDINGS.get, names):
        if applies(solution, np.asarray):
            return tell(solution)
    return ""


def _known(solution):
    """Numbers of a run as NumPy's, which compile nothing, unless they are traced."""
    found = solution.t_end, solution.v, solution.stats, solution.result, solution.average, solution.definiteness
    return np.asarray if all_known(found) else jnp.asarray


def _loses_accuracy(solution, known):
    """Whether rounding keeps accelerations from the tolerance."""
    definiteness, eps = known(solution.definiteness), jnp.finfo(solution.definiteness.dtype).eps
    seen = UNSEEN_ULPS * definiteness < 1.0
    if known is np.asarray and not np.any(seen):
        return seen
    return seen & (eps > UNSEEN * definiteness * known(_rtol(solution)))


def _rtol(solution):
    rtol, _ = solution.repeat.control.tolerances((solution.accuracy.rtol, None))
    return rtol


def _lost_accuracy(solution):
    definiteness, rtol = float(solution.definiteness), float(_rtol(solution))
    system = system_of(solution.mechanism, solution.definiteness.dtype)
    why = _lost_inertia(system, below=TO_BLAME * definiteness)
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
    """Whether the rate of an element, and not the motion, chooses the steps; rates are found where steps are many."""
    never = np.zeros(solution.t_end.shape, bool)
    suspect = known(solution.stats["num_steps"]) >= MANY_STEPS
    if solution.v is None or not solution.mechanism.forces or (known is np.asarray and not np.any(suspect)):
        return never
    if not solution.repeat.control.is_adaptive:
        return never
    step = known(_mean_step(solution))
    suspect = suspect & (known(_mean_speed(solution)) * step < SHORT)
    if known is np.asarray and not np.any(suspect):
        return never
    turned = known(jnp.max(_rates(*_ends(solution)), axis=-1)) * step
    is_implicit = isinstance(solution.repeat.solver, diffrax.AbstractImplicitSolver)
    return suspect & (turned > FAST) & (turned < (RESOLVED if is_implicit else np.inf))


def _stiff(solution):
    rates, step = np.asarray(_rates(*_ends(solution))), float(_mean_step(solution))
    fastest = int(np.argmax(rates))
    explicit = "solver=diffrax.Dopri8() takes about as many, each much cheaper"
    rigid = (
        "take a rigid joint or constraint in its place, or, where it has come to rest or the tolerance is loose, "
        "solver=diffrax.Kvaerno5()"
    )
    advice = explicit if isinstance(solution.repeat.solver, diffrax.AbstractImplicitSolver) else rigid
    return (
        f" {solution.mechanism.forces[fastest].described}, whose fastest rate is {rates[fastest]:.1e} 1/s, and not the "
        f"motion, chooses the {int(solution.stats['num_steps'])} steps, {step:.1e} s each; {advice}."
    )


_WELL = np.array([getattr(RESULTS, name)._value for name in ENDED_WELL])
# Of each of `REMARKS`, the first to be told first: whether it applies, and what there is to say.
_FINDINGS = {
    "rounding": (_loses_accuracy, _lost_accuracy),
    "single_precision": (_passes, _passed),
    "lingers": (_lingers, _lingered),
    "stiff": (_is_stiff, _stiff),
}


def _mean_step(solution):
    _, t0 = solution.repeat.start
    return (solution.t_end - t0) / jnp.maximum(solution.stats["num_steps"], 1)


def _mean_speed(solution):
    """Of the fastest joint, over saved times; not a number where none was reached."""
    units = _per_member(_units, *_ends(solution))
    turns, reached = jnp.max(jnp.abs(solution.v / units[..., None, :]), axis=-1, initial=0.0), jnp.isfinite(solution.ts)
    return jnp.sum(jnp.where(reached, turns, 0.0), axis=-1) / jnp.sum(reached, axis=-1)


def _ends(solution):
    return solution.mechanism, solution.accuracy, solution.t_end, solution.end


def _per_member(function, mechanism, accuracy, t, state):
    """Of what is at the end of a run, or of each of a batch."""
    for _ in range(t.ndim):
        function = eqx.filter_vmap(function)
    return function(mechanism, accuracy, t, state)


def _units(mechanism, accuracy, t, state):
    return system_of(mechanism, state.q.dtype).units


@runs_once
def _rates(mechanism, accuracy, t, state):
    """The fastest rate of each force element [1/s], (..., n): √(k / m) or c / m."""
    return _per_member(_rates_of_elements, mechanism, accuracy, t, state)


def _rates_of_elements(mechanism, accuracy, t, state):
    gram, *matrices = _elements(mechanism, accuracy, t, state)
    stays = jnp.diagonal(gram) <= 0.0
    to_speeds, _ = cholesky_inverse(gram + jnp.diag(stays.astype(gram.dtype)))
    largest = lambda of: spectral_radius(to_speeds @ of @ to_speeds.T)
    stiffness, damping = map(largest, matrices)
    return jnp.maximum(jnp.sqrt(stiffness), damping)


def _elements(mechanism, accuracy, t, state):
    """Masses in directions that the loops leave, stiffness and damping there of each force element, (n, n_v, n_v)."""
    system = system_of(mechanism, state.q.dtype)
    found = accuracy.method(system.dtype).departure(system, t, state.q)
    basis, still = found.crossing.inverse.basis, jnp.zeros_like(state.v)

    def forces(change, faster):
        motion = move(configure(system, t, retract(system.topology, state.q, basis @ change)), state.v + basis @ faster)
        loads = [force.applied(t, motion) for force in mechanism.forces]
        along = lambda load: load.joint_force + along_speeds(motion.configuration, load.force, load.moment)
        return jnp.stack([along(load) @ basis for load in loads])

    return basis.T @ found.mass @ basis, *jax.jacfwd(forces, (0, 1))(still, still)


def _lost_inertia(system, below=LOST):
    """A body of which rounding leaves little in the inertia about its joint, next to what it carries far out."""
    topology, carrier = system.topology, np.array(system.topology.predecessor)
    offsets = np.stack([system.parent_offset, system.child_offset], axis=1)[: topology.num_bodies]
    near = np.where(topology.reversed, 1, 0)  # the joint's end on the carrier
    moved = np.arange(topology.num_bodies)
    on_carrier, on_itself = offsets[moved, near], offsets[moved, 1 - near]
    about_joint = lambda place: np.sum((system.center_of_mass - place) ** 2, axis=-1) * system.mass
    inertia = np.max(np.abs(system.inertia), axis=(1, 2)) + about_joint(on_itself)
    # Joints that bend have arms that are no constants.
    straight = np.array([kind.motion is None for kind in topology.joint_types[: topology.num_bodies]])
    carried = np.flatnonzero((carrier >= 0) & (inertia > 0.0) & straight)
    arms = np.sum((on_carrier - on_itself[carrier]) ** 2, axis=-1)
    # What is carried resists the carrier with its mass alone.
    left = (inertia[carrier] + system.mass * arms)[carried] / inertia[carried]
    carried, left = carried[left > 0.0], left[left > 0.0]  # what has no inertia loses none
    if not len(carried) or not np.min(left) < below:
        return ""
    body = carried[np.argmin(left)]
    names = topology.bodies[carrier[body]], topology.bodies[body], topology.joints[body]
    digits = max(0, round(float(np.log10(np.min(left) / jnp.finfo(system.dtype).eps + 1e-300))))
    return (
        f" Rounding leaves {digits} digits of the inertia of body {names[0]!r} next to that of {names[1]!r}, which it "
        f"carries in the tree; in a loop, cut=True on joint {names[2]!r} lets another body carry it."
    )


def massless_bodies(system, method, t, q):
    """Bodies that can move without moving any mass: magnitudes of masses do not matter, so all are one."""
    weigh = lambda numbers, size: jnp.where(size > 0.0, numbers / jnp.where(size > 0.0, size, 1.0), 0.0)
    moment = jnp.max(jnp.abs(system.inertia), axis=(1, 2))
    inertia = weigh(system.inertia, moment[:, None, None]) * system.length**2
    equal = eqx.tree_at(lambda s: (s.mass, s.inertia), system, (weigh(system.mass, system.mass), inertia))
    configuration = configure(equal, t, q)
    basis = invert(None, jacobian(configuration), system.units, method.rank_tolerance).basis
    basis = np.asarray(basis)[:, np.any(np.asarray(basis) != 0.0, axis=0)]
    values, vectors = np.linalg.eigh(basis.T @ np.asarray(mass_matrix(configuration)) @ basis / system.length**2)
    directions = basis @ vectors[:, values < NULL]
    found = []
    for direction in directions.T:
        motion = move(configuration, jnp.asarray(direction))
        speed = np.linalg.norm(motion.angular_velocity[:-1], axis=1)
        speed += np.linalg.norm(motion.velocity[:-1], axis=1) / float(system.length)
        found += [
            name for name, moves in zip(system.topology.bodies, speed > MOVES * np.max(speed), strict=True) if moves
        ]
    return list(dict.fromkeys(found))
