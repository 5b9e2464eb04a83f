"""diffrax's integration of an initial value problem, differentiated by its accepted steps in both modes."""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from linkax.simulation.integrate import diffrax_contract
from linkax.simulation.integrate.integrator import InitialValueProblem, Integrator, recording, solved
from linkax.simulation.integrate.results import RESULTS
from linkax.simulation.integrate.step_derivatives import Trajectory, cotangents_over_steps, tangents_over_steps
from linkax.simulation.integrate.step_record import StepRecord
from linkax.xla.arrays import Array
from linkax.xla.derivatives import materialise
from linkax.xla.primitives import primitive

NO_REVERSE = (
    "Reverse-mode derivatives of reverse-mode derivatives of a simulation do not exist. Take second derivatives "
    "forwards: jax.jacfwd(jax.jacfwd(loss)), or jax.jvp(jax.grad(loss), ...) for a Hessian times a vector."
)


class Integrated(NamedTuple):
    """What an integration leaves: times and values saved, those at its end, and how it ended.

    `closest`, `average`: the smallest and the mean distance from a singular configuration.
    """

    ts: Any
    ys: Any
    t_end: Float[Array, ""]
    y_end: Float[Array, " n"]
    stats: dict
    result: Any
    closest: Float[Array, ""]
    average: Float[Array, ""]
    interpolation: Any


def has_discrete_adjoint(
    solver: diffrax.AbstractSolver, saveat: diffrax.SaveAt, event: diffrax.Event | None, max_steps: int | None
) -> bool:
    """Whether a run is differentiated here: explicit Runge-Kutta steps, saved states and no event."""
    plain = isinstance(saveat.subs, diffrax.SubSaveAt) and not saveat.subs.steps and not saveat.dense
    explicit = isinstance(solver, diffrax.AbstractERK) and isinstance(solver.tableau, diffrax.ButcherTableau)
    return plain and explicit and event is None and max_steps is not None


def solve_by_diffrax(
    ivp: InitialValueProblem, integrator: Integrator, track: bool
) -> tuple[Integrated, StepRecord | None]:
    """Solve an initial value problem; what derivatives there are, are those of diffrax's adjoint.

    **Returns:** an `Integrated`, and the `StepRecord` if steps are to be tracked, else None.
    """
    saveat = integrator.saveat
    if ivp.saved is not None:
        saveat = eqx.tree_at(lambda s: s.subs.ts, saveat, ivp.saved)
    saveat = eqx.tree_at(
        lambda s: (s.subs, s.solver_state, s.controller_state),
        saveat,
        ((saveat.subs, diffrax.SubSaveAt(t1=True)), True, track),
        is_leaf=lambda leaf: leaf is None,
    )
    solution = solved(ivp, recording(ivp, integrator) if track else integrator, saveat)
    (ts, t_end), (ys, y_end) = solution.ts, solution.ys
    average = lax.stop_gradient(diffrax_contract.integral_of_distance(y_end[0]) / (t_end[0] - ivp.t0))
    closest = diffrax_contract.closest(solution)
    record = solution.controller_state.record if track else None
    result = RESULTS.promote(solution.result)
    result = RESULTS.where(diffrax_contract.locked(solution), RESULTS.locked, result)
    end = t_end[0], y_end[0], solution.stats, result
    return Integrated(ts, ys, *end, closest, average, solution.interpolation), record


# The same with the derivatives of `tangents_over_steps`, in both modes: of `ts`, `t_end`, `ys` and `y_end`.
integrate = eqx.filter_custom_jvp(solve_by_diffrax)


@integrate.def_jvp
def _integrate_jvp(primals, tangents):
    """The tangents of states, and of the tracked record, which derivatives of cotangents need."""
    (ivp, integrator, track), (tangents, *_) = primals, tangents
    integrated, record = integrate(ivp, integrator, True)
    # In one array, which is one of a batch where anything is: JAX could not transpose a batch with parts in common.
    flat, restored = ravel_pytree(tangents)
    flat = flat + (record.count < 0)
    trajectory = _tangents(integrator, track, ivp, record, restored, flat)
    begin, end = materialise(ivp.t0, tangents.t0), materialise(ivp.t1, tangents.t1)
    saved = None if ivp.saved is None else materialise(ivp.saved, tangents.saved)
    row_by_row = lambda *parts: _rows(integrator.saveat.subs, *parts)
    nothing = jax.tree.map(lambda _: None, integrated)
    to_integrated = nothing._replace(
        ts=row_by_row(begin, saved, end),
        # The end's time is t1, unless the integration ended before.
        t_end=jnp.where(integrated.t_end == ivp.t1, end, 0.0),
        ys=row_by_row(materialise(ivp.y0, tangents.y0), trajectory.saved, trajectory.end),
        y_end=trajectory.end,
    )
    if not track:
        return (integrated, None), (to_integrated, None)
    return (integrated, record), (to_integrated, trajectory.of_record(record))


def _rows(sub, y0, saved, end):
    """What diffrax saves, of values at the start, at saved times, and at the end."""
    parts = [y0[None]] * sub.t0 + [saved] * (sub.ts is not None) + [end[None]] * sub.t1
    return jnp.concatenate(parts)


# `tangents_over_steps` as a primitive, linear in its last argument, the tangents in one array: only so can one function
# have a forward and a backward rule.


def _evaluate(integrator, every, ivp, record, restored, flat):
    return tangents_over_steps(integrator, every, ivp, record, restored(flat))


def _abstract(integrator, every, ivp, record, restored, flat):
    n = ivp.y0.shape
    of = lambda shape: ShapedArray(shape, ivp.y0.dtype)
    like = record.ys, record.ts, record.starts.y, record.starts.t0
    of_record = [of(part.shape) if every else None for part in like]
    shapes: Any = None if ivp.saved is None else of(ivp.saved.shape + n), of(n), *of_record
    return Trajectory(*shapes)


def _jvp(primals, tangents):
    return eqx.filter_jvp(_evaluate, primals, tangents)


def _transpose(inputs, cotangent):
    integrator, every, ivp, record, restored, flat = inputs
    if every:
        raise NotImplementedError(NO_REVERSE)
    tangents = jax.eval_shape(restored, flat.aval)
    wanted = jax.tree.map(lambda tangent: tangent is not None, tangents, is_leaf=lambda leaf: leaf is None)
    flat, _ = ravel_pytree(cotangents_over_steps(integrator, ivp, record, wanted, cotangent))
    none = lambda tree: jax.tree.map(lambda _: None, tree)
    return none(integrator), none(every), none(ivp), none(record), None, flat


_tangents = primitive("discrete_adjoint", _evaluate, _abstract, _jvp, _transpose)
