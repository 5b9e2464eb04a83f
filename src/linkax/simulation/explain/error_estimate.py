"""A run once more: more accurately, which tells how far off it is, or a part of it."""

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.options import save_at, with_tolerances
from linkax.simulation.integrate.results import Solution
from linkax.simulation.integrate.run import DEFAULT_SAVES, Run, cast
from linkax.simulation.start.state import State
from linkax.xla.arrays import Array

FINEST = 1e-13  # tolerance
REFINED_STEPS = 4  # as many as in the run before
FEWEST = 51  # saved times, with fewer of which a part is saved at the default ones


def refined_run(solution: Solution, factor: Float[Array, ""]) -> Run:
    """The run of a solution in double precision, at `factor` times its tolerances, or at half its steps.

    **Raises:** `ValueError` for steps that cannot be refined.
    """
    run = solution.run
    options, accuracy, dt0 = run.options, run.accuracy, run.options.dt0
    if isinstance(run.control.innermost, diffrax.ConstantStepSize) and dt0 is not None:
        dt0 = 0.5 * dt0
    elif not run.control.is_adaptive:
        raise ValueError(f"steps of {type(options.controller).__name__} cannot be refined; use an adaptive controller")
    finer = lambda rtol: jnp.maximum(factor * rtol, FINEST)
    controller, accuracy = with_tolerances(finer, (options.controller, accuracy))
    ts = jnp.where(jnp.isfinite(solution.ts), solution.ts, solution.t_end)
    return _in_double(run, run.state, accuracy).changed(
        t1=solution.t_end,
        saveat=save_at(ts),
        controller=controller,
        dt0=dt0,
        max_steps=None if options.max_steps is None else REFINED_STEPS * options.max_steps,
    )


def part_of_run(solution: Solution, state: State, ts: Float[np.ndarray, " n"]) -> Run:
    """Make the run from `state` at ts[0] to ts[-1], saved at ts, in double precision.

    `ts` is padded to as many times as the solution saved, so that no new program compiles.
    """
    padded = np.pad(ts, (0, num_saves(solution) - len(ts)), mode="edge")
    run = _in_double(solution.run, state, solution.accuracy)
    return run.changed(t0=ts[0], t1=ts[-1], saveat=save_at(padded))


def _in_double(run: Run, state: State, accuracy: Accuracy) -> Run:
    """A run from a state at an accuracy, in double precision."""
    flat, state, t0, accuracy = cast((run.flat, state, run.t0, accuracy), jnp.dtype(float))
    return run.changed(flat=flat, state=state, t0=t0, accuracy=accuracy)


def num_saves(solution: Solution) -> int:
    """States that a part of a run saves at most."""
    return len(solution.ts) if solution.run.saves_times and len(solution.ts) >= FEWEST else DEFAULT_SAVES


def has_parts(solution: Solution) -> bool:
    """Whether a part of the motion can be run by itself: not where steps are given, nor for a single state."""
    run = solution.run
    return run.is_integrated and not isinstance(run.control.innermost, diffrax.StepTo)
