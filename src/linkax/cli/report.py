"""Summarise a run in numbers, and collect its trajectory."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from linkax.cli.progress_run import TimedRun
from linkax.simulation.integrate.results import RESULTS, result_name
from linkax.simulation.read.solution import Solution

Points = Mapping[str, tuple[str, str | None]]


def summary(run: TimedRun, points: Points) -> dict[str, Any]:
    """Steps, times, violations, energy, rank, passages, result and final positions of a run, as JSON holds them.

    - Violations are relative, see `Solution.worst_violation`.
    - `energy_unaccounted`: largest change of the energy less the work of drives, dampers and other forces, relative to
      the largest kinetic energy; in joules where nothing moves. `work`: of each until the end [J].
    - `singularity_distance`: the smallest at a saved time. `passages`: times through singular configurations [s].
      `digits_lost`: in these, see `Solution.passages`.
    - Numbers that are not finite, or not measured, are None.

    **Arguments:** `points`: {name: (body, frame of the body or None for its centre of mass)}.
    """
    solution = run.solution
    reached = np.isfinite(np.asarray(solution.ts))
    violation = solution.worst_violation()
    kinetic, unaccounted = (
        np.asarray(values)[reached] for values in (solution.kinetic_energy(), solution.unaccounted_energy())
    )
    rank = np.asarray(solution.rank())[reached]
    drift, scale = np.max(np.abs(unaccounted), initial=0.0), np.max(kinetic, initial=0.0)
    passed = solution.passages()
    last = np.flatnonzero(reached)[-1] if np.any(reached) else 0
    return {
        "steps": int(solution.stats["num_steps"]),
        "rejected_steps": int(solution.stats["num_rejected_steps"]),
        "compile_s": run.compile_s,
        "run_s": run.run_s,
        "position_violation": finite(violation.position),
        "velocity_violation": finite(violation.velocity),
        "acceleration_violation": finite(violation.acceleration),
        "energy_unaccounted": finite(drift / scale if scale > 0.0 else drift),
        "work": {name: finite(np.asarray(done)[last]) for name, done in solution.work().items()},
        "rank_min": int(np.min(rank, initial=rank[0] if len(rank) else 0)),
        "rank_max": int(np.max(rank, initial=0)),
        "singularity_distance": finite(np.min(np.asarray(solution.singularity_distance())[reached], initial=1.0)),
        "passages": [float(time) for time in passed.times],
        "digits_lost": finite(passed.digits),
        "result": result_name(solution.result),
        "message": "" if result_name(solution.result) == "successful" else str(RESULTS[solution.result]),
        "t_end": finite(solution.t_end),
        "final": {
            name: [finite(part) for part in np.asarray(solution.position(body, at))[last]]
            for name, (body, at) in points.items()
        },
    }


def finite(number: ArrayLike) -> float | None:
    """A number as JSON holds it, which has no infinity: None where it is not finite."""
    value = float(np.asarray(number))
    return value if np.isfinite(value) else None


def trajectory(solution: Solution, points: Points) -> dict[str, np.ndarray]:
    """Arrays for an NPZ file, with times as the first axis, in SI units and ground axes.

    - `t`, `q`, `v`, `coordinates`, `speeds`: see `states`; `energy`; `rank`; `position_violation`,
      `velocity_violation`, `acceleration_violation` as in `linkax.Violation`.
    - `position_NAME`, `velocity_NAME`, `acceleration_NAME` of each named point.
    - `force_NAME`, `moment_NAME`: reaction of each joint on its child.
    """
    kept = states(solution) | {"energy": solution.energy(), "rank": solution.rank()}
    kept |= {f"{level}_violation": values for level, values in solution.violation()._asdict().items()}
    for name, (body, at) in points.items():
        kept[f"position_{name}"] = solution.position(body, at)
        kept[f"velocity_{name}"] = solution.velocity(body, at)
        kept[f"acceleration_{name}"] = solution.acceleration(body, at)
    for joint, reaction in solution.reactions().items():
        kept[f"force_{joint}"], kept[f"moment_{joint}"] = reaction
    return {name: np.asarray(values) for name, values in kept.items()}


def states(solution: Solution) -> dict[str, np.ndarray]:
    """The arrays of a trajectory that need no further compilation.

    - `t`: times, (n_t,) [s]. `q`, `v`: coordinates and speeds of the tree's joints, (n_t, n_q) and (n_t, n_v).
    - `internal`: internal states of force elements, (n_t, n_s), where there are some.
    - `coordinates`, `speeds`: the joint of each column of `q` and `v`.
    """
    topology = solution.mechanism.topology
    owners = lambda slices: [name for name, columns in slices.items() for _ in range(columns.stop - columns.start)]
    kept = {"t": solution.ts, "q": solution.q, "v": solution.v}
    kept |= {} if solution.internal is None else {"internal": solution.internal}
    kept |= {"coordinates": owners(topology.coordinates), "speeds": owners(topology.speeds)}
    return {name: np.asarray(values) for name, values in kept.items()}
