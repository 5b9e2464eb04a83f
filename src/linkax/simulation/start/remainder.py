"""What an assembly leaves open, and its telling."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from linkax.equations.gaps import Gap
from linkax.equations.system import system_of
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.model.constraints.constraint import Drive
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.closing import CLOSED
from linkax.simulation.start.initial_state import ON_BRANCH, moving_joints
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import rank_tolerance
from linkax.simulation.start.places import called
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array

GUESS = "give another guess, such as guess={body: lx.Pose(position)} with its rough place"


class Remainder(eqx.Module):
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

    def is_on_branch(self, dtype: np.dtype) -> bool:
        """Whether speeds that are known lie on a branch of the motion."""
        # As arrays of NumPy, with which nothing is compiled.
        return bool(np.asarray(self.off_branch) <= ON_BRANCH * np.asarray(rank_tolerance(dtype)))

    def is_met(self) -> Bool[Array, ""]:
        """Whether the loops are closed and all that is held is met."""
        missed = jnp.concatenate([self.positions.flat(), self.speeds.flat()])
        return jnp.all(jnp.abs(missed) <= self.most) & (self.gap_in_scales.widest() <= CLOSED)


def unmet(
    mechanism: Mechanism, state: State, t: Any, remainder: Remainder, held: JointValues, moving: JointValues
) -> str | None:
    """Tell the cause why an assembly is none, or else the first of what it does not meet; None where it meets all.

    **Arguments:** `held`, `moving`: positions and speeds that were asked for.
    """
    found = next(_open(mechanism, state, t, remainder), None)
    return found and next(_contradictions(mechanism, t, remainder.most, held, moving), found)


def _contradictions(mechanism, t, most, held, moving) -> Iterator[str]:
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


def _open(mechanism, state, t, remainder) -> Iterator[str]:
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
    for row, size, in_scales in zip(topology.constraint_of_row, gap.constraints, scaled.constraints, strict=True):
        constraint = mechanism.constraints[row]
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
    if not remainder.is_on_branch(state.q.dtype):
        system, tolerance = system_of(mechanism, state.q.dtype), np.asarray(rank_tolerance(state.q.dtype))
        basis = ConstraintSplit.at(system, t, state.q, tolerance).inverse.basis
        names = ", ".join(map(repr, moving_joints(system, t, state.q, basis)))
        yield (
            "the configuration is singular, and no branch of the motion was found that has the speeds asked; its "
            f"branches cross in the motion of joints {names}, so ask for speeds of one motion, and of more of these "
            "joints"
        )
