"""The command `linkax compare SCENE`, which compares formulations."""

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

from linkax.cli.options import (
    AtInterrupt,
    RunOptions,
    at_interrupt_in,
    end_progress,
    output_folder,
    progress,
    steps_in_words,
    write_json,
)
from linkax.cli.report import finite
from linkax.files import written_whole
from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.named import COMPARED, TANGENT_SPACE, formulation
from linkax.studies.sweeps.comparison import TIGHTEST, Stepping, at_equal_cost, compare
from linkax.studies.sweeps.comparison_result import Comparison, Trial

LADDER = (1e2, 1e1, 1.0, 1e-1, 1e-2, 1e-3, 1e-4)  # tolerances to choose from at equal cost, relative to --rtol
STEP_LADDER = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)  # steps likewise, relative to --dt
PART = "comparison-interrupted.json"
HEADER: tuple[str, ...] = (
    "formulation",
    "error [m]",
    "c",
    "J v - b",
    "J a - γ",
    "energy",
    "steps",
    "f(y)",
    "run [ms]",
    "verdict",
)
EQUAL = {"tolerance": "each at the same tolerance or step", "cost": "each in no more run time than the paper's needs"}


def run_compare(arguments: argparse.Namespace, at_interrupt: AtInterrupt) -> int:
    """Compare, write the files, print the verdicts, and return the exit code."""
    asked, chosen = RunOptions(arguments), _chosen(arguments)
    mechanism = asked.mechanism.with_all_rows() if arguments.all_rows else asked.mechanism
    settings = asked.described | {
        "formulations": list(chosen),
        "bound_given": arguments.bound,
        "equal": EQUAL[arguments.equal],
        "all_rows": arguments.all_rows,
    }
    out = output_folder(arguments.out, f"compare-{asked.folder}", settings, ("comparison.json", PART))
    at_interrupt_in(at_interrupt, out)
    exact = asked.scene.exact
    comparison = compare(
        mechanism,
        asked.initial(mechanism),
        asked.points,
        t1=asked.t1,
        steppings=_steppings(asked, arguments),
        formulations=chosen,
        exact=None if exact is None else lambda times: exact(asked.parameters, times),
        bound=arguments.bound,
        report=progress,
        keep=lambda comparison: at_interrupt_in(at_interrupt, out, partial(keep, out, settings, comparison)),
    )
    trials, budget = _trials_at_equal(comparison, asked, arguments)
    described = settings | {"budget_s": budget} | _described(comparison, trials)
    files = _write(at_interrupt, out, described, None if arguments.no_plots else comparison)
    end_progress()
    if arguments.json:
        print(json.dumps(described, allow_nan=False))
    else:
        print(_for_people(described, comparison, trials, files))
    return 0


def _write(at_interrupt, out, described, plotted) -> list[Path]:
    """Write the results, and the figure of a comparison where there is one to plot; returns the files."""
    files = [out / "comparison.json"]
    write_json(files[0], described)
    at_interrupt_in(at_interrupt, out, lambda: f"the comparison is in {files[0]}")
    (out / PART).unlink(missing_ok=True)
    if plotted is not None:
        from linkax.plot.comparison import comparison  # matplotlib takes its time

        with written_whole(out / "comparison.png") as path:
            comparison(plotted).savefig(path, dpi=130, format="png")
        files.append(out / "comparison.png")
    return files


def _chosen(arguments) -> dict[str, AbstractFormulation]:
    """{name: formulation} of those asked for; at equal cost the paper's, which sets the cost, is among them."""
    asked = arguments.formulations
    names = [*COMPARED] if asked is None else [name.strip() for name in asked.split(",")]
    if arguments.equal == "cost":
        names = [TANGENT_SPACE, *names]
    return {name: formulation(name) for name in names}


def _trials_at_equal(comparison, asked, arguments) -> tuple[list[Trial], float | None]:
    """The trials to show, and at equal cost the run time that they may take [s]."""
    if arguments.equal == "tolerance":
        return comparison.trials, None
    own = Stepping(asked.solver, float(asked.accuracy.rtol), arguments.dt)
    budget = next(t.run_s for t in comparison.trials if t.formulation == TANGENT_SPACE and _size(t) == _size(own))
    return at_equal_cost(comparison.trials, budget), budget


def _steppings(asked, arguments):
    """The stepping asked for, or at equal cost all to choose from."""
    if arguments.dt is not None:
        factors = STEP_LADDER if arguments.equal == "cost" else (1.0,)
        return [Stepping(asked.solver, step=arguments.dt * factor) for factor in factors]
    rtol = float(asked.accuracy.rtol)
    if arguments.equal == "tolerance":
        return [Stepping(asked.solver, rtol=rtol)]
    return [
        Stepping(asked.solver, rtol=rtol * factor) for factor in LADDER if factor >= 1.0 or rtol * factor >= TIGHTEST
    ]


def keep(out: Path, settings: dict[str, Any], comparison: Comparison) -> str:
    """Write an interrupted comparison, to another file than a whole one, and tell where it is."""
    write_json(out / PART, settings | _described(comparison, comparison.trials) | {"result": "interrupted"})
    return f"what was compared is in {out / PART}"


def _described(comparison, trials) -> dict[str, Any]:
    """A comparison as JSON holds it."""
    return comparison._asdict() | {"verdicts": _verdicts(comparison), "trials": [_entries(trial) for trial in trials]}


def _entries(trial) -> dict[str, Any]:
    """A trial as JSON holds it."""
    return {name: finite(entry) if isinstance(entry, float) else entry for name, entry in trial._asdict().items()}


def _size(stepping):
    """The tolerance or the step of a `Stepping` or a `Trial`."""
    return stepping.rtol if stepping.step is None else stepping.step


def _verdicts(comparison) -> str:
    """What the verdicts mean, in words."""
    return f"diverged: the run ended early, or a point was off by more than {comparison.bound:.3g} m; else converged"


def _for_people(described, comparison, trials, files) -> str:
    """A table of the trials, and why those that diverged did."""
    rows = [HEADER]
    for trial in trials:
        size = "" if described["equal"] == EQUAL["tolerance"] else f" ({_size(trial):.0e})"
        violations = (trial.position_violation, trial.velocity_violation, trial.acceleration_violation)
        rows.append(
            (
                trial.formulation + size,
                *(f"{n:.1e}" if trial.reached > 0.0 else "-" for n in (trial.error, *violations, trial.energy_error)),
                str(trial.steps),
                str(trial.evaluations or ""),
                f"{1e3 * trial.run_s:.1f}",
                trial.verdict,
            )
        )
    widths = [max(len(row[place]) for row in rows) for place in range(len(rows[0]))]
    line = lambda row: "  ".join(
        [row[0].ljust(widths[0]), *(e.rjust(w) for e, w in zip(row[1:], widths[1:], strict=True))]
    )
    budget = "" if described["budget_s"] is None else f", {1e3 * described['budget_s']:.1f} ms"
    answer = comparison.answer
    answer += "" if answer == "closed form" else f", good to {comparison.uncertainty:.0e} m"
    why = [f"  {trial.formulation}: {trial.why}" for trial in trials if trial.why]
    return "\n".join(
        [
            f"{described['scene']} {described['variant']}, {described['t1']:g} s, {described['solver']}, "
            f"{steps_in_words(described)}; {described['equal']}{budget}",
            f"error: largest distance from the {answer}; c, J v - b, J a - γ: worst violations, relative",
            described["verdicts"],
            "",
            *map(line, rows),
            *(["", "why diverged:", *why] if why else []),
            "written: " + ", ".join(map(str, files)),
        ]
    )
