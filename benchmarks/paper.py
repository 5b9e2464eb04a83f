"""The paper's figures 8 to 11 and 13 to 15, and its Table 5, with linkax.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
Parts, chosen by `--part`:

- `slider`: figures 8 and 11: motion of the slider and force of its guide, SC1, against reference data.
- `violations`: figures 9 and 10: violations of LM2 + Baumgarte, ALF and the paper's method, SC1, until they fail.
- `four-link`: figures 13 to 15: singular positions; point C against the exact solution.
- `table-5`: verdicts of the twelve formulations, from both starts, without and with gravity, with three kinds of steps.
- `table-5-differences`: the same with other parameters, which explains where verdicts differ from the paper's.

Each writes its pictures into `--out` (default: linkax-out/paper); all of them together, without `--part`, the page
README.md as well, of which benchmarks/paper keeps a copy. About ten minutes.
"""

import functools
import sys
from pathlib import Path

import diffrax
import numpy as np
from matplotlib.figure import Figure

import linkax as lx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from known_answers import reference, start

from benchmarks.parts import print_parts
from linkax import plot
from linkax.scenery.colours import BLUE, GREEN, VERMILION
from linkax.scenes import SCENES
from linkax.simulation.simulate import fixed_steps
from linkax.studies.sweeps.comparison import Stepping, compare

COLOURS = (BLUE, VERMILION, GREEN)
# The paper's names, and its verdicts from α₁ = π/2 and α₁ = 0.
TABLE_5 = {
    "lagrange-multipliers": ("LM2", "diverge", "diverge"),
    "lagrange-multipliers+baumgarte": ("LM2 + Baumgarte", "diverge", "diverge"),
    "lagrange-multipliers+partitioning": ("LM2 + coordinate partitioning", "diverge", "diverge"),
    "augmented-lagrangian": ("ALF", "diverge", "diverge"),
    "augmented-lagrangian+partitioning": ("ALF + coordinate partitioning", "diverge", "diverge"),
    "moore-penrose-svd": ("MPI(SVD)", "diverge", "diverge"),
    "moore-penrose-svd+baumgarte": ("MPI(SVD) + Baumgarte", "diverge", "diverge"),
    "moore-penrose-svd+partitioning": ("MPI(SVD) + coordinate partitioning", "converge", "converge"),
    "moore-penrose-gram-schmidt": ("MPI(GS)", "diverge", "diverge"),
    "moore-penrose-gram-schmidt+baumgarte": ("MPI(GS) + Baumgarte", "diverge", "diverge"),
    "moore-penrose-gram-schmidt+partitioning": ("MPI(GS) + coordinate partitioning", "diverge", "diverge"),
    "tangent-space": ("the paper's method", "converge", "converge"),
}
STEPPINGS = {
    "RK4, 10 ms": Stepping(lx.RungeKutta4(), step=1e-2),
    "RK4, 1 ms": Stepping(lx.RungeKutta4(), step=1e-3),
    "Dopri8, rtol 1e-8": Stepping(diffrax.Dopri8(), rtol=1e-8),
}
# Place of the start in TABLE_5, and what it is.
STARTS = {
    "FL1": (1, "π/2, no gravity"),
    "FL2": (2, "0, no gravity"),
    "FL3": (1, "π/2, gravity"),
    "FL4": (2, "0, gravity"),
}
BAUMGARTE = lx.Baumgarte(10.0, 10.0)
TOLERANCES = (1e-10, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3)


def _partitioned(inverse, tolerance):
    correction = lx.CoordinatePartitioning(tolerance)
    return lx.ClassicalFormulation(lx.MoorePenrose(inverse, tolerance), correction=correction)


def _augmented(penalty, stabilisation, correction=None):
    return lx.ClassicalFormulation(lx.AugmentedLagrangian(penalty), stabilisation, correction)


# What decides verdicts that differ from the paper's: penalties, feedback, cut-offs.
VARIED = {
    **{f"ALF, penalty {penalty:.0e}": _augmented(penalty, BAUMGARTE) for penalty in (1e5, 1e7, 1e9)},
    "ALF, penalty 1e+07, no feedback": _augmented(1e7, lx.Baumgarte(0.0, 0.0)),
    **{
        f"ALF + coordinate partitioning, penalty {penalty:.0e}": _augmented(
            penalty, BAUMGARTE, lx.CoordinatePartitioning()
        )
        for penalty in (1e5, 1e7, 1e9)
    },
    **{f"MPI(SVD) + coordinate partitioning, cut-off {cut:.0e}": _partitioned("svd", cut) for cut in TOLERANCES},
    **{
        f"MPI(GS) + coordinate partitioning, cut-off {cut:.0e}": _partitioned("gram-schmidt", cut) for cut in TOLERANCES
    },
}
# Without the rows that no motion changes, which the paper's methods had.
FEW_ROWS = ("lagrange-multipliers", "lagrange-multipliers+baumgarte", "lagrange-multipliers+partitioning")


