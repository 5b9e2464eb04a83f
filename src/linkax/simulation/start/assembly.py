"""Consistent states from partial positions and speeds."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, on_manifold
from linkax.equations.gaps import Gap, gaps
from linkax.equations.system import system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number
from linkax.simulation.start.branch_speeds import other_speeds, speeds_on_branch
from linkax.simulation.start.closing import CLOSED, LoopClosure, close_loops
from linkax.simulation.start.initial_state import ON_BRANCH, moving_joints
from linkax.simulation.start.nearest_solution import beams_of, rank_tolerance
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import (
    JointNumbers,
    JointValues,
    by_joint,
    check_mechanism,
    checked_time,
    coordinates_by_joint,
    sound_numbers,
)
from linkax.straight_line.known import KnownEntries
from linkax.xla.arrays import Array
from linkax.xla.tracing import Program, all_concrete


class AssemblyError(ValueError):
    """No positions close the loops of a mechanism with those asked for."""


class AssemblyWarning(UserWarning):
    """The loops of a mechanism close only where beams are strained, or leave open on which branch it moves."""


def assemble(
    mechanism: Mechanism,
    positions: JointNumbers | None = None,
    speeds: JointNumbers | None = None,
    *,
    guess: JointNumbers | None = None,
    t: Number = 0.0,
) -> State:
    """Find a state on the closed loops, from coordinates and speeds of some of the joints.

    **Arguments:**

    - `positions`: {joint: coordinates [rad or m]}, of joints in the tree or cut; held. A number for
      a joint with one coordinate, else all of them; see the joint types. For one of several the
      key is (joint, index), counted like the joint's speeds.
    - `speeds`: {joint: speeds [rad/s or m/s]}, likewise; held.
    - `guess`: {joint: coordinates} of joints in the tree, where the search starts (default:
      frames that coincide); chooses the assembly mode.
    - `t`: time [s], for drives.

    Coordinates that are not held change as little as the loops allow from the guess, and speeds that are not held are
    the smallest that the loops allow, both in radians and lengths of the mechanism. Where the search does not reach
    closed loops from the guess, it starts again beside it, a little and then farther. Strains of beams stay as guessed,
    by default zero; where no start closes the loops so, they change, with little energy. In a singular configuration,
    where branches of the motion cross, speeds lie on the branch of the position where it is a little off (1e-9), else
    on the branch nearest to these; give more of them to choose another.

    Differentiable in the numbers of the mechanism, positions, speeds and the guess, to any order. A coordinate that is
    neither held nor decided by the loops has the derivative of the nearest to the guess, as if the guess closed the
    loops.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop
    cannot be closed, or the joints whose motion branches where the speeds lie on no branch;
    `ValueError` for an unknown joint or a wrong number. Inside JAX transformations nothing is
    raised: the speeds are infinite then, and `linkax.simulate` says so in its result.
    Warns (`AssemblyWarning`), outside JAX transformations, of beams that the loops strain, and of speeds that
    fit several branches.
    """
    check_mechanism(mechanism)
    t = jnp.asarray(checked_time(t, "t"))
    held, begin = (coordinates_by_joint(mechanism, *given) for given in ((positions, "position"), (guess, "guess")))
    moving = by_joint(mechanism, speeds, "speed", lambda joint: len(joint.speed_units))
    for name, _ in begin.terms:
        if name not in mechanism.topology.coordinates:
            raise ValueError(f"guess for joint {name!r}, which is cut; guess coordinates of joints in the tree")
    state, remainder = _assemble(mechanism, KnownEntries.of(mechanism), held, moving, begin, t)
    if not all_concrete((state, remainder)):
        return State(state.q, jnp.where(remainder.is_met() & sound_numbers(mechanism), state.v, jnp.inf))
    remainder = jax.tree.map(np.asarray, remainder)
    _raise_if_open(mechanism, state, t, remainder)
    for beam, (strain, energy) in remainder.strained.items():
        if strain > remainder.most:
            warnings.warn(
                f"beam {beam!r} is strained, with an energy of {energy:.3g} J, as the loops do not close otherwise; "
                "check lengths and offsets, hold fewer positions, or give another guess; linkax.equilibrium finds the "
                "strains at rest",
                AssemblyWarning,
                stacklevel=2,
            )
    if remainder.undecided and (names := _open_speeds(mechanism, moving, t, state)):
        warnings.warn(
            f"the configuration is singular, and the speeds asked fit several branches of the motion, which differ in "
            f"the speeds of joints {names}; to choose a branch, ask for the speeds of some of these, too",
            AssemblyWarning,
            stacklevel=2,
        )
    return state


def _open_speeds(mechanism, speeds, t, state):
    """Names of joints whose speeds differ on other branches that have the speeds asked."""
    others, are_some = other_speeds(mechanism, speeds, t, state.q, state.v)
    differences = (others - state.v)[np.asarray(are_some)].T
    names = moving_joints(system_of(mechanism, state.q.dtype), t, state.q, differences) if differences.size else ()
    return ", ".join(map(repr, names))


def _raise_if_open(mechanism, state, t, remainder):
    topology = mechanism.topology
    held = ", ".join(repr(along.joint) for along in remainder.positions.terms) or "none"
    remains = lambda size, unit: f"a gap of {size:.6g} {unit} remains (positions held: {held})"
    advice = "check lengths and offsets, hold fewer positions, or give another guess"
    gap, scaled = remainder.gap, remainder.gap_in_scales
    for cut, name in enumerate(topology.joints[topology.num_bodies :]):
        for size, in_scales, unit in ((gap.distance, scaled.distance, "m"), (gap.angle, scaled.angle, "rad")):
            if not in_scales[cut] <= CLOSED:
                raise AssemblyError(f"joint {name!r} does not close: {remains(size[cut], unit)}; {advice}")
    for constraint, size, in_scales in zip(mechanism.constraints, gap.constraints, scaled.constraints, strict=True):
        if not in_scales <= CLOSED:
            joints = f" of joint {', '.join(map(repr, constraint.joints))}" if constraint.joints else ""
            raise AssemblyError(
                f"{constraint.display_name}{joints} is not met at t = {float(t):.6g} s: "
                f"{remains(size, 'rad or m')}; {advice}"
            )
    for what, misses in (("position", remainder.positions), ("speed", remainder.speeds)):
        for along, miss in zip(misses.terms, misses.values, strict=True):
            if not np.all(np.abs(miss) <= remainder.most):
                size = np.max(np.abs(miss))
                raise AssemblyError(
                    f"the {what} asked of joint {along.joint!r} is missed by {size:.6g}; the loops do not "
                    f"allow it together with the other {what}s given, so ask for fewer"
                )
    tolerance = rank_tolerance(state.q.dtype)
    if not remainder.off_branch <= ON_BRANCH * tolerance:
        system = system_of(mechanism, state.q.dtype)
        basis = ConstraintSplit.at(system, t, state.q, tolerance).inverse.basis
        names = ", ".join(map(repr, moving_joints(system, t, state.q, basis)))
        raise AssemblyError(
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
        missed = [*self.positions.values, *self.speeds.values]
        held = jnp.array([jnp.all(jnp.abs(miss) <= self.most) for miss in missed], dtype=bool).all()
        return held & (self.gap_in_scales.widest() <= CLOSED)


@Program
def _assemble(mechanism, known, positions, speeds, guess, t):
    system = system_of(mechanism, jnp.result_type(float), known=known)
    topology = system.topology
    q = jnp.asarray(neutral(topology, system.dtype))
    for given in (guess, positions):
        for along, entry in zip(given.terms, given.values, strict=True):
            if along.joint in topology.coordinates:
                q = q.at[topology.coordinate_slice(along)].set(entry)
    demand = LoopClosure(system, t, positions)
    begin = on_manifold(topology, q)
    q = close_loops(demand, begin)
    off = jnp.abs(demand.back(q, begin))
    configuration = configure(system, t, q)
    v, misses, off_branch, undecided = speeds_on_branch(configuration, speeds)
    gap = gaps(configuration)
    remainder = _Remainder(
        gap=gap,
        gap_in_scales=gap.in_scales(system),
        most=CLOSED * jnp.maximum(system.length, 1.0),
        positions=JointValues(positions.terms, demand.misses(configuration)),
        speeds=misses,
        off_branch=off_branch,
        undecided=undecided,
        strained={
            beam.beam: (jnp.max(off[topology.speeds[beam.beam]]), beam.energy(q[topology.coordinates[beam.beam]]))
            for beam in beams_of(system)
        },
    )
    return State(q, v), remainder
