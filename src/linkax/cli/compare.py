"""`linkax compare SCENE`: formulations side by side."""

import json
from functools import partial

from linkax.cli.options import (
    RunOptions,
    add_run_options,
    at_interrupt_in,
    end_progress,
    one_of,
    output_folder,
    positive,
    progress,
    steps_in_words,
    write_json,
)
from linkax.cli.report import finite
from linkax.formulations.named import BASES, COMPARED, TANGENT_SPACE, formulation
from linkax.studies.comparison import TIGHTEST, Comparison, Stepping, at_equal_cost, compare
from linkax.studies.files import written_whole

LADDER = (1e2, 1e1, 1.0, 1e-1, 1e-2, 1e-3, 1e-4)  # tolerances, of the one asked for, from which equal cost chooses
STEP_LADDER = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)  # steps likewise
PART = "comparison-interrupted.json"
EQUAL = {"tolerance": "each at the same tolerance or step", "cost": "each in no more run time than the paper's needs"}


def add_command(commands):
    """Add the command to the parser."""
    parser = commands.add_parser(
        "compare",
        help="integrate a scene by all formulations, and compare errors, violations and cost",
        epilog=f"A NAME is {TANGENT_SPACE} (the paper's), or one of {', '.join(BASES)}, with "
        "+baumgarte added, and +partitioning or +projection.",
    )
    parser.set_defaults(command=_compare)
    add_run_options(parser)
    names = "formulations, separated by commas (default: sixteen, about two minutes, most of it compiling)"
    parser.add_argument("--formulations", default=",".join(COMPARED), metavar="NAME,...", help=names)
    equal = "; ".join(f"{name}: {meaning}" for name, meaning in EQUAL.items())
    parser.add_argument("--equal", default="tolerance", type=one_of(EQUAL), metavar="WHAT", help=equal)
    parser.add_argument("--bound", type=positive, metavar="M", help="an error above it [m] counts as diverged")
    parser.add_argument(
        "--all-rows", action="store_true", help="with the loop rows too that no motion changes, which linkax leaves out"
    )


def _compare(arguments):
    asked = RunOptions(arguments)
    names = {name.strip(): formulation(name.strip()) for name in arguments.formulations.split(",")}
    if arguments.equal == "cost":
        names = {TANGENT_SPACE: formulation(TANGENT_SPACE)} | names
    mechanism = asked.mechanism.with_all_rows() if arguments.all_rows else asked.mechanism
    settings = asked.display_name | {
        "formulations": list(names),
        "bound_given": arguments.bound,
        "equal": EQUAL[arguments.equal],
        "all_rows": arguments.all_rows,
    }
    out = output_folder(arguments.out, f"compare-{asked.scene.name}", settings, ("comparison.json", PART))
    at_interrupt_in(out)
    exact = asked.scene.exact
    found = compare(
        mechanism,
        asked.initial(mechanism),
        asked.points,
        t1=asked.t1,
        steppings=_steppings(asked, arguments),
        formulations=names,
        exact=None if exact is None else lambda times: exact(asked.parameters, times),
        bound=arguments.bound,
        report=progress,
        keep=lambda found: at_interrupt_in(out, partial(keep, out, settings, found)),
    )
    trials, budget = found.trials, None
    if arguments.equal == "cost":
        own = Stepping(asked.solver, float(asked.accuracy.rtol), arguments.dt)
        budget = next(t.run_s for t in trials if t.formulation == TANGENT_SPACE and _size(t) == _size(own))
        trials = at_equal_cost(trials, budget)
    described = settings | {"budget_s": budget} | _described(found, trials)
    write_json(out / "comparison.json", described)
    files = [out / "comparison.json"]
    at_interrupt_in(out, lambda: f"the comparison is in {files[0]}")
    (out / PART).unlink(missing_ok=True)
    if not arguments.no_plots:
        from linkax.plotting.comparison import plot_comparison  # matplotlib takes its time

        with written_whole(out / "comparison.png") as path:
            plot_comparison(found).savefig(path, dpi=130, format="png")
        files.append(out / "comparison.png")
    end_progress()
    print(json.dumps(described, allow_nan=False) if arguments.json else _for_people(described, found, trials, files))
    return 0


def _steppings(asked, arguments):
    """The one asked for, or those that equal cost chooses from."""
    if arguments.dt is not None:
        factors = STEP_LADDER if arguments.equal == "cost" else (1.0,)
        return [Stepping(asked.solver, step=arguments.dt * factor) for factor in factors]
    rtol = float(asked.accuracy.rtol)
    if arguments.equal == "tolerance":
        return [Stepping(asked.solver, rtol=rtol)]
    return [
        Stepping(asked.solver, rtol=rtol * factor) for factor in LADDER if factor >= 1.0 or rtol * factor >= TIGHTEST
    ]


def keep(out, settings, found) -> str:
    """Write what an interrupted comparison has found, apart from a whole one."""
    write_json(out / PART, settings | _described(found, found.trials) | {"result": "interrupted"})
    return f"what was compared is in {out / PART}"


def _described(found, trials) -> dict:
    """A comparison for JSON."""
    return found._asdict() | {"verdicts": _verdicts(found), "trials": [_entries(trial) for trial in trials]}


def _entries(trial):
    """A trial for JSON."""
    return {name: finite(entry) if isinstance(entry, float) else entry for name, entry in trial._asdict().items()}


def _size(stepping):
    return stepping.rtol if stepping.step is None else stepping.step


def _verdicts(found: Comparison) -> str:
    """What the verdicts mean."""
    return f"diverged: the run ended early, or a point was off by more than {found.bound:.3g} m; else converged"


def _for_people(described, found, trials, files):
    rows = [("formulation", "error [m]", "c", "J v - b", "J a - γ", "energy", "steps", "f(y)", "run [ms]", "verdict")]
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
    answer = found.answer if found.answer == "closed form" else f"{found.answer}, good to {found.uncertainty:.0e} m"
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
