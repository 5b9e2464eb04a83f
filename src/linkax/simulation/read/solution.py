"""The motion that a simulation found, and what can be read from it."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from linkax.equations.reactions import Axes, Reaction, Side
from linkax.equations.system import system_of
from linkax.formulations.classical import ClassicalFormulation
from linkax.formulations.formulation import AbstractFormulation
from linkax.model.elements import AbstractElement
from linkax.model.forces.force import AbstractForce
from linkax.model.forces.impacts import Impact
from linkax.model.joints.distance import Distance
from linkax.model.mechanism import Mechanism
from linkax.model.names import ByName, find
from linkax.model.numbers import Number, Vector, number, require
from linkax.simulation.explain.diagnosis import widest_gap
from linkax.simulation.explain.error_estimate import refined_run
from linkax.simulation.explain.remarks import remark
from linkax.simulation.integrate.accuracy import BALANCED, Accuracy
from linkax.simulation.integrate.impacts import impacts_of, record
from linkax.simulation.integrate.integrate import Outcome, integrate_run
from linkax.simulation.integrate.options import check_accuracy
from linkax.simulation.integrate.results import REMARKS, RESULTS
from linkax.simulation.integrate.run import DEFAULT_FORMULATION, Run, checked_formulation
from linkax.simulation.read.by_name import (
    force_of,
    is_constraint,
    of_constraint,
    reaction_of,
    states_of,
)
from linkax.simulation.read.columns import save, to_dataframe
from linkax.simulation.read.interpolation import motion_at
from linkax.simulation.read.kinematics import Kinematics
from linkax.simulation.read.observables import Observables, Power, Violation
from linkax.simulation.read.passages import Passages, passages
from linkax.simulation.read.reading import evaluate_dense, kept, read, read_in_motion
from linkax.simulation.read.summary import summary
from linkax.simulation.read.work import work
from linkax.simulation.start.initial_state import is_assembled, off_loops
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time, sound_numbers
from linkax.tables import printed_as
from linkax.xla.arrays import Array
from linkax.xla.derivatives import ratio
from linkax.xla.tracing import all_concrete, concrete, jit_inline, without_derivatives


@printed_as(summary)
class Solution(Kinematics):
    """A motion at the times `ts` [s].

    - `run`: what was integrated, and how; its `mechanism`, `formulation` and `accuracy` are the solution's own.
    - `q`, `v`: coordinates and speeds of the tree's joints, (n_t, n_q) and (n_t, n_v), on the
      closed loops with the paper's formulation. Times that were not reached hold infinity.
    - `internal`: internal states of force elements, (n_t, n_s), which `states` has by name; None where there are none.
    - `ys`: what a `SaveAt` with functions of its own saved; `q` and `v` are None then.
    - `t_end`, `end`: the time reached and the `State` there.
    - `stats`: as in diffrax: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
    - `result`: a `linkax.RESULTS`; equal to `RESULTS.successful` where all went well.
    - `rank_nearby`: rank along the motion, of each part that moves independently of the others, (k,);
      in a singular configuration `rank` is smaller than their sum.
    - `closest`: smallest distance from a singular configuration at any stage of any step; one where
      the formulation does not measure it. Without derivative, which `singularity_distance` has.
      `average`: the mean of that distance over the run.
    - `impact_record`: of each `linkax.Impact` how many there were since t0, and what energy they took [J], (n_t, 2, k);
      see `impacts`. None where there are none.
    - `definiteness`: of the mass matrix at the start, with whose inverse rounding of accelerations grows.

    All that is read by the methods below comes as arrays with times as the first axis, in ground
    axes and SI units. A solution from `jax.vmap` has the batch axes before that.
    """

    _elsewhere: ClassVar[str] = (
        "; what a force element does is its force(element), what a joint carries its reaction(joint)"
    )

    run: Run
    ts: Float[Array, "*batch n_t"] | Any
    q: Float[Array, "*batch n_t n_q"] | Any
    v: Float[Array, "*batch n_t n_v"] | Any
    internal: Float[Array, "*batch n_t n_s"] | Any
    ys: Any
    t_end: Float[Array, "*batch"]
    end: State
    stats: dict[str, Any]
    result: Any
    rank_nearby: Int[Array, "*batch k"] | None
    closest: Float[Array, "*batch"] | np.floating
    average: Float[Array, "*batch"] | np.floating
    definiteness: Float[Array, "*batch"] | np.floating
    interpolation: Any
    impact_record: Float[Array, "*batch n_t 2 stops"] | None = None

    @property
    def accuracy(self) -> Accuracy:
        """Tolerances and projection of the run."""
        return self.run.accuracy

    @property
    def formulation(self) -> AbstractFormulation:
        """The formulation of the equations of motion."""
        return self.run.formulation

    @staticmethod
    def of_run(run: Run, outcome: Outcome) -> "Solution":
        """What a run has left."""
        initial, integrated, end, saved = outcome
        return Solution(
            run=run.remembered(),
            ts=integrated.ts,
            q=None if saved is None else saved.q,
            v=None if saved is None else saved.v,
            internal=None if saved is None else saved.internal,
            ys=integrated.ys if saved is None else None,
            t_end=integrated.t_end,
            end=end,
            stats=integrated.stats,
            result=integrated.result,
            rank_nearby=initial.rank,
            closest=integrated.closest,
            average=integrated.average,
            definiteness=initial.definiteness,
            interpolation=integrated.interpolation,
            impact_record=record(run.mechanism, integrated.ys) if saved and impacts_of(run.mechanism) else None,
        )

    def another(self, run: Run) -> "Solution":
        """The solution of another run, such as a part of this one."""
        return Solution.of_run(run, integrate_run(run))

    @staticmethod
    def of_state(
        mechanism: Mechanism,
        state: State,
        *,
        t: Number = 0.0,
        accuracy: Accuracy = BALANCED,
        formulation: str | AbstractFormulation | None = None,
    ) -> "Solution":
        """A solution of one time, to read reactions, energies or accelerations at a `State` on the closed loops.

        **Raises:** `ValueError` for a state off the loops, in positions or in speeds; one at rest, as drawn, may lack
        the speeds that drives ask for, and a classical formulation may leave loops open. Inside JAX transformations,
        its `result` tells so, and of a state that `linkax.assemble` did not find.
        """
        state, method = checked_state(mechanism, state), checked_formulation(formulation, accuracy)
        check_accuracy(accuracy)
        solution = drawn(mechanism, state, t, method, accuracy)
        result, sound = solution.result, sound_numbers(mechanism)
        topology = mechanism.topology
        if topology.num_rows + topology.num_immobile_rows and not isinstance(method, ClassicalFormulation):
            # It only decides, and has no derivative.
            off = off_loops(*without_derivatives((solution.run.flat, solution.t_end, state)))
            if all_concrete(off) and not off.is_small:
                raise ValueError(f"state is off the loops: {_off(solution, off)}; make it with linkax.assemble")
            result = RESULTS.where(off.is_small, result, RESULTS.not_closed)
        if not concrete(sound):
            result = RESULTS.where(sound, result, RESULTS.not_finite)
        if concrete(state.v) is None:
            result = RESULTS.where(is_assembled(state) | jnp.logical_not(sound), result, RESULTS.not_assembled)
        return dataclasses.replace(solution, result=result)

    def reaction(self, name: str, *, on: Side = "child", axes: Axes = "ground") -> Any:
        """The reaction of a joint, or the force of a constraint.

        **Arguments:**

        - `name`: of a joint in the tree or cut, or of a constraint.
        - `on`: "child" or "parent" of the joint. The moment is about the origin of its frame.
        - `axes`: "ground", or "joint": h¹, h², h³ of the joint on that body.

        **Returns:** a `Reaction` of forces [N] and moments [N m], (n_t, 3) each. For a drive, its
        torque [N m] or force [N] along the joint, (n_t,); for a coupling, μ: it acts along each
        joint with coefficient × μ. A driven joint's own moment, or force, has no component along the drive: that is
        the reaction of the drive.

        With redundant constraints, reactions are not unique: these are of minimum norm, and
        `reaction_unique` tells which components can be relied upon. Of a run through a singular configuration they
        are limits along the motion there; not numbers where they have none, but grow without bound towards it.
        """
        if is_constraint(self, name):
            return of_constraint(Observables.constraint_forces, self, name)
        return reaction_of(Observables.reactions, self, name, on, axes)

    def reaction_unique(self, name: str, *, on: Side = "child", axes: Axes = "ground") -> Any:
        """Which components of `reaction` the mechanics determine, as booleans of the same shapes.

        A component is unique where no self-stress of the redundant constraints changes it
        (Wojtyra, Multibody System Dynamics 13, 2005). Rigid bodies determine no more: the rest
        depends on elasticity, assembly, and here on the choice of the tree.
        """
        if is_constraint(self, name):
            return of_constraint(Observables.unique_constraint_forces, self, name)
        return reaction_of(Observables.unique, self, name, on, axes)

    def reactions(self) -> dict[str, Reaction]:
        """The reactions of all joints on their children, in ground axes, by name."""
        force, moment = read_in_motion(Observables.reactions, self, "child", "ground")
        names = enumerate(self.mechanism.topology.joints)
        return ByName({name: Reaction(force[..., index, :], moment[..., index, :]) for index, name in names}, "joint")

    def energy(self) -> Float[Array, "*batch n_t"]:
        """Kinetic plus potential energy [J]."""
        kinetic, potential = read(Observables.energies, self)
        return kinetic + potential

    def kinetic_energy(self) -> Float[Array, "*batch n_t"]:
        """Kinetic energy [J]."""
        return read(Observables.energies, self)[0]

    def potential_energy(self) -> Float[Array, "*batch n_t"]:
        """Potential energy of the force elements that have one [J]."""
        return read(Observables.energies, self)[1]

    def power(self) -> Power:
        """The rate of `energy`, by what causes it [W], each (n_t,)."""
        return read_in_motion(Observables.power, self)

    def work(self) -> dict[str, Float[Array, "*batch n_t"]]:
        """Work of each element that puts energy in or takes it out, since the first saved time [J], (n_t,), by name.

        These are force elements beyond the fall of their potential energy (dampers, torques, forces of your own), by
        `Mechanism.force_names`, impacts, and constraints that change with time (drives, winches). Between saved times
        the motion is interpolated, with an error of work in proportion to the sixth power of the time between them.
        Where energy is not accounted for that way, as in a contact that is shorter, the motion of a single run is run
        again between the two saved times, with more of them; what is still not accounted for is told by an
        `AccuracyWarning`. Of a batch, and inside of JAX transformations, see `unaccounted_energy`.
        """
        return kept(self, "work", lambda: work(self))

    def impacts(self, name: str) -> Int[Array, "*batch n_t"]:
        """How many impacts on a stop there were since the run began, (n_t,); -1 at times that were not reached.

        **Arguments:** `name`: of a `linkax.Impact`, one of `mechanism.force_names`.

        **Raises:** `ValueError` for another name, and for states without the run that led to them.
        """
        stops = [
            name
            for name, force in zip(self.mechanism.force_names, self.mechanism.forces, strict=True)
            if isinstance(force, Impact)
        ]
        index = find(name, stops, "impact")
        if self.impact_record is None:
            raise ValueError("this solution is of states without the run that led to them; simulate, and save states")
        counts = self.impact_record[..., 0, index]
        return jnp.where(jnp.isfinite(counts), counts, -1.0).astype(int)

    def unaccounted_energy(self) -> Float[Array, "*batch n_t"]:
        """Change of `energy` since the first saved time, less all `work` [J]: an error.

        It is that of the integration, and of `work`; of batches that also where saved times are far apart or forces
        jump between them.
        """
        change = self.energy()
        return change - change[..., :1] - sum(self.work().values(), jnp.zeros_like(change))

    def force(self, element: str | AbstractElement | Distance) -> Float[Array, "..."]:
        """Force of one element, (n_t,).

        The pull [N] of a `Spring`, `Damper`, `ElasticRope`, `Rope` or `Distance`, negative where it pushes; the force
        on the child along the joint [N m or N] of a `JointSpring` and its like, or of a `Drive`. Of `PointForce` and
        `PointMoment` three numbers in ground axes, (n_t, 3).

        **Arguments:** `element`: its name, one of `mechanism.force_names`, a constraint or a `Distance`; or the element
        itself.

        **Raises:** `ValueError` for an unknown element, and for one that does not say which force it has.
        """
        return force_of(self, element)

    def states(self, element: str | AbstractForce) -> dict[str, Float[Array, "..."]]:
        """Internal states of a force element by name, such as currents and pressures, (n_t, ...) each.

        Units are those of the element's `states`.

        **Arguments:** `element`: its name, one of `mechanism.force_names`, or the element itself.

        **Raises:** `ValueError` for an unknown element, and for one without internal states.
        """
        return states_of(self, element)

    def violation(self) -> Violation:
        """Largest violation of the loop rows at each time."""
        return read_in_motion(Observables.violation_and_scales, self)[0]

    def worst_violation(self) -> Violation:
        """Over all times, relative: to the run's largest speed and acceleration where those apply.

        Positions count in radians and lengths of the loop, speeds and accelerations of the
        joints in radians and lengths of the mechanism; the square of a speed counts as an
        acceleration, since uniform motion of the joints accelerates the bodies.
        """
        return _worst(self.ts, *read_in_motion(Observables.violation_and_scales, self))

    def error_estimate(self, reading: "Callable[[Solution], Any] | None" = None, *, factor: Number = 1e-2) -> Any:
        """How far this run is off, found by a second one that is more accurate.

        The second run is in double precision, at tolerances `factor` times those of this one but not below 1e-13,
        or at half its steps where those are fixed. It takes once to twice the time of this run. What both have in
        common, such as a wrong mass or a reading that amplifies rounding, is not seen.

        **Arguments:** `reading`: what of a solution to compare, such as `lambda solution: solution.position("hook")`;
        default: `q`.

        **Returns:** the absolute difference, as what `reading` returns; not a number where either run stopped before.

        **Raises:** `ValueError` for a solution of one state, one that saved functions of its own, and steps
        that cannot be refined.
        """
        if not self.run.is_integrated or self.q is None:
            raise ValueError(
                "error_estimate needs the solution of a run that saved states: from linkax.simulate, "
                "without SaveAt(fn=...)"
            )
        between = lambda x: (x > 0.0) & (x < 1.0)
        factor = require(number(factor, (), "factor"), between, "factor", "it must lie between 0 and 1")
        return _difference(self, (lambda solution: solution.q) if reading is None else reading, factor)

    def remark(self) -> REMARKS:
        """What there is to say of a run that ended well, or of each of a batch: what a single run warns of.

        Equal to `REMARKS.none` where there is nothing; `REMARKS[...]` has it in words. The run of a member by itself
        names numbers and elements in its warning. Rates of elements, for `REMARKS.stiff`, are computed where a member
        took many steps, and inside of JAX transformations always, which compiles longer: better return the `Solution`.
        """
        return remark(self)

    def passages(self) -> Passages:
        """Times at which the motion goes through singular configurations, and the digits lost.

        Outside of JAX transformations, for one run.

        **Raises:** `ValueError` for a batch, or where functions of one's own were saved.
        """
        return passages(self)

    def to_dataframe(self) -> Any:
        """The motion as a `pandas.DataFrame`, of one run, at the times that were reached.

        Its columns are `time`; `joint.NAME` and `speed.NAME` of each joint in the tree, with a last `.0`, `.1`, …
        where it has several, of a quaternion `.w`, `.x`, `.y`, `.z`; and `position.NAME.x`, `.y`, `.z` of the centre of
        mass of each body, in ground axes. Its `attrs["units"]` has the unit of each column.

        **Raises:** `ImportError` without pandas; `ValueError` for a batch, and for a `SaveAt` with functions.
        """
        return to_dataframe(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the columns of `to_dataframe` to a file that other tools read: whole, or not at all.

        **Arguments:** `path`: with the suffix `.csv`, `.parquet` (by pyarrow, units in the metadata of the columns), or
        `.zarr` (a group with an array for each column, units in the attributes).

        **Raises:** `ValueError` for another suffix, and as `to_dataframe`; `ImportError` for Parquet without pyarrow.
        """
        save(self, path)

    def at(self, ts: Number | Vector | list[Number]) -> "Solution":
        """The same motion at other times between the saved ones, to be read as this one.

        Between two saved times the motion is a polynomial of degree five through q, q̇ and q̈ at both. Coordinates are
        off in proportion to the sixth power of the time between saved ones, speeds to the fifth; accelerations and
        reactions follow from these by the equations of motion; loops are closed. A pendulum saved 16 times a period is
        off by 9e-8 of its amplitude, and by 2e-6 of its speed; 33 times a period, by 1.4e-9 and 7e-8. Where a force
        jumps between saved times, the error falls with the second power alone. Derivatives by `ts` are those of the
        polynomial.

        **Arguments:** `ts`: a time [s], or times in any order, (n,); (*batch, n) for times of its own of each member of
        a batch.

        **Returns:** a `Solution` at these times. Inside of JAX transformations, where times are not known, one outside
        of the saved ones is infinite, as one that was not reached.

        **Raises:** `ValueError` for a time outside of the saved ones, for one between saved times so far apart that no
        state on the loops is near (infinite in a batch), for no time, and for a solution of one state.
        """
        return motion_at(self, ts)

    def evaluate(self, t: Number) -> State:
        """The state at a time [s] between the steps; needs `saveat=SaveAt(dense=True)`."""
        if self.interpolation is None:
            raise ValueError("evaluate needs a dense solution; simulate with saveat=diffrax.SaveAt(dense=True)")
        t, first, last = number(t, (), "t [s]"), concrete(self.interpolation.t0), concrete(self.t_end)
        if first is not None and last is not None and first.shape == ():
            during = lambda t: (t >= first) & (t <= last)
            t = require(t, during, "t [s]", f"give a time of the run, from {first} s to {last} s")
        given = self.run.flat, self.formulation, self.accuracy, self.rank_nearby, self.interpolation
        return evaluate_dense(*given, t)


