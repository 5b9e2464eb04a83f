"""What is odd of a state that was assembled, and of what was given for it."""

from collections.abc import Iterator

import jax
import numpy as np

from linkax.model.bodies import GROUND_NAME
from linkax.model.elements import is_own
from linkax.model.forces.impacts import Impact
from linkax.model.forces.joint_limits import JointLimit
from linkax.model.functions import Law
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.distance import Distance
from linkax.model.joints.prismatic import Prismatic
from linkax.model.mechanism import Mechanism
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.places import SUFFIX
from linkax.simulation.start.state import State
from linkax.xla.tracing import all_concrete

TURN = 2.0 * np.pi
DRAWN_APART = 0.01  # of the size of what is drawn
BEYOND = 0.1  # of a range, or of 1 rad or 1 m of one with one end: deeper than contacts are
MOST_TURNS = 1.5  # that are given for an angle; ten degrees are more radians than this


def doubts(
    mechanism: Mechanism, positions: JointValues, guess: JointValues, speeds: JointValues, state: State
) -> Iterator[str]:
    """Tell of angles that may be degrees, starts beyond a stop, lengths of struts of both signs, joints that are drawn
    apart, and spins that nothing decides."""
    yield from _many_turns(mechanism, positions, "position")
    yield from _many_turns(mechanism, guess, "guess")
    yield from _beyond_stops(mechanism, state)
    if not guess.groups:
        yield from _short_struts(mechanism, positions, state)
        yield from _drawn_apart(mechanism)
    yield from _idle_spins(mechanism, speeds, state)


def _many_turns(mechanism, values, what) -> Iterator[str]:
    """Of joints whose turns nothing counts."""
    # A stop bounds turns, and does not count them.
    forces = [force for force in mechanism.forces if _reads_turns(force) and not isinstance(force, JointLimit | Impact)]
    counted = {name for element in (*forces, *mechanism.constraints) for name in element.joints}
    for alike, rows in zip(values.groups, values.values, strict=True):
        if alike.kind.has_quaternion or alike.kind.is_screw:
            continue
        for along, numbers in zip(alike.terms, np.asarray(rows), strict=True):
            for unit, angle in zip(alike.units, numbers, strict=True):
                if unit == "rad" and abs(angle) > MOST_TURNS * TURN and along.joint not in counted:
                    yield (
                        f"{what} of joint {along.joint!r} is {angle:.6g} rad, which is {abs(angle) / TURN:.3g} turns; "
                        f"if degrees are meant, give numpy.deg2rad({angle:.6g}), else an angle within one turn"
                    )


def _reads_turns(force):
    """Whether a force reads the coordinate of its joint, or may do so."""
    is_law = lambda node: isinstance(node, Law)
    return force.needs_coordinate or is_own(force) or any(map(is_law, jax.tree.leaves(force, is_leaf=is_law)))


def _beyond_stops(mechanism, state) -> Iterator[str]:
    """Of joints in the tree that are farther beyond a `JointLimit` than a contact goes."""
    topology = mechanism.topology
    for limit in mechanism.forces:
        if not isinstance(limit, JointLimit) or limit.joint.joint not in topology.coordinates:
            continue
        place = limit.range.joint
        unit = mechanism.joint(place.joint).speed_units[place.index or 0]
        at = float(state.q[topology.coordinates[place.joint]][place.index or 0])
        lower, upper = (-np.inf if limit.range.lower is None else float(limit.range.lower)), np.inf
        upper = upper if limit.range.upper is None else float(limit.range.upper)
        size = 1.0 if np.isinf(upper - lower) else upper - lower
        if max(lower - at, at - upper) > BEYOND * size:
            end, name = (lower, "lower") if at < lower else (upper, "upper")
            yield (
                f"joint {place.joint!r} is at {at:.6g} {unit}, and {limit.display_name} ends its range at {name} = "
                f"{end:.6g} {unit}: it pushes back with the force of so deep a contact; start within the range"
            )


def _short_struts(mechanism, positions, state) -> Iterator[str]:
    """Of slides between moving bodies that nothing holds, with frames from which lengths can count."""
    topology, held = mechanism.topology, {along.joint for along, _ in positions.by_term()}
    lengths = {}
    for joint in mechanism.joints[: topology.num_bodies]:
        ends = joint.parent.body, joint.child.body
        if not isinstance(joint, Prismatic) or GROUND_NAME in ends or joint.name in held:
            continue
        if all(mechanism.body(end).drawn_at is None for end in ends):
            lengths[joint.name] = float(state.q[topology.coordinates[joint.name]][0])
    if len({*np.sign([*lengths.values()])} - {0.0}) == 2:
        short = ", ".join(f"{name!r} ({length:.3g} m)" for name, length in lengths.items() if length < 0.0)
        yield (
            f"slides between moving bodies have lengths below zero, {short}, and others above, and no guess was given; "
            "if these are struts, give a guess for them, or for the place of a body: guess={body: lx.Pose(position)}"
        )


def _drawn_apart(mechanism) -> Iterator[str]:
    """Of joints between points that coincide, where a model that is drawn in the world has them in two places."""
    origins = {GROUND_NAME: np.zeros(3)} | {body.name: body.drawn_at for body in mechanism.bodies}
    drawn = {}
    for joint in mechanism.joints:
        ends = [(origins[frame.body], frame.offset) for frame in (joint.parent, joint.child)]
        if (
            "m" in joint.speed_units
            or isinstance(joint, Distance | OnBeam)
            or any(origin is None for origin, _ in ends)
        ):
            continue
        if all_concrete(ends):
            drawn[joint.name] = np.array([origin + offset for origin, offset in ends])
    size = np.max(np.ptp(np.array([*drawn.values()]).reshape(-1, 3), axis=0)) if drawn else 0.0
    for name, (parent, child) in drawn.items():
        if (apart := np.linalg.norm(parent - child)) > DRAWN_APART * size:
            yield (
                f"joint {name!r} joins points that are drawn {apart:.3g} m apart, at {parent.tolist()} and at "
                f"{child.tolist()}, and no guess was given; draw them in one place, or give a guess where bodies are "
                "not as drawn"
            )


def _idle_spins(mechanism, speeds, state) -> Iterator[str]:
    """Of bodies between two balls in a mechanism that moves."""
    topology = mechanism.topology
    asked = {along.joint.removesuffix(SUFFIX).partition(".")[0] for along, _ in speeds.by_term()}
    asked |= {along.joint for along, _ in speeds.by_term()}
    if not speeds.groups or not np.any(np.asarray(state.v)):
        return
    for body, joints in topology.spinning.items():
        name, balls = topology.bodies[body], [topology.joints[joint] for joint in joints]
        if asked & {name, *balls} or not np.any(np.asarray(mechanism.bodies[body].inertia)):
            continue
        ball = next(ball for ball in balls if mechanism.joint(ball).speed_units)
        yield (
            f"nothing decides how fast body {name!r} spins about the line between {' and '.join(map(repr, balls))}; it "
            "is left to the smallest speeds of joints in the tree; to choose, ask for a speed of one of these, such as "
            f"speeds={{({ball!r}, 0): 0.0}}"
        )
