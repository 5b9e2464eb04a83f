"""Why a run failed: the elements to blame, looked for after the run."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import configure
from linkax.equations.constraint_rows import constraint_gamma, constraint_rate, constraint_residual
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import mass_matrix
from linkax.equations.gaps import gaps
from linkax.equations.internal_states import bound
from linkax.equations.loops import jacobian, widest
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.classical import ClassicalFormulation
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.saddle_inverse import invert
from linkax.model.mechanism import Mechanism
from linkax.simulation.integrate.impacts import impacts_of
from linkax.simulation.integrate.results import RESULTS, Solution
from linkax.simulation.start.initial_state import MOVES, moving_joints
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio

AHEAD = 10.0 ** np.arange(-14, 0)  # of the time of the run: how far ahead of its end a cause is looked for
OPEN_ULPS = 1e3  # that loops are open where constraints contradict each other
LOST = 1e-9  # of an inertia: what is below leaves too few digits of double precision
# Shares of coordinates and speeds over which a load changes by the same where it jumps, and of itself by so much.
JUMPS = 1e-6, 1e-7
SEEN = 1e-3
NULL = 1e-10  # eigenvalue of a mass matrix of ones


def cause(solution: Solution) -> str:
    """Name the elements at fault in a sentence; an empty string where none is found.

    **Arguments:** `solution`: of a run that failed.
    """
    state = solution.run.state
    system = system_of(solution.mechanism, state.q.dtype)
    method = solution.run.tangent_space.prepared(state.q.dtype)
    result, t = solution.result, solution.t_end
    if result == RESULTS.not_finite:
        return _not_finite(solution.mechanism) or _forces(solution, system, t, state) or _laws(system, t, state)
    if result == RESULTS.not_closed:
        return _open(system, solution.mechanism, t, method.close(system, t, state.q, state.v)[0])
    if result == RESULTS.massless:
        found = massless_bodies(system, method, t, state.q)
        return f" They are {_listed(found)}." if found else lost_inertia(system)
    if (result == RESULTS.no_branch) | (result == RESULTS.not_unique):
        basis = ConstraintSplit.at(system, t, state.q, method.tolerance).inverse.basis
        return f" The branches cross in the motion of joints {_listed(moving_joints(system, t, state.q, basis))}."
    if result == RESULTS.driven_into_stop:
        return _driven_into(solution, system, t)
    return (
        _no_acceleration(solution, system, method, t)
        or _exhausted(solution, system, t)
        or _jumps(solution, system, t)
        or _drives(solution, system, t)
        or _ahead(solution, system, t)
        or _contradiction(solution, system, t)
        or lost_inertia(system)
    )


def _listed(names):
    return ", ".join(map(repr, names)) or "none"


def _not_finite(mechanism):
    for path, leaf in jax.tree_util.tree_flatten_with_path(mechanism)[0]:
        if eqx.is_inexact_array(leaf) and not np.all(np.isfinite(leaf)):
            place, which, *rest = path
            owner = getattr(getattr(mechanism, place.name)[which.idx], "name", type(leaf).__name__)
            return f" {owner!r}{jax.tree_util.keystr(tuple(rest))} is {np.asarray(leaf).tolist()}."
    return ""


def _forces(solution, system, t, state):
    """Name a force element whose load is not finite, or a rate of whose internal states."""
    motion = move(configure(bound(system, state.internal), jnp.asarray(t), state.q), state.v)
    for force in motion.system.forces:
        load = force.applied(jnp.asarray(t), motion)
        if not all(bool(jnp.all(jnp.isfinite(part))) for part in load):
            return f" The load of {force.display_name} is not finite at t = {float(t):.6g} s."
        if not bool(jnp.all(jnp.isfinite(force.state_rates(jnp.asarray(t), motion)))):
            return f" A rate of the internal states of {force.display_name} is not finite at t = {float(t):.6g} s."
    return ""


def _laws(system, t, state):
    """Name a constraint whose residual, or one of its first two derivatives, is not finite."""
    if not system.constraints:
        return ""
    motion = move(configure(system, jnp.asarray(t), state.q), state.v)
    at = motion.configuration
    rows = np.sum([constraint_residual(at), constraint_rate(at), constraint_gamma(motion, 1.0)], axis=0)
    for row in np.flatnonzero(~np.isfinite(rows)):
        name = system.constraints[system.topology.constraint_of_row[row]].display_name
        return f" The function of {name}, or a derivative of it, is not finite at t = {float(t):.6g} s."
    return ""


def _ahead(solution, system, t):
    """Name such a force element a little after the end of the run, where its last step failed."""
    for ahead in AHEAD * float(jnp.max(jnp.abs(t)) + 1.0):
        if found := _forces(solution, system, t + ahead, solution.end):
            return found
    return ""


def _no_acceleration(solution, system, method, t):
    """Say why a classical formulation finds no acceleration where the run ends."""
    if not isinstance(solution.formulation, ClassicalFormulation):
        return ""
    end = solution.end
    acceleration = solution.formulation.dynamics(bound(system, end.internal), t, end.q, end.v).acceleration
    if np.all(np.isfinite(acceleration)):
        return ""
    rank, rows = int(np.sum(method.constraint_split(system, t, end.q).inverse.rank)), system.topology.num_rows
    mass = "the mass matrix of the tree is singular"
    why = f"{rank} of the {rows} loop rows are independent" if rank < rows else mass
    return f" The formulation finds no finite acceleration there: {why}. The default formulation needs neither."


def _exhausted(solution, system, t):
    """Say which force element lets no motion lead on from where the run ends."""
    configuration = configure(system, t, solution.end.q)
    told = [said for force in solution.mechanism.forces if (said := force.exhausted(configuration))]
    return f" {told[0]}" if told else ""


def _jumps(solution, system, t):
    """Name a force element whose load jumps where the run ends: it may push back from both sides."""
    end, begin = solution.end, solution.run.state
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (2, system.topology.num_speeds))
    speed = jnp.maximum(system.fastest(end.v), system.fastest(begin.v))

    def loads(change):
        """Of all force elements a little ahead in a direction where any coordinate and speed may rise or fall."""
        q = retract(system.topology, end.q, change * signs[0] * system.scales)
        at = configure(bound(system, end.internal), jnp.asarray(t), q)
        motion = move(at, end.v + change * speed * signs[1] * system.scales)
        of = lambda force: jnp.concatenate([*map(jnp.ravel, force.applied(jnp.asarray(t), motion))])
        return jnp.stack([of(force) for force in motion.system.forces])

    if not system.forces or not bool(jnp.all(jnp.isfinite(end.q)) & jnp.all(jnp.isfinite(end.v))):
        return ""
    apart = lambda change: np.max(np.abs(loads(change) - loads(-change)), axis=1, initial=0.0)
    wide, narrow = map(apart, JUMPS)
    sizes = np.max(np.abs(loads(JUMPS[0])), axis=1, initial=0.0)
    jumping = np.flatnonzero((narrow > wide / 2.0) & (narrow > SEEN * sizes))
    if not len(jumping):
        return ""
    name = solution.mechanism.forces[jumping[0]].display_name
    return (
        f" The load of {name} jumps there, by {narrow[jumping[0]]:.3g}; where it pushes back from both sides no step "
        "leads on. Let it change over a small speed or distance, as linkax.JointFriction does."
    )


def _named_drives(mechanism):
    """The drives of a mechanism, each with its joints."""
    drives = [constraint for constraint in mechanism.constraints if constraint.is_driven]
    each = [f"{drive.display_name}{''.join(f' of joint {joint!r}' for joint in drive.joints)}" for drive in drives]
    return f"The {' and the '.join(each)}" if drives else ""


def _driven_into(solution, system, t):
    """Name the stop that drives lead into where the run ends, and the drives."""
    q = solution.end.q
    gaps_of = [abs(float(impact.gap(configure(system, t, q)))) for impact in impacts_of(system)]
    stop = impacts_of(solution.mechanism)[int(np.argmin(gaps_of))].display_name
    return f" {_named_drives(solution.mechanism)} leads into {stop} at t = {float(t):.6g} s."


def _drives(solution, system, t):
    """Name drives that ask for what the loops do not allow just after the end of the run."""
    drives = _named_drives(solution.mechanism)
    told = f" {drives} asks for what the loops do not allow after t = {float(t):.6g} s."
    if solution.result == RESULTS.locked:
        return told
    method, end = solution.run.tangent_space.prepared(system.dtype, solution.rank_nearby), solution.end
    small = jnp.sqrt(jnp.finfo(system.dtype).eps)
    for ahead in AHEAD * float(jnp.abs(t) + 1.0) if drives else ():
        q, _ = method.close(system, t + ahead, end.q, end.v)
        if not float(widest(configure(system, t + ahead, q))) < small:
            return told
    return ""


def _contradiction(solution, system, t):
    """Name loops that stay open by more than rounding where a step failed."""
    end = solution.end
    if solution.result != RESULTS.dt_min_reached or not system.topology.num_rows or not np.all(np.isfinite(end.q)):
        return ""
    name, size = widest_gap(system, solution.mechanism, t, end.q)
    if size <= OPEN_ULPS * jnp.finfo(system.dtype).eps:
        return ""
    return (
        f" Joint {name!r} stays open by {size:.3g}, in radians or lengths of the mechanism: constraints that are "
        "nearly redundant contradict each other by so much. Correct lengths and axes, or ask for a tolerance (rtol) "
        "above it."
    )


def _open(system, mechanism, t, q):
    """Name the joint or constraint that is open widest."""
    name, size = widest_gap(system, mechanism, t, q)
    return f" Joint {name!r} is open by {size:.3g}, in radians or lengths of the mechanism."


def widest_gap(system: System, mechanism: Mechanism, t: Scalar, q: Float[Array, " n_q"]) -> tuple[str, float]:
    """The joint or constraint that is open widest, and by how much, in radians or lengths of the mechanism."""
    gap, topology = gaps(configure(system, t, q)).in_scales(system), mechanism.topology
    names = [*topology.joints[topology.num_bodies :], *(topology.constraints[c] for c in topology.constraint_of_row)]
    sizes = np.concatenate([np.maximum(gap.distance, gap.angle), gap.constraints])
    widest = int(np.argmax(sizes))
    return names[widest], float(sizes[widest])


def lost_inertia(system: System, below: float = LOST) -> str:
    """Name a body whose inertia about its joint rounding loses, next to that of a body it carries far out."""
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


def massless_bodies(system: System, method: TangentSpace, t: Scalar, q: Float[Array, " n_q"]) -> list[str]:
    """Names of bodies that can move without moving any mass; magnitudes do not matter, so all masses are set to one."""
    moment = jnp.max(jnp.abs(system.inertia), axis=(1, 2))
    inertia = ratio(system.inertia, moment[:, None, None], 0.0) * system.length**2
    along = system.joint_inertia
    if along is not None:
        along = ratio(along, along, 0.0) * (system.length / system.scales) ** 2
    equal = dataclasses.replace(system, mass=ratio(system.mass, system.mass, 0.0), inertia=inertia, joint_inertia=along)
    configuration = configure(equal, t, q)
    basis = invert(None, jacobian(configuration), system.scales, method.tolerance).basis
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
