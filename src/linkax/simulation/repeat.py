"""A run once more, more accurately, which tells how far off the first one is."""

import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from linkax.simulation.integration import MechanismControl
from linkax.simulation.results import AccuracyWarning, StiffnessWarning

FINEST = 1e-13  # tolerance
REFINED_STEPS = 4  # as many as in the run before
DEFAULT_SAVES = 201
FEWEST = 51  # saved times, with fewer of which a part is saved at the default ones


class Repeat(eqx.Module):
    """What a run began with, to run it again; arrays, and what is none."""

    simulate: Callable = eqx.field(static=True)
    arrays: Any
    rest: Any = eqx.field(static=True)

    @staticmethod
    def of(simulate, *given) -> "Repeat":
        """From `linkax.simulate`, as it takes them: state, t0, dt0, solver, controller, max_steps, optimise.

        Last, whether it saved states at given times and nothing else.
        """
        return Repeat(simulate, *eqx.partition(given, lambda leaf: isinstance(leaf, jax.Array | np.ndarray)))

    def __call__(self, solution, factor):
        """A run at `factor` times its tolerances, or at half its steps, saved at the same times."""
        state, t0, dt0, solver, controller, max_steps, optimise, _ = eqx.combine(self.arrays, self.rest)
        accuracy = solution.accuracy
        if isinstance(MechanismControl(controller).innermost, diffrax.ConstantStepSize) and dt0 is not None:
            dt0 = 0.5 * dt0
        elif not MechanismControl(controller).is_adaptive:
            raise ValueError(f"steps of {type(controller).__name__} cannot be refined; use an adaptive controller")
        controller, accuracy = with_tolerances(lambda rtol: jnp.maximum(factor * rtol, FINEST), (controller, accuracy))
        return self._run(
            solution,
            state,
            t0=t0,
            t1=solution.t_end,
            accuracy=accuracy,
            saveat=diffrax.SaveAt(ts=jnp.where(jnp.isfinite(solution.ts), solution.ts, solution.t_end)),
            solver=solver,
            stepsize_controller=controller,
            dt0=dt0,
            max_steps=REFINED_STEPS * max_steps,
            optimise=optimise,
        )

    def part(self, solution, state, ts):
        """The motion from a state at the first of some times to the last, saved there, with the same options.

        By the same program where that saves as many.
        """
        _, _, dt0, solver, controller, max_steps, optimise, _ = eqx.combine(self.arrays, self.rest)
        padded = np.pad(ts, (0, self.num_saves(solution) - len(ts)), mode="edge")
        options = dict(solver=solver, stepsize_controller=controller, dt0=dt0, max_steps=max_steps, optimise=optimise)
        saveat, accuracy = diffrax.SaveAt(ts=padded), solution.accuracy
        return self._run(solution, state, t0=ts[0], t1=ts[-1], accuracy=accuracy, saveat=saveat, **options)

    def num_saves(self, solution) -> int:
        """States that a part saves at most."""
        saves_times = eqx.combine(self.arrays, self.rest)[-1]
        return len(solution.ts) if saves_times and len(solution.ts) >= FEWEST else DEFAULT_SAVES

    @property
    def start(self):
        """State and time that the run began with."""
        return eqx.combine(self.arrays, self.rest)[:2]

    @property
    def solver(self) -> diffrax.AbstractSolver:
        """Of the run."""
        return eqx.combine(self.arrays, self.rest)[3]

    @property
    def control(self) -> MechanismControl:
        """Of the run's steps."""
        return MechanismControl(eqx.combine(self.arrays, self.rest)[4])

    @property
    def has_parts(self) -> bool:
        """Whether a part of the motion can be run by itself: not where the steps themselves are given."""
        return not isinstance(self.control.innermost, diffrax.StepTo)

    def _run(self, solution, state, **options):
        formulation = solution.formulation
        with warnings.catch_warnings():
            for kind in (AccuracyWarning, StiffnessWarning):  # what a run is like, this one is to tell
                warnings.simplefilter("ignore", kind)
            return self.simulate(solution.mechanism, state, formulation=formulation, throw=False, **options)


def with_tolerances(change, tree):
    """A pytree with all entries named rtol or atol changed."""
    named = lambda path: path and getattr(path[-1], "name", None) in ("rtol", "atol")
    return jax.tree_util.tree_map_with_path(lambda path, leaf: change(leaf) if named(path) else leaf, tree)
