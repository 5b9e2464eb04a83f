"""Error against cost over tolerances: solvers, projections, corrections, metrics, precisions, and other simulators.

One thing at a time differs from what linkax does by default. A row for each run: largest error of the tracked point
[m], largest violations of positions and speeds (relative, see `linkax.Solution.worst_violation`), energy gained or lost
over the largest kinetic energy, steps, evaluations of the equations, seconds to compile, milliseconds to run, and with
BALANCED inside `jax.jit`, where Python does nothing for each call. Then what each preset comes to, and for each target
the cheapest run of linkax and of each peer. Times are of this machine, this run: compare ratios.

The problems are ten seconds long; 201 positions are saved. The telescopic crane has a benchmark of its own.
"""

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import linkax as lx
from benchmarks.machine import machine
from benchmarks.peers import PEERS
from benchmarks.peers.__main__ import rows as peer_rows
from benchmarks.peers.runs import timed
from benchmarks.problems import PROBLEMS, TIMES, add_problems, chosen
from linkax.files import written_whole
from linkax.studies.sweeps.comparison import evaluations

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
SINGLE = 1e-6  # smallest tolerance in single precision
TARGETS = (1e-3, 1e-6, 1e-9)  # m
MARKS = "osx^vD+"
PRESETS = {"DRAFT": lx.DRAFT, "BALANCED": lx.BALANCED, "PRECISE": lx.PRECISE}


class Choice(NamedTuple):
    """What differs from the defaults: the option, its value, and by what it is given to linkax."""

    option: str
    value: str
    solver: diffrax.AbstractSolver = diffrax.Dopri8()
    projection: str = "both"
    metric: str = "mass"
    corrections: int = 1
    dtype: type = jnp.float64

    def options(self, rtol) -> dict:
        """Of `linkax.simulate`."""
        accuracy = lx.Accuracy(rtol=rtol, projection=self.projection)
        formulation = lx.TangentSpace(metric=self.metric, corrections=self.corrections)
        return {"accuracy": accuracy, "formulation": formulation, "solver": self.solver, "dtype": self.dtype}


DEFAULT = Choice("", "default")
CHOICES = (
    DEFAULT,
    Choice("solver", "Tsit5", solver=diffrax.Tsit5()),
    Choice("solver", "Dopri5", solver=diffrax.Dopri5()),
    *(Choice("projection", name, projection=name) for name in ("stage", "step", "none")),
    *(Choice("corrections", str(count), corrections=count) for count in (2, 3)),
    Choice("metric", "identity", metric="identity"),
    Choice("precision", "float32", dtype=jnp.float32),
)
OPTIONS = tuple(dict.fromkeys(choice.option for choice in CHOICES if choice.option))
NOTHING = "nothing"


def measured(problem, choice, rtol, reference) -> dict:
    """One run of one of `PROBLEMS`."""
    mechanism, state = problem.start()
    body, frame = problem.tracked

    def simulate(state):
        saveat = diffrax.SaveAt(ts=TIMES)
        return lx.simulate(mechanism, state, t1=TIMES[-1], saveat=saveat, throw=False, **choice.options(rtol))

    def of(simulate):
        return lambda: jax.block_until_ready(simulate(state))

    began = time.perf_counter()
    of(simulate)()
    first = time.perf_counter() - began
    found, seconds = timed(of(simulate))
    inside = None
    if choice is DEFAULT and rtol == lx.BALANCED.rtol:
        compiled = of(eqx.filter_jit(simulate))
        compiled()
        inside = timed(compiled)[1]
    apart = np.linalg.norm(np.asarray(found.position(body, at=frame)) - reference, axis=-1)
    violation, energy = found.worst_violation(), np.asarray(found.energy())
    steps = int(found.stats["num_steps"])
    return {
        "rtol": rtol,
        "error": float(np.max(apart)) if np.all(np.isfinite(apart)) else None,
        "position_violation": float(violation.position),
        "speed_violation": float(violation.velocity),
        "energy": float(np.ptp(energy) / np.max(found.kinetic_energy())) if problem.conserves else None,
        "steps": steps,
        "evaluations": evaluations(choice.solver, steps),
        "compile_s": max(first - seconds, 0.0),
        "run_ms": 1e3 * seconds,
        **({} if inside is None else {"jit_ms": 1e3 * inside}),
        "result": lx.RESULTS[found.result],
    }


