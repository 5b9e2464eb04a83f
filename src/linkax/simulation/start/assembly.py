"""Consistent states from partial positions and speeds."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, on_manifold
from linkax.equations.gaps import gaps
from linkax.equations.system import system_of
from linkax.model.forces.internal_states import initial_values
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number
from linkax.simulation.start.branch_speeds import other_speeds, smallest_speeds, speeds_again, speeds_on_branch
from linkax.simulation.start.closing import CLOSED, LoopClosure, close_loops
from linkax.simulation.start.doubts import doubts
from linkax.simulation.start.initial_state import moving_joints
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import beams_of
from linkax.simulation.start.places import Places
from linkax.simulation.start.remainder import GUESS, Remainder, unmet
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
from linkax.xla.arrays import Array
from linkax.xla.static_scatter import scatter_static
from linkax.xla.tracing import all_concrete, is_first, jit_inline, without_derivatives
from linkax.xla.undefined import undefined_where
from linkax.xla.users_line import warn
from linkax.xla.waiting import compiling
from scalarjit import scalarised, with_known_entries


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
    (1e-9), else on a branch near these, which outside of JAX transformations is looked for from other speeds, too; give
    more of them to choose another.

    Differentiable in the numbers of the mechanism, positions, speeds and the guess, to any order. A coordinate that is
    neither held nor decided by the loops has the derivative of the nearest to the guess, as if the guess closed the
    loops. A guess of cut joints or places has no derivative.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop cannot be closed, with
    what is held, by drives too; or the joints whose motion branches where the speeds lie on no branch; `ValueError` for
    an unknown joint or a wrong number. Inside JAX transformations nothing is raised: the speeds are infinite then,
    derivatives NaN, and `linkax.simulate` says so in its result.
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
    given = with_known_entries(measured), held, moving, begin, t
    with compiling(all_concrete(given) and is_first(assemble, jax.tree.structure(given))):
        state, remainder = _assembled(*given)
    # Without the joints that only measured.
    state = State(state.q, state.v, mechanism.topology, initial_values(mechanism.forces, state.q.dtype))
    if not all_concrete((state, remainder)):
        return _marked(mechanism, state, remainder, given)
    remainder = jax.tree.map(np.asarray, remainder)
    if told := unmet(mechanism, state, t, remainder, held, moving):
        raise AssemblyError(told)
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


@jit_inline
def _marked(mechanism, state, remainder, given):
    """The state, with infinite speeds and without derivatives where it is none."""
    missing = jnp.logical_not(remainder.is_met() & sound_numbers(mechanism))
    q, v = undefined_where((missing, missing), (state.q, jnp.where(missing, jnp.inf, state.v)), given)
    return dataclasses.replace(state, q=q, v=v)


def _assembled(*given):
    """The state and what stays open; branches of the motion are looked for only where there are some."""
    near = without_derivatives(given)
    if not all_concrete(near):
        return _assemble(*given, branches=True)
    state, remainder = _assemble(*near, branches=False)
    if branches := bool(remainder.undecided):
        state, remainder = _on_any_branch(near, *_assemble(*near, branches=True))
    return (state if all_concrete(given) else _assembled_again(given, state, branches)), remainder


def _on_any_branch(given, state, remainder):
    """The state with the smallest speeds on a branch that other starts find, where the search has ended beside all."""
    if remainder.is_on_branch(state.q.dtype):
        return state, remainder
    flat, _, speeds, _, t = given
    found, are_some = other_speeds(flat.tree, speeds, t, state.q, state.v)
    if not np.any(are_some):
        return state, remainder
    sizes = jnp.linalg.norm(found / system_of(flat.tree, state.q.dtype).scales, axis=1)
    v = found[jnp.argmin(jnp.where(are_some, sizes, jnp.inf))]
    return dataclasses.replace(state, v=v), dataclasses.replace(remainder, off_branch=jnp.zeros_like(sizes[0]))


@scalarised
def _assemble(flat, positions, speeds, guess, t, *, branches):
    demand, begin = demand_of(flat, positions, guess, t)
    if (rough := guess.of_cuts()).groups:
        given = given_in_tree(demand.system.topology, guess, positions)
        begin = rough_start(*without_derivatives((demand, rough, begin)), given)
    q = close_loops(demand, begin, None)
    system, configuration = demand.system, configure(demand.system, t, q)
    found = (speeds_on_branch if branches else smallest_speeds)(configuration, speeds)
    # All else only decides, and has no derivative.
    demand, begin, end, configuration = without_derivatives((demand, begin, q, configuration))
    off, gap = jnp.abs(demand.back(end, begin)), gaps(configuration)
    remainder = Remainder(
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


@scalarised
def _assembled_again(given, found, branches):
    """The state that was found, for its derivatives."""
    flat, positions, speeds, guess, t = given
    demand, begin = demand_of(flat, positions, guess, t)
    q = close_loops(demand, begin, found.q)
    v = speeds_again(configure(demand.system, t, q), speeds, found.v, branches)
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