def slider(out):
    """Figures 8 and 11."""
    mechanism, state = start("crank-slider", "SC1")
    ts = np.linspace(0.0, 10.0, 401)
    found = lx.simulate(mechanism, state, t1=10.0, accuracy=lx.PRECISE, saveat=diffrax.SaveAt(ts=ts))
    known = reference("crank_slider_SC1")
    within = ts <= 5.0 + 1e-9
    _save(plot.motion(found, "slider"), out / "figure-8.png")
    _save(plot.reaction(found, "guide"), out / "figure-11.png")
    force = found.reaction("guide").force[:, 1]
    away = np.abs(np.cos(known["theta"])) > 0.01
    yield {
        "figure 8, error to 5 s [m]": _short(
            np.max(np.abs(found.position("slider")[:, 0][within] - known["x_slider"]))
        ),
        "speed [m/s]": _short(np.max(np.abs(found.velocity("slider")[:, 0][within] - known["v_slider"]))),
        "figure 11, error of the force [N]": _short(np.max(np.abs(force[within] - known["guide_force_y"])[away])),
        "largest force [N]": _short(np.max(np.abs(force))),
        "passages [s]": ", ".join(f"{time:.4f}" for time in found.passages().times),
    }


def violations(out):
    """Figures 9 and 10: SC1, Dopri8, at the ends of all steps, up to where a method has left the motion."""
    mechanism, state = start("crank-slider", "SC1")
    ts = np.linspace(0.0, 10.0, 2001)
    every_step = diffrax.SaveAt(steps=True, t0=True)
    tight = lx.simulate(mechanism, state, t1=10.0, accuracy=lx.PRECISE, saveat=diffrax.SaveAt(ts=ts))
    methods = {
        "the paper's method": None,
        "LM2 + Baumgarte": "lagrange-multipliers+baumgarte",
        "ALF": "augmented-lagrangian",
    }
    for rtol in (1e-6, 1e-9):
        accuracy, drawn, ours = lx.Accuracy(rtol=rtol), {}, None
        for label, name in methods.items():
            run = functools.partial(
                lx.simulate, mechanism, state, t1=10.0, accuracy=accuracy, formulation=name, throw=False
            )
            even = run(saveat=diffrax.SaveAt(ts=ts))
            apart = np.abs(np.asarray(even.position("slider") - tight.position("slider"))[:, 0])
            failed = np.append(ts[~(apart < 0.02)], np.inf)[0]
            found = run(saveat=every_step, max_steps=4096)
            times = np.asarray(found.ts)
            levels = [np.asarray(level) for level in found.violation()]
            drawn[label] = times[np.isfinite(times)], [level[np.isfinite(times)] for level in levels], failed
            worst = [float(np.max(level[times < failed])) for level in levels]
            ours = worst if name is None else ours
            yield {
                "rtol": rtol,
                "method": label,
                "off the motion from": "never" if failed == np.inf else f"{failed:.3f} s",
                "c": _short(worst[0]),
                "J v": _short(worst[1]),
                "J a - γ": _short(worst[2]),
                "ratios to ours": ", ".join(
                    f"{theirs / max(own, 1e-18):.0e}" for theirs, own in zip(worst, ours, strict=True)
                ),
            }
        _save(_figure_of_violations(drawn, rtol), out / f"figures-9-10-rtol-{rtol:.0e}.png")