def rows(key, options, peers) -> Iterator[dict]:
    """One of `PROBLEMS`: by linkax with each choice, then by peers."""
    problem = PROBLEMS[key]
    reference = problem.reference()
    for choice in CHOICES:
        if choice.option and choice.option not in options:
            continue
        for rtol in TOLERANCES:
            if choice.dtype == jnp.float64 or rtol >= SINGLE:
                told = {"problem": key, "by": "linkax", "option": choice.option, "value": choice.value}
                yield told | measured(problem, choice, rtol, reference)
        jax.clear_caches()  # a process has room for the programs of a few mechanisms only
    for row in peer_rows(key, peers) if peers and problem.for_peers else ():
        if "method" in row:
            yield _as_ours(row)


def _as_ours(row):
    """A peer's row in the terms of linkax's."""
    ended = row.get("reached") == TIMES[-1]
    return {
        "problem": row["problem"],
        "by": row["peer"],
        "option": "method",
        "value": row["method"],
        "step": row["step"],
        "error": row["error"] if ended else None,
        "gap": row.get("gap"),
        "run_ms": row["ms_per_second"] * TIMES[-1] if ended else None,
        "result": row["note"],
    }


def cheapest(found: list[dict], key: str, by: str, target: float) -> dict | None:
    """The run that took the least time of those with an error below a target [m]."""
    good = [row for row in found if row["problem"] == key and row["by"] == by]
    good = [row for row in good if row["error"] is not None and row["error"] < target]
    return min(good, key=lambda row: row["run_ms"]) if good else None


def targets(found: list[dict]) -> str:
    """A table in Markdown: for each problem and target the cheapest runs, and how much longer the best peer takes."""
    bys = list(dict.fromkeys(row["by"] for row in found))
    lines = _head("problem", "error below", *bys, "best peer over linkax")
    for key in dict.fromkeys(row["problem"] for row in found):
        for target in TARGETS:
            best = {by: cheapest(found, key, by, target) for by in bys}
            told = [f"{run['run_ms']:.3g} ms, {_setting(run)}" if run else "none" for run in best.values()]
            others = [run["run_ms"] for by, run in best.items() if run and by != "linkax"]
            ratio = f"{min(others) / best['linkax']['run_ms']:.1f}" if others and best["linkax"] else ""
            lines.append(f"| {key} | {target:g} m | {' | '.join(told)} | {ratio} |")
    return "\n".join(lines)


def presets(found: list[dict]) -> str:
    """A table in Markdown: error, steps and time of each preset, and seconds to compile a first run."""
    lines = _head("problem", *(f"`{name}`" for name in PRESETS), "`BALANCED` inside `jax.jit`", "compiling")
    for key in dict.fromkeys(row["problem"] for row in found):
        own = [row for row in found if (row["problem"], row["value"]) == (key, DEFAULT.value)]
        at = [row for preset in PRESETS.values() for row in own if row["rtol"] == preset.rtol]
        told = [f"{row['error']:.0e} m, {row['steps']} steps, {row['run_ms']:.3g} ms" for row in at]
        (inside,) = (row["jit_ms"] for row in own if "jit_ms" in row)
        lines.append(f"| {key} | {' | '.join(told)} | {inside:.3g} ms | {max(row['compile_s'] for row in own):.0f} s |")
    return "\n".join(lines)


def choices(found: list[dict]) -> str:
    """A table in Markdown: error and time of each choice over those by default, at the presets' tolerances."""
    lines = _head("problem", "choice", *(f"`{name}`" for name in PRESETS))
    ours = [row for row in found if row["by"] == "linkax"]
    at = {(row["problem"], row["option"], row["value"], row["rtol"]): row for row in ours}
    for key, option, value in dict.fromkeys(names[:3] for names in at if names[1]):
        told = [
            _against(at.get((key, option, value, rtol)), at[key, DEFAULT.option, DEFAULT.value, rtol])
            for rtol in (float(preset.rtol) for preset in PRESETS.values())
        ]
        lines.append(f"| {key} | {option} {value} | {' | '.join(told)} |")
    return "\n".join(lines)


