"""An initial value problem, and what integrates it: diffrax."""

import dataclasses
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.simulation.integrate import diffrax_contract
from linkax.simulation.integrate.diffrax_contract import SolverState
from linkax.simulation.integrate.problem import Problem, derivative
from linkax.simulation.integrate.projected_solver import ProjectedSolver
from linkax.simulation.integrate.step_control import MechanismControl
from linkax.simulation.integrate.step_record import LoopState, Size, StepRecord
from linkax.xla.arrays import Array

TERM = diffrax.ODETerm(derivative)


class InitialValueProblem(NamedTuple):
    """What a motion depends on: a problem, the state y0 at t0, the last time t1, and the saved times."""

    problem: Problem
    y0: Float[Array, " n"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]
    saved: Float[Array, " k"] | None


class Integrator(eqx.Module):
    """What `diffrax.diffeqsolve` is given beside an initial value problem."""

    dt0: Any
    saveat: diffrax.SaveAt
    solver: ProjectedSolver
    controller: MechanismControl
    adjoint: diffrax.AbstractAdjoint
    event: diffrax.Event | None
    progress_meter: diffrax.AbstractProgressMeter
    max_steps: int | None = eqx.field(static=True)


def solved(
    ivp: InitialValueProblem, integrator: Integrator, saveat: diffrax.SaveAt, *, state: SolverState | None = None
) -> Any:
    """Integrate an initial value problem, by a solver in a `state`. Returns a `diffrax.Solution`."""
    with diffrax_contract.times_in_order():
        return diffrax.diffeqsolve(
            TERM,
            integrator.solver,
            ivp.t0,
            ivp.t1,
            integrator.dt0,
            ivp.y0,
            ivp.problem,
            saveat=saveat,
            stepsize_controller=integrator.controller,
            adjoint=integrator.adjoint,
            event=integrator.event,
            max_steps=integrator.max_steps,
            throw=False,
            progress_meter=integrator.progress_meter,
            solver_state=state,
        )


def recording(ivp: InitialValueProblem, integrator: Integrator) -> Integrator:
    """The same, which keeps a `StepRecord` in the state of its step control."""
    state = _any_state(ivp, integrator)
    control = dataclasses.replace(
        integrator.controller, records=Size.of(cast(int, integrator.max_steps)), solver=state.inner
    )
    return dataclasses.replace(integrator, controller=control)


def recorded_again(ivp: InitialValueProblem, integrator: Integrator, start: LoopState, tries: int) -> StepRecord:
    """Integrate from a start on, and give the record of at most so many tries."""
    state = _any_state(ivp, integrator)
    # diffrax makes numbers of what it hands on in an error.
    kept = jax.tree.map(lambda kept, like: kept.astype(like.dtype), start.solver, state.inner)
    control = dataclasses.replace(integrator.controller, records=Size(tries, 1), start=start, solver=kept)
    integrator = dataclasses.replace(
        integrator, dt0=None, controller=control, progress_meter=diffrax.NoProgressMeter(), max_steps=tries
    )
    saveat = diffrax.SaveAt(t1=True, controller_state=True)
    ivp = ivp._replace(t0=start.t0, y0=start.y)
    return solved(ivp, integrator, saveat, state=state._replace(inner=kept)).controller_state.record


def _any_state(ivp, integrator):
    """A state of the solver, whose numbers say nothing."""
    like = eqx.filter_eval_shape(integrator.solver.init, TERM, ivp.t0, ivp.t1, ivp.y0, ivp.problem)
    return jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), like)
