"""A solution, and what is read from it, as tables."""

from typing import Any

import numpy as np

from linkax.simulation.integrate.results import KNOWN_RESULTS, RESULTS, Solution
from linkax.simulation.start.state import joint_rows
from linkax.tables import Rows, Table, among, batch, count, known, numbers
from linkax.xla.enumerations import code


def summary(solution: Solution) -> Table:
    """How a run went, and where its joints were at its start and its end."""
    run, topology, codes = solution.run, solution.mechanism.topology, known(code(solution.result))
    times = solution.ts.shape[-1]
    if times == 1 and not run.is_integrated:
        title = f"Solution at t = {numbers(solution.t_end, 's')}"
    else:
        title = f"Solution of {count(times, 'time')}, {_times(run.t0, solution.t_end)}: {_results(codes)}"
    facts = [("formulation", type(solution.formulation).__name__)]
    if run.is_integrated:
        steps = {name: numbers(solution.stats[name]) for name in ("num_steps", "num_rejected_steps")}
        facts.append(("steps", f"{steps['num_steps']} ({steps['num_rejected_steps']} rejected) by {_solver(solution)}"))
        facts.append(
            ("distance", f"{numbers(solution.closest)} from a singular configuration at the nearest (1 is far)")
        )
    states = run.state.q, solution.end.q, solution.end.v
    rows, head = [("q", numbers(solution.q))], ()
    if not run.is_integrated:
        head = ("joint", "coordinate", "speed")
        rows = joint_rows(topology, (states[1], False), (states[2], True))
    elif all(known(array) is not None for array in (*states, solution.q)):
        head = ("joint", "at the start", "at the end", "speed at the end", "range")
        moved = np.where(np.isfinite(known(solution.q)), known(solution.q), np.nan)
        rows = joint_rows(topology, (states[0], False), (states[1], False), (states[2], True), (moved, False))
    elif solution.q is None:
        rows = [("ys", "saved by a function of your own")]
    return Table(title + batch(solution.t_end.shape), [Rows((), facts), Rows(head, rows, "joints")])


def _times(t0, t_end):
    return f"from {numbers(t0)} to {numbers(t_end, 's')}"


def _results(codes):
    if codes is None:
        return "traced"
    if codes.shape == ():
        return next((name for name in KNOWN_RESULTS if int(codes) == int(code(getattr(RESULTS, name)))), "failed")
    names = {int(code(getattr(RESULTS, name))): name for name in KNOWN_RESULTS}
    found, sizes = np.unique(codes, return_counts=True)
    return ", ".join(f"{size} {names.get(int(each), 'failed')}" for each, size in zip(found, sizes, strict=True))


def _solver(solution):
    options = solution.run.options
    rtol = getattr(options.controller, "rtol", None)
    return type(options.solver).__name__ + ("" if rtol is None else f", rtol {numbers(rtol)}")


def of_power(power: Any) -> Table:
    """The table of a `linkax.Power`."""
    rows = [("forces", numbers(power.forces, "W")), ("drives", numbers(power.drives, "W"))]
    return Table("Power" + among(np.shape(power.forces)), [Rows((), rows)])


def of_violation(violation: Any) -> Table:
    """The table of a `linkax.Violation`."""
    rows = [(name, numbers(values)) for name, values in violation._asdict().items()]
    return Table("Violation of the loops" + among(np.shape(violation.position)), [Rows((), rows)])
