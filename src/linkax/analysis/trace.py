"""Kinematics without time: `linkax.trace` follows closed loops along values of joints or places, or by arc length."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float, Int

from linkax.analysis.continuation import Way, follow_arc, follow_values
from linkax.analysis.course import Course, followed_drives, own_values, values_along
from linkax.analysis.steady import may_move
from linkax.equations.configuration import configure
from linkax.equations.gaps import gaps
from linkax.equations.system import system_of
from linkax.formulations.formulation import Dynamics
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.revolute import Revolute
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, require_bool
from linkax.model.poses import Pose
from linkax.model.terms import TermLike
from linkax.simulation.integrate.accuracy import BALANCED
from linkax.simulation.integrate.results import RESULTS
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, Run
from linkax.simulation.read.by_name import BodyPoint
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.start.closing import CLOSED
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, require_double_precision, sound_numbers
from linkax.spatial.vectors import cross, dot, length
from linkax.tables import Rows, Table, batch, count, known, numbers, printed_as
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, concrete, is_first
from linkax.xla.waiting import compiling
from scalarjit import scalarised, with_known_entries

Values = Mapping[str, ArrayLike | list[Any] | Pose] | Mapping[TermLike, ArrayLike | list[Any] | Pose]


ENDS: Any = RESULTS.successful, RESULTS.not_reached  # where all is reached, and where not


class TraceError(RuntimeError):
    """A trace does not reach all that is asked for; `trace` holds the part that it reaches."""

    def __init__(self, message: str, trace: "Trace | None" = None) -> None:  # pickle calls it with the message alone
        super().__init__(message)
        self.trace = trace


def _table(trace: "Trace") -> Table:
    shape = trace.ts.shape[:-1]
    reached = known(trace.ts)
    title = f"Trace of {count(trace.ts.shape[-1], 'position')} along {trace.along}{batch(shape)}"
    facts = [] if reached is None else [("reached", str(int(np.sum(np.isfinite(reached)))))]
    facts.append(("distance", f"{numbers(trace.distance)} from where a branch crosses or turns back (1 is far)"))
    rows = [(name, numbers(trace.q[..., taken])) for name, taken in trace.mechanism.topology.coordinates.items()]
    return Table(title, [Rows((), facts), Rows(("joint", "range"), rows, "joints")])


@printed_as(_table)
class Trace(Kinematics):
    """Positions of a mechanism along values of s, and their derivatives by s.

    s is the coordinate of the one joint that is followed [rad or m]; 0, 1, 2, … where several are, or a place; or the
    arc length of all coordinates [rad, lengths of the mechanism].

    - `ts`: s, (n,). Positions that are not reached hold infinity, in `q` and `v` too.
    - `q`: coordinates of the tree's joints, (n, n_q); `v`, `v_rate`: their first and second derivative by s,
      (n, n_v). So `joint_speed`, `velocity` and the like are by s, `joint_acceleration` and `acceleration` by s².
    - `distance`: |R_rr| / |R₁₁| of the loops' rows and of what is followed, (n,): zero where another branch crosses, or
      what is followed turns back. It has no derivative. `singularity_distance()` is that of the loops alone.
    - `result`: `linkax.RESULTS.successful`, or why positions are missing.
    - `along`: what is followed, in words. `by_joint`: whether that is one coordinate of a joint.
    """

    by_time = ("ts", "q", "v", "v_rate", "distance")

    run: Run
    ts: Float[Array, "*batch n_t"]
    q: Float[Array, "*batch n_t n_q"]
    v: Float[Array, "*batch n_t n_v"]
    v_rate: Float[Array, "*batch n_t n_v"]
    distance: Float[Array, "*batch n_t"]
    result: Any
    along: str = eqx.field(static=True)
    by_joint: bool = eqx.field(static=True)
    rank_nearby: Int[Array, "*batch k"] | None = None
    internal: None = None  # of which positions say nothing

    @property
    def known_dynamics(self) -> Dynamics:
        rows = jnp.zeros((*self.ts.shape, self.mechanism.topology.num_rows), self.q.dtype)
        return Dynamics(self.v_rate, rows, rows)

    def state(self, index: int) -> State:
        """The position of an index as a `State`, such as the start of a run; speeds are derivatives by s."""
        at = lambda array: array[..., index, :]
        return State(at(self.q), at(self.v), self.mechanism.topology)

    def mechanical_advantage(self, output: str, at: BodyPoint = None) -> Float[Array, "*batch n_t"]:
        """Force at the output for a force of one at the input, without losses: d input / d output, by virtual work.

        **Arguments:** `output`: a joint with one coordinate; or a body, of whose centre of mass, or point `at`, the
        way counts, whatever its direction.

        Infinite in a dead point, where the output stands still.

        **Raises:** `ValueError` for a trace along anything but one coordinate of a joint, which is the input, and for
        an output with several coordinates.
        """
        if not self.by_joint:
            raise ValueError(f"the trace is along {self.along}; trace along one coordinate of a joint, the input")
        if at is None and output in self.mechanism.topology.joints:
            if (count := len(self.mechanism.joint(output).speed_units)) != 1:
                raise ValueError(f"output {output!r} has {count} coordinates; give a joint with one, or a body")
            return 1.0 / self.joint_speed(output)
        return 1.0 / length(self.velocity(output, at))

    def transmission_angle(self, pin: str, output: str) -> Float[Array, "*batch n_t"]:
        """Angle μ between the coupler and what its pin cannot move along, from 0 to π/2 [rad].

        sin μ = |e · u|: e points along the coupler, from its other joint to the pin, and u where the pin moves as the
        output turns or slides (Sutherland, Roth, Journal of Engineering for Industry 95, 1973). In a planar four-bar
        μ is the angle between coupler and rocker; in a dead point of the output it is zero.

        **Arguments:** `pin`: the joint between the coupler and the output's body. `output`: a `Revolute` or `Prismatic`
        that holds that body.

        **Raises:** `ValueError` where the coupler has not two joints, or the output is of another type.
        """
        mechanism = self.mechanism
        held, moving = mechanism.joint(pin), mechanism.joint(output)
        bodies = lambda joint: {joint.parent.body, joint.child.body}
        if not isinstance(moving, Revolute | Prismatic):
            raise ValueError(f"output {output!r} is a {type(moving).__name__}; give a Revolute or Prismatic joint")
        if len(shared := bodies(held) & bodies(moving)) != 1 or pin == output:
            raise ValueError(f"pin {pin!r} and output {output!r} hold no body in common; give joints of one body")
        (coupler,) = bodies(held) - shared
        others = [joint for joint in mechanism.joints if coupler in bodies(joint) and joint.name != pin]
        if len(others) != 1:
            names = ", ".join(repr(joint.name) for joint in others)
            raise ValueError(f"coupler {coupler!r} has {len(others)} joints beside {pin!r} ({names}); it must have one")
        tip, base = self._origin(held), self._origin(others[0])
        axis = self._axis(moving)
        along = tip - base
        way = axis if isinstance(moving, Prismatic) else cross(axis, tip - self._origin(moving))
        return jnp.arctan2(jnp.abs(dot(along, way)), length(cross(along, way)))

    def _origin(self, joint):
        """Where a joint is, in ground axes, (n, 3)."""
        end = joint.child if joint.child.body in self.mechanism.topology.bodies else joint.parent
        pose = self.poses()[end.body]
        return pose.position + (pose.orientation @ jnp.asarray(end.offset)[..., None, :, None])[..., 0]

    def _axis(self, joint):
        """Axis of a joint, in ground axes, (n, 3)."""
        parent, child = joint.frames()
        on_child = joint.child.body in self.mechanism.topology.bodies
        end, axes = (joint.child, child) if on_child else (joint.parent, parent)
        return self.poses()[end.body].orientation @ jnp.asarray(axes)[:, 0]


def trace(
    mechanism: Mechanism,
    start: State,
    along: Values | None = None,
    *,
    arc_length: ArrayLike | Sequence[float] | None = None,
    t: Number = 0.0,
    throw: bool = True,
) -> Trace:
    """Follow the positions of a mechanism as some of its joints or places take given values: kinematics without time.

    ```python
    turn = lx.trace(four_bar, start, {"crank": np.linspace(0.0, 2.0 * np.pi, 361)})
    turn.position("coupler", "tip"), turn.joint_speed("rocker"), turn.transmission_angle("pin", "rocker")
    ```

    The way begins at `start`, leads to the first values, and from each to the next, by continuation on the branch, in
    steps as short as it takes. Forces and masses do not matter; drives of other joints stand still. Where more can move
    than is asked for, such as a rod that turns about itself, it moves as little as it can.

    Inverse kinematics is the same: follow {"tool.tip": points} or {"platform": lx.Pose(positions, orientations)}.

    Differentiable in the numbers of the mechanism and the values, in both modes, to any order; batches by `jax.vmap`.

    **Arguments:**

    - `start`: a state on the closed loops, such as of `linkax.assemble`.
    - `along`: {joint: values}, of joints in the tree or cut, (n,), or (n, k) with all k coordinates; for one of several
      the key is (joint, index). In the world {body: `linkax.Pose`}, with positions (n, 3) and orientations (n, 3, 3),
      and {"body.frame": points} (n, 3) [m]. Derivatives by s are those of a cubic spline through the values, but for
      one coordinate, which is s itself. A drive of such a joint lets go of it.
    - `arc_length`: in place of `along`, for a mechanism with one degree of freedom: (n,) arc lengths from the start,
      √(Σ Δq²) in radians and lengths of the mechanism, rising or falling. The way leads through turning points, and
      begins in the direction of the start's speeds. One step leads from each position to the next.
    - `t`: time [s], for drives of other joints.
    - `throw`: raise where positions are not reached. Inside JAX transformations nothing is raised, and `result` alone
      tells.

    **Returns:** a `Trace`, from which positions, speeds and accelerations are read as from a `Solution`.

    **Raises:** `TraceError`, which holds the `.trace` so far, where the branch does not lead to all values;
    `ValueError` for bad arguments.
    """
    require_bool(throw, "throw")
    start, t = start_of(mechanism, start), jnp.asarray(checked_time(t, "t"))
    if along is not None and arc_length is None:
        measured, held, values = values_along(mechanism, along)
        course = Course.along(held, values)
        what = " and ".join(map(str, along))
    elif arc_length is not None and along is None:
        measured, course, what = mechanism, Course.by_arc(arc_length), "the arc length"
        if not may_move(start):
            told = "start has no speeds, which choose the direction; make it with one, such as speeds={'crank': 1.0}"
            raise ValueError(told)
    else:
        given = "neither along nor arc_length" if along is None else "both along and arc_length"
        raise ValueError(f"trace got {given}; give one of them, such as along={{'crank': values}}")
    given = with_known_entries(measured), start, course, t
    with compiling(all_concrete(given) and is_first(trace, jax.tree.structure(given))):
        rows, result, freedom = _traced(*given)
    if along is None and (ways := concrete(freedom)) is not None and ways > 1:
        raise ValueError(f"the mechanism can move in {ways} ways, and arc_length follows one; give along=, or drives")
    run = Run.of_state(mechanism, start, t, DEFAULT_FORMULATION, BALANCED)
    named: Any = dict(zip(Trace.by_time, rows, strict=True))
    found = Trace(run=run, **named, result=result, along=what, by_joint=course.asked.values.shape[1] == 1)
    if throw and all_concrete(found) and not np.all(np.isfinite(found.ts)):
        raise TraceError(_stopped(found, course), found)
    return found


def start_of(mechanism: Mechanism, start: State) -> State:
    """Check the state where a way begins.

    **Raises:** `ValueError` for one that is none, or that is in single precision, with loops too far open, and for a
    mechanism whose places depend on the way that it takes to them.
    """
    start = checked_state(mechanism, start)
    slipping = [constraint.display_name for constraint in mechanism.constraints if constraint.slip_units]
    if slipping:
        names = " and ".join(slipping)
        raise ValueError(f"{names} holds speeds, and no places that could be traced; integrate by linkax.simulate")
    require_double_precision(start, "start")
    return start


@scalarised
def _traced(flat, start, course, t):
    """s, the places, the result, and in how many ways the mechanism can move."""
    system = system_of(flat, start.q.dtype)
    way = Way(system, t, course.held, followed_drives(course.held, system.constraints))
    own = own_values(course.held, configure(system, t, start.q))
    demand = way.demand(own)
    closed = gaps(configure(demand.system, t, start.q)).in_scales(system).widest() <= CLOSED
    sound = sound_numbers(flat.tree) & jnp.all(jnp.isfinite(course.s)) & jnp.all(jnp.isfinite(course.asked.values))
    sound = sound & jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.v))
    if course.held.groups:
        place, reached = follow_values(way, start, own, course.s, course.asked, closed & sound)
    else:
        place, reached = follow_arc(way, start, course.s, closed & sound)
    there = lambda array: jnp.where(reached.reshape(-1, *(1,) * (array.ndim - 1)), array, jnp.inf)
    result = RESULTS.where(jnp.all(reached), *ENDS)
    result = RESULTS.where(closed, result, RESULTS.not_closed)
    result = RESULTS.where(sound, result, RESULTS.not_finite)
    result = RESULTS.where(jnp.any(jnp.isinf(start.v)), RESULTS.not_assembled, result)
    freedom = system.topology.num_speeds - len(system.topology.spinning) - jnp.max(place.rank)
    return [*map(there, (course.s, *place[:4]))], result, freedom


def _stopped(found, course):
    """Where and why a trace stops."""
    if found.result != RESULTS.not_reached:
        return f"the trace stops before it begins: {RESULTS[found.result]}"
    reached = int(np.sum(np.isfinite(found.ts)))
    values = np.asarray(course.asked.values if course.held.groups else course.s[:, None])
    shown = lambda row: numbers(values[row], axes=1)
    if not reached:
        return (
            f"the trace along {found.along} does not reach the first value, {shown(0)}, from the start{_held(found)}; "
            "start nearer, on its branch, and follow no more coordinates than can be chosen"
        )
    remedy = "give values up to there, or throw=False for the part that is reached"
    if course.held.groups:
        remedy += "; arc_length= leads through turning points"
    else:
        remedy = f"give closer values, or {remedy}"
    return (
        f"the trace along {found.along} stops between {shown(reached - 1)} and {shown(reached)}, position {reached} of "
        f"{len(values)}: the branch turns back there, or ends where another crosses{_held(found)}; {remedy}"
    )


def _held(found):
    """Drives that may be in the way."""
    names = [each.display_name for each in found.mechanism.constraints if each.is_driven]
    return f", where {' and '.join(names)} of other joints stands still" if names else ""