def _against(row, default):
    if row is None or row["error"] is None:
        return "" if row is None else row["result"]
    return f"error × {row['error'] / default['error']:.2g}, time × {row['run_ms'] / default['run_ms']:.2g}"


def _head(*names):
    return [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]


def report(told: dict) -> str:
    """All tables, in Markdown, of what `--json` prints."""
    found = told["rows"]
    parts = [", ".join(f"{name} {entry}" for name, entry in told["machine"].items()), presets(found)]
    if any(row["by"] != "linkax" for row in found):
        parts.append(targets(found))
    if any(row["option"] for row in found if row["by"] == "linkax"):
        parts.append(choices(found))
    return "\n\n".join(parts)


def _setting(row):
    return f"{row['value']} {row.get('rtol', row.get('step')):g}"


def picture(found: list[dict], key: str) -> Figure:
    """Error against run time on a problem: a colour for each simulator and option, a mark for each value."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    panel = figure.subplots()
    lines = list(dict.fromkeys((row["by"], row["option"], row["value"]) for row in found))
    groups = list(dict.fromkeys(line[:2] for line in lines))
    for by, option, value in lines:
        own = [row for row in found if (row["by"], row["option"], row["value"]) == (by, option, value)]
        own = [row for row in own if row["error"] is not None]
        alike = [line for line in lines if line[:2] == (by, option)]
        panel.plot(
            [row["run_ms"] for row in own],
            [max(row["error"], 1e-14) for row in own],
            color=f"C{groups.index((by, option))}",
            marker=MARKS[alike.index((by, option, value)) % len(MARKS)],
            linewidth=2.5 if value == DEFAULT.value else 1.0,
            markersize=4,
            label=" ".join(filter(None, (by, option if by == "linkax" else "", value))),
        )
    panel.set(xscale="log", yscale="log", xlabel="run time [ms]", ylabel="largest error [m]")
    panel.set_title(f"{key}: {PROBLEMS[key].name}, {TIMES[-1]:g} s")
    panel.grid(True, color="#E5E5E5")
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure


def _peers(text):
    names = text.split(",")
    unknown = [name for name in names if name not in PEERS]
    if unknown:
        raise argparse.ArgumentTypeError(f"unknown peer {unknown[0]!r}; known: {', '.join(PEERS)}")
    return names


def main():
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.work_precision",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_problems(parser)
    parser.add_argument("--peers", type=_peers, default=[], metavar="NAME,...", help=f"of {', '.join(PEERS)}")
    parser.add_argument("--vary", choices=[*OPTIONS, NOTHING], action="append", help="what to vary; default: all")
    parser.add_argument("--json", action="store_true", help="print one JSON object, and nothing else")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write rows, tables and pictures there")
    arguments = parser.parse_args()
    found = []
    keys = chosen(arguments.problems)
    for key in keys:
        for row in rows(key, arguments.vary or OPTIONS, arguments.peers):
            found.append(row)
            if not arguments.json:
                print("  ".join(f"{name} {_short(entry)}" for name, entry in row.items()), flush=True)
    told = {"machine": machine(), "rows": found}
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        for name, text in (("json", json.dumps(told, indent=1)), ("md", report(told) + "\n")):
            with written_whole(arguments.out / f"work_precision.{name}") as path:
                path.write_text(text)
        for key in keys:
            with written_whole(arguments.out / f"{key}.png") as path:
                picture([row for row in found if row["problem"] == key], key).savefig(path, dpi=110, format="png")
    print(json.dumps(told) if arguments.json else f"\n{report(told)}")


def _short(entry):
    return f"{entry:.3g}" if isinstance(entry, float) else entry


if __name__ == "__main__":
    main()