def drawn(
    mechanism: Mechanism,
    state: State,
    t: Number = 0.0,
    formulation: AbstractFormulation = DEFAULT_FORMULATION,
    accuracy: Accuracy = BALANCED,
) -> Solution:
    """A solution of one time, to draw a state, on the loops or off."""
    state = checked_state(mechanism, state)
    t = jnp.asarray(checked_time(t, "t"), state.q.dtype)
    return Solution(
        run=Run.of_state(mechanism, state, t, formulation, accuracy),
        ts=t[None],
        q=state.q[None],
        v=state.v[None],
        internal=None if state.internal is None else state.internal[None],
        ys=None,
        t_end=t,
        end=state,
        stats={},
        result=RESULTS.successful,
        rank_nearby=None,
        closest=jnp.ones((), state.q.dtype),
        average=jnp.ones((), state.q.dtype),
        definiteness=jnp.ones((), state.q.dtype),
        interpolation=None,
    )


def _off(solution, off):
    """What a state off the loops misses."""
    if off.gap <= off.most:
        return f"they miss its speeds by {float(off.miss):.3g} of the largest one"
    system, state = system_of(solution.mechanism, solution.end.q.dtype), solution.end
    name, gap = widest_gap(system, solution.mechanism, solution.t_end, state.q)
    return f"{name!r} is open by {gap:.3g}, in radians or lengths of the mechanism"


@jit_inline
def _worst(ts, violation, speed, acceleration):
    largest = lambda values: jnp.max(jnp.where(jnp.isfinite(ts), values, 0.0), axis=-1)
    return Violation(
        largest(violation.position),
        ratio(largest(violation.velocity), largest(speed)),
        ratio(largest(violation.acceleration), largest(acceleration)),
    )


def _difference(solution, reading, factor):
    """Of a reading of a solution, or of all members of a batch, from that of a run at finer tolerances."""

    def of_member(solution):
        finer = solution.another(refined_run(solution, factor))
        there = jnp.isfinite(solution.ts) & jnp.isfinite(finer.ts)

        def apart(one, other):
            across = there.reshape(-1, *(1,) * (one.ndim - 1))
            return jnp.where(across, jnp.abs(one - other), jnp.nan)

        return jax.tree.map(apart, reading(solution), reading(finer))

    for _ in range(solution.ts.ndim - 1):
        of_member = eqx.filter_vmap(of_member)
    return of_member(solution)
