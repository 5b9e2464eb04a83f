"""The result of a comparison of formulations."""

from typing import NamedTuple


class Trial(NamedTuple):
    """One run of a formulation.

    - `rtol`: tolerance of adaptive steps, or `step`: size of fixed ones [s]; the other is None.
    - `error`: largest distance of any point from the known answer, at all times reached [m].
    - `position_violation`, `velocity_violation`, `acceleration_violation`: see `Solution.worst_violation`.
    - `energy_error`: largest difference from the reference run's energy, relative to that run's largest kinetic energy;
      in joules where nothing moves.
    - `steps`: of the solver. `evaluations`: of the equations of motion; None where the solver does not tell.
    - `run_s`: wall time [s]. `reached`: time at which the run ended [s].
    - `verdict`: "converged", or "diverged" where the run ended early or its error exceeds the bound.
    - `diverged_at`: time at which it ended early, or its error first exceeded the bound [s]; None where it converged.
    - `why`: how it diverged, in words.
    """

    formulation: str
    rtol: float | None
    step: float | None
    error: float
    position_violation: float
    velocity_violation: float
    acceleration_violation: float
    energy_error: float
    steps: int
    evaluations: int | None
    run_s: float
    reached: float
    verdict: str
    diverged_at: float | None
    why: str


class Comparison(NamedTuple):
    """Trials of several formulations, and the answer that they are compared with.

    - `answer`: "closed form", or "reference run": of the paper's formulation at a tolerance of 1e-13.
    - `uncertainty`: largest distance of the reference run from the closed form, or from a run at 1e-12 [m].
    - `bound`: a trial with a larger error counts as diverged [m].
    - `passages`: times at which the motion passes singular configurations [s].
    """

    answer: str
    uncertainty: float
    bound: float
    passages: list[float]
    trials: list[Trial]
