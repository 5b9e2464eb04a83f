"""Consistent states from partial positions and speeds."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, on_manifold
from linkax.equations.gaps import Gap, gaps
from linkax.equations.system import system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.model.constraints import Drive
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number
from linkax.simulation.start.branch_speeds import other_speeds, smallest_speeds, speeds_again, speeds_on_branch
from linkax.simulation.start.closing import CLOSED, LoopClosure, close_loops
from linkax.simulation.start.doubts import doubts
from linkax.simulation.start.initial_state import ON_BRANCH, moving_joints
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import beams_of, rank_tolerance
from linkax.simulation.start.places import Places, called
from linkax.simulation.start.rough_start import given_in_tree, rough_start
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import (
    WorldMotion,
    WorldPlaces,
    check_mechanism,
    checked_time,
    coordinates_by_joint,
    sound_numbers,
    speeds_by_joint,
)
from linkax.straight_line.known import flat_with_known
from linkax.xla.arrays import Array
from linkax.xla.program import Program
from linkax.xla.static_scatter import scatter_static
from linkax.xla.tracing import all_concrete, is_first, jit_inline, without_derivatives
from linkax.xla.users_line import warn
from linkax.xla.waiting import compiling

GUESS = "give another guess, such as guess={body: lx.Pose(position)} with its rough place"


class AssemblyError(ValueError):
    """No positions close the loops of a mechanism with those asked for."""


class AssemblyWarning(UserWarning):
    """The loops of a mechanism close only where beams are strained, leave open how it moves, or in an odd way."""


def assemble(
    mechanism: Mechanism,
    positions: WorldPlaces | None = None,
    speeds: WorldMotion | None = None,
    *,
    guess: WorldPlaces | None = None,
    t: Number = 0.0,
) -> State:
    """Find a state on the closed loops, from coordinates and speeds of some of the joints.

    **Arguments:**

    - `positions`: {joint: coordinates [rad or m]}, of joints in the tree or cut; held. A number for
      a joint with one coordinate, else all of them; see the joint types. For one of several the
      key is (joint, index), counted like the joint's speeds. Also places in the world: {body: `linkax.Pose`}, or
      {"body.frame": [x, y, z]} for a point that the body names, and {body: [x, y, z]} for its reference frame [m].
    - `speeds`: {joint: speeds [rad/s or m/s]}, likewise; held. In the world: {body: `linkax.Velocity`}, or
      {"body.frame": [x, y, z]} [m/s].
    - `guess`: {joint: coordinates} and places in the world, as for `positions`, where these are roughly; chooses the
      assembly mode. By default the search starts where frames of joints in the tree coincide.
    - `t`: time [s], for drives.

    For example, `assemble(mechanism, {"crank": 0.3}, guess={"rocker.tip": [1.0, 0.5, 0.0]})`.

    Coordinates that are not held change as little as the loops allow from the guess (from the tree's coordinates that
    fit best, where it names cut joints or places), and a guess that closes the loops stays as it is. Speeds that are
    not held are the smallest that the loops allow, both in radians and lengths of the mechanism. Where the search does
    not reach closed loops from the guess, it starts again beside it, a little and then farther. Strains of beams stay
    as guessed, by default zero; where no start closes the loops so, they change, with little energy. In a singular
    configuration, where branches of the motion cross, speeds lie on the branch of the position where it is a little off
    (1e-9), else on the branch nearest to these; give more of them to choose another.

    Differentiable in the numbers of the mechanism, positions, speeds and the guess, to any order. A coordinate that is
    neither held nor decided by the loops has the derivative of the nearest to the guess, as if the guess closed the
    loops. A guess of cut joints or places has no derivative.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop cannot be closed, with
    what is held, by drives too; or the joints whose motion branches where the speeds lie on no branch; `ValueError` for
    an unknown joint or a wrong number. Inside JAX transformations nothing is raised: the speeds are infinite then, and
    `linkax.simulate` says so in its result.
    Warns (`AssemblyWarning`), outside JAX transformations, of beams that the loops strain; of speeds that fit several
    branches; of angles beyond one and a half turns, which may be degrees, but of joints whose turns a force or a
    constraint counts; where no guess is given, of slides between moving bodies with lengths of both signs, and of
    joints between points that a model drawn in the world (`RigidBody.placed`) has in two places; and of a body between
    two balls whose spin nothing decides. `linkax.assemblies` finds what other assemblies there are.
    """
    check_mechanism(mechanism)
    t = checked_time(t, "t")
    places = Places(mechanism)
    positions, guess = places.positions(positions, "position"), places.positions(guess, "guess")
    speeds = places.speeds(speeds, "speed")
    measured = places.measured()
    held, begin = (coordinates_by_joint(measured, *given) for given in ((positions, "position"), (guess, "guess")))
    moving = speeds_by_joint(measured, speeds, "speed")
    given = flat_with_known(measured), held, moving, begin, t
    with compiling(all_concrete(given) and is_first(assemble, jax.tree.structure(given))):
        state, remainder = _assembled(*given)
    state = State(state.q, state.v, mechanism.topology)  # without the joints that only measured
    if not all_concrete((state, remainder)):
        return _marked(mechanism, state, remainder)
    remainder = jax.tree.map(np.asarray, remainder)
    _raise_if_open(mechanism, state, t, remainder, held, moving)
    for beam, (strain, energy) in remainder.strained.items():
        if strain > remainder.most:
            warn(
                f"beam {beam!r} is strained, with an energy of {energy:.3g} J, as the loops do not close otherwise; "
                f"check lengths and offsets, hold fewer positions, or {GUESS}; linkax.equilibrium finds the strains at "
                "rest",
                AssemblyWarning,
            )
    for doubt in doubts(mechanism, held, begin, moving, state):
        warn(doubt, AssemblyWarning)
    if remainder.undecided and (names := _open_speeds(mechanism, measured, moving, t, state)):
        warn(
            f"the configuration is singular, and the speeds asked fit several branches of the motion, which differ in "
            f"the speeds of joints {names}; to choose a branch, ask for the speeds of some of these, too",
            AssemblyWarning,
        )
    return state


def _open_speeds(mechanism, measured, speeds, t, state):
    """Names of joints whose speeds differ on other branches that have the speeds asked."""
    others, are_some = other_speeds(measured, speeds, t, state.q, state.v)
    differences = (others - state.v)[np.asarray(are_some)].T
    names = moving_joints(system_of(mechanism, state.q.dtype), t, state.q, differences) if differences.size else ()
    return ", ".join(map(repr, names))


def _raise_if_open(mechanism, state, t, remainder, held, moving):
    for message in _open(mechanism, state, t, remainder):
        raise AssemblyError(next(_contradictions(mechanism, t, remainder.most, held, moving), message))


def _contradictions(mechanism, t, most, held, moving):
    """Tell where drives ask for other positions or speeds of their joints than are given."""
    for what, given, remedy in (
        ("position", held, "start the drive there"),
        ("speed", moving, "give the drive that speed"),
    ):
        for drive, kind, asked, unit in _drives(mechanism, t, what):
            joint, index = drive.terms[0]
            for along, entries in given.by_term():
                if along.joint != joint or along.index not in (None, index or 0):
                    continue
                before = what == "position" and kind.has_quaternion  # with one number more than speeds
                value = float(entries[(index or 0) + before if along.index is None else 0])
                if not abs(value - asked) <= most:
                    yield (
                        f"the {what} asked of joint {joint!r} is {value:.6g} {unit}, and {drive.display_name} holds it "
                        f"at {asked:.6g} {unit} at t = {float(t):.6g} s; leave it out of {what}s, or {remedy}"
                    )


def _drives(mechanism, t, what):
    """Drives, with the kind of their joints, and the position or speed that they ask for at time t, with its unit."""
    topology = mechanism.topology
    for drive in mechanism.constraints:
        if isinstance(drive, Drive):
            joint, index = drive.terms[0]
            kind = topology.joint_types[topology.joint_index(joint)]
            law, per = (drive.right_side, "") if what == "position" else (jax.jacfwd(drive.right_side), "/s")
            yield drive, kind, float(law(t)), kind.speed_units[index or 0] + per


def _open(mechanism, state, t, remainder):
    """Tell what is not met, the most telling first."""
    topology = mechanism.topology

    def driven(what):
        return [
            f"{drive.display_name} holds {drive.terms[0].joint!r} at {asked:.6g} {unit}"
            for drive, _, asked, unit in _drives(mechanism, t, what)
        ]

    def remains(size, unit):
        held = ", ".join(dict.fromkeys(repr(along.joint) for along, _ in remainder.positions.by_term())) or "none"
        held = "; ".join([f"positions held: {held}", *driven("position")])
        return f"a gap of {size:.6g} {unit} remains ({held})"

    advice = f"check lengths and offsets, hold fewer positions, or {GUESS}"
    gap, scaled = remainder.gap, remainder.gap_in_scales
    for cut, name in enumerate(topology.joints[topology.num_bodies :]):
        for size, in_scales, unit in ((gap.distance, scaled.distance, "m"), (gap.angle, scaled.angle, "rad")):
            if not in_scales[cut] <= CLOSED:
                yield f"joint {name!r} does not close: {remains(size[cut], unit)}; {advice}"
    for constraint, size, in_scales in zip(mechanism.constraints, gap.constraints, scaled.constraints, strict=True):
        if not in_scales <= CLOSED:
            joints = f" of joint {', '.join(map(repr, constraint.joints))}" if constraint.joints else ""
            yield (
                f"{constraint.display_name}{joints} is not met at t = {float(t):.6g} s: "
                f"{remains(size, 'rad or m')}; {advice}"
            )
    for what, misses in (("position", remainder.positions), ("speed", remainder.speeds)):
        for along, miss in misses.by_term():
            if not np.all(np.abs(miss) <= remainder.most):
                size, drives = np.max(np.abs(miss)), "; ".join(driven(what))
                yield (
                    f"the {what} asked of {called(along.joint)} is missed by {size:.6g}; the loops do not allow it "
                    f"together with the other {what}s given{f' ({drives})' if drives else ''}, so ask for fewer"
                )
    tolerance = np.asarray(rank_tolerance(state.q.dtype))  # with which nothing is compiled
    if not remainder.off_branch <= ON_BRANCH * tolerance:
        system = system_of(mechanism, state.q.dtype)
        basis = ConstraintSplit.at(system, t, state.q, tolerance).inverse.basis
        names = ", ".join(map(repr, moving_joints(system, t, state.q, basis)))
        yield (
            "the configuration is singular, and the speeds asked lie on no branch of the motion; its branches cross "
            f"in the motion of joints {names}, so ask for the speeds of other joints among them, or of fewer"
        )


class _Remainder(eqx.Module):
    """What stays open, for the error message; of each beam the largest change of a strain, and its energy.

    - `most`: the largest miss of coordinates and speeds that counts as none.
    """

    gap: Gap
    gap_in_scales: Gap
    most: Array
    positions: JointValues
    speeds: JointValues
    off_branch: Array
    undecided: Array
    strained: dict

    def is_met(self) -> Bool[Array, ""]:
        """Whether the loops are closed and all that is held is met."""
        missed = jnp.concatenate([self.positions.flat(), self.speeds.flat()])
        return jnp.all(jnp.abs(missed) <= self.most) & (self.gap_in_scales.widest() <= CLOSED)


@jit_inline
def _marked(mechanism, state, remainder):
    """The state, with infinite speeds where it is none."""
    v = jnp.where(remainder.is_met() & sound_numbers(mechanism), state.v, jnp.inf)
    return State(state.q, v, mechanism.topology)


def _assembled(*given):
    """The state and what stays open; branches of the motion are looked for only where there are some."""
    near = without_derivatives(given)
    if not all_concrete(near):
        return _assemble(*given, branches=True)
    state, remainder = _assemble(*near, branches=False)
    if branches := bool(remainder.undecided):
        state, remainder = _assemble(*near, branches=True)
    return (state if all_concrete(given) else _assembled_again(given, state.q, branches)), remainder


@Program
def _assemble(flat, positions, speeds, guess, t, *, branches):
    demand, begin = demand_of(flat, positions, guess, t)
    if (rough := guess.of_cuts()).groups:
        given = given_in_tree(demand.system.topology, guess, positions)
        begin = rough_start(*lax.stop_gradient((demand, rough, begin)), given)
    q = close_loops(demand, begin, None)
    system, configuration = demand.system, configure(demand.system, t, q)
    found = (speeds_on_branch if branches else smallest_speeds)(configuration, speeds)
    # All else only decides, and has no derivative.
    demand, begin, end, configuration = jax.tree.map(lax.stop_gradient, (demand, begin, q, configuration))
    off, gap = jnp.abs(demand.back(end, begin)), gaps(configuration)
    remainder = _Remainder(
        gap=gap,
        gap_in_scales=gap.in_scales(system),
        most=CLOSED * jnp.maximum(system.length, 1.0),
        positions=demand.held.apart(configuration),
        speeds=found.misses,
        off_branch=found.off_branch,
        undecided=found.undecided,
        strained={
            beam.beam: (
                jnp.max(off[system.topology.speeds[beam.beam]]),
                beam.energy(end[system.topology.coordinates[beam.beam]]),
            )
            for beam in beams_of(demand.system)
        },
    )
    return State(q, found.v, system.topology), remainder


@jit_inline
def _assembled_again(given, q, branches):
    """The state whose coordinates are known, for its derivatives."""
    flat, positions, speeds, guess, t = given
    demand, begin = demand_of(flat, positions, guess, t)
    q = close_loops(demand, begin, q)
    v = speeds_again(configure(demand.system, t, q), speeds, branches)
    return State(q, v, demand.system.topology)


def demand_of(flat: Any, positions: JointValues, guess: JointValues, t: Array) -> tuple[LoopClosure, Array]:
    """The problem of closing the loops, and the coordinates where the search begins."""
    system = system_of(flat, jnp.result_type(float))
    topology = system.topology
    q = jnp.asarray(neutral(topology, system.dtype))
    for given in (guess, positions):
        for alike, rows in zip(given.groups, given.values, strict=True):
            if alike.in_tree:
                q = scatter_static(q, alike.in_q(topology), rows)
    return LoopClosure(system, t, positions), on_manifold(topology, q)