def _figure_of_violations(drawn, rtol):
    figure = Figure(figsize=(7.0, 6.4), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    for colour, (label, (times, levels, failed)) in zip(COLOURS, drawn.items(), strict=True):
        for panel, level in zip(panels, levels, strict=True):
            panel.semilogy(times, np.maximum(level, 1e-18), color=colour, linewidth=0.9, label=label)
            if np.isfinite(failed):
                panel.axvline(failed, color=colour, linewidth=0.9, linestyle=":")
    for panel, label in zip(panels, ("c [rad, loop lengths]", "J v [1/s]", "J a − γ [1/s²]"), strict=True):
        panel.set_ylabel(label)
        panel.grid(True, color="#E5E5E5")
    panels[0].set_title(f"Violations, SC1, Dopri8 at rtol {rtol:.0e}; dotted: off the motion")
    figure.legend(*panels[0].get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=3)
    panels[-1].set_xlabel("time [s]")
    return figure


def four_link(out):
    """Figures 13 to 15."""
    scene = SCENES["spatial-four-link"]
    for variant in ("FL1", "FL2", "FL3", "FL4"):
        settings = scene.settings(variant)
        mechanism, state = start("spatial-four-link", variant)
        for label, stepping in STEPPINGS.items():
            options = {"accuracy": lx.Accuracy(rtol=stepping.rtol or 1e-8), "solver": stepping.solver}
            found = lx.simulate(mechanism, state, t1=20.0, **options, **fixed_steps(stepping.step, 20.0))
            apart = np.asarray(found.position("coupler", at="tip")) - scene.exact(settings, np.asarray(found.ts))["C"]
            if (variant, label) == ("FL1", "RK4, 10 ms"):
                _save(_figure_of_the_point(found, apart), out / "figures-14-15.png")
            yield {
                "start": STARTS[variant][1],
                "steps": label,
                "error of C [m]": _short(np.max(np.abs(apart))),
                "largest joint acceleration [rad/s²]": _short(
                    np.max(np.abs(np.gradient(found.joint_speed("A"), found.ts)))
                ),
            }
    _save(_figure_of_positions(mechanism), out / "figure-13.png")


def _figure_of_the_point(found, apart):
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    place = np.asarray(found.position("coupler", at="tip"))
    for colour, index, name in zip(COLOURS, (0, 1), "xy", strict=False):
        above.plot(found.ts, place[:, index], color=colour, label=f"{name} of C")
        below.plot(found.ts, apart[:, index], color=colour)
    above.set_ylabel("position [m]")
    below.set_ylabel("less exact [m]")
    below.set_xlabel("time [s]")
    above.set_title("Point C from α₁ = π/2, RK4 at 10 ms, and its error", fontsize="medium")
    figure.legend(*above.get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=2)
    for panel in (above, below):
        panel.grid(True, color="#E5E5E5")
    return figure


def _figure_of_positions(mechanism):
    """The links where they lie in line, and a little before, moved apart so that all are seen."""
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    for panel, angle, name in zip(figure.subplots(1, 2), (0.0, np.pi), ("α₁ = 0", "α₁ = π"), strict=True):
        for turn, alpha in ((angle, 1.0), (angle + 0.5, 0.35)):
            crank_tip = np.array([np.cos(turn), np.sin(turn)])
            corners = np.array([[0.0, 0.0], crank_tip, crank_tip + np.array([1.0, 0.0]), [1.0, 0.0]])
            for count, (colour, link) in enumerate(zip(COLOURS, ("crank", "coupler", "rocker"), strict=True)):
                shift = 0.03 * (count - 1) if turn == angle else 0.0
                ends = corners[count : count + 2] + np.array([0.0, shift])
                panel.plot(
                    *ends.T, color=colour, alpha=alpha, linewidth=3, marker="o", label=link if alpha == 1.0 else None
                )
        rank = lx.mobility(mechanism, _turned(mechanism, angle)).rank
        panel.set_title(f"{name}: rank {rank},\nmomentarily {3 - rank} degrees of freedom", fontsize="medium")
        panel.set_aspect("equal")
        panel.set_ylim(-0.7, 0.7)
        panel.grid(True, color="#E5E5E5")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _turned(mechanism, angle):
    return lx.assemble(mechanism, {"A": angle, "B": -angle, "C": angle, "D": angle})


def _verdicts(formulations, all_rows=True):
    """Error or time of failure of each formulation: {label: {(start, steps): (verdict, text)}}."""
    scene, found = SCENES["spatial-four-link"], {}
    for variant in STARTS:
        settings = scene.settings(variant)
        mechanism, state = start("spatial-four-link", variant)
        if all_rows:
            mechanism = mechanism.with_all_rows()
        trials = compare(
            mechanism,
            state,
            scene.points(settings),
            t1=20.0,
            steppings=list(STEPPINGS.values()),
            formulations=formulations,
            exact=functools.partial(scene.exact, settings),
            repeats=1,
        ).trials
        for trial, steps in zip(trials, list(STEPPINGS) * len(formulations), strict=True):
            text = f"{trial.error:.0e}" if trial.diverged_at is None else f"✗ {trial.diverged_at:.2f} s"
            found.setdefault(trial.formulation, {})[variant, steps] = trial.verdict, text
    return found


def table_5(out):
    found = _verdicts(tuple(TABLE_5))
    for name, (label, *paper) in TABLE_5.items():
        yield {"method": label, "paper": ", ".join(paper)} | _by_start(found[name], paper)


def table_5_differences(out):
    for label, runs in _verdicts(VARIED).items():
        yield {"method": label} | _by_start(runs)
    for name, runs in _verdicts(FEW_ROWS, all_rows=False).items():
        yield {"method": f"{TABLE_5[name][0]}, without redundant rows"} | _by_start(runs)


def _by_start(runs, paper=None):
    """A column for each start, with all steps in it, and marks where a verdict is not the paper's."""
    columns = {}
    for (variant, _), (verdict, text) in runs.items():
        place, described = STARTS[variant]
        differs = paper is not None and not verdict.startswith(paper[place - 1])
        columns.setdefault(f"{variant} ({described})", []).append(text + " ≠" * differs)
    return {name: " / ".join(texts) for name, texts in columns.items()}


def _short(number):
    return f"{float(number):.1e}"


def _save(figure, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


PARTS = {
    "slider": slider,
    "violations": violations,
    "four-link": four_link,
    "table-5": table_5,
    "table-5-differences": table_5_differences,
}


def _table(rows):
    head = list(rows[0])
    lines = [head, ["---"] * len(head), *(list(row.values()) for row in rows)]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def page(found) -> str:
    """The page, with the tables in it."""
    text = (Path(__file__).parent / "paper" / "template.md").read_text()
    for name, rows in found.items():
        text = text.replace(f"{{{name}}}", _table(rows))
    return text


if __name__ == "__main__":
    found, out = print_parts(__doc__, PARTS, Path("linkax-out/paper"))
    if set(found) == set(PARTS):
        (out / "README.md").write_text(page(found))
