"""The telescopic crane: the paper's figure 20, what it is compared with, and what flexible parts cost.

Parts, chosen by `--part`:

- `deflection`: of the tip under loads, against a chain of beams (small deflections), and with the gravity it has.
- `figure-20`: a fifth of the load drops: the tip's height over time, and its frequency against the load, by the
  spectrum of the motion and by linearisation.
- `rigid`: luffed with sections so stiff that they move as rigid ones do.
- `derivatives`: of deflection and frequency by section height, modulus and load, against differences.
- `runs`: every variant over its whole time: seconds, with compiling and without, how far its loops open, with
  pictures of tip and load.
- `cost`: run time against length of motion and number of elements, with growth exponents.
- `presets`: over half a second, how far the tip is with each from where `PRECISE` has it [m], and their cost.

Pictures go into `--out` (default: linkax-out/crane). About half an hour, most of it compiling.
"""

import sys
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import linkax as lx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from cranes import (
    REACH,
    SCENE,
    VARIED,
    at_rest,
    chain_of_beams,
    crane,
    deflection,
    main_frequency,
    rigid,
    slopes_and_differences,
)

from benchmarks.parts import print_parts

LOADS = (500.0, 1000.0, 2000.0, 3000.0, 4000.0)  # [kg]
SHOWN = 6.0  # [s]
SAMPLES = 1201
STIFFER = (1e3, 1e5)  # than steel
LENGTHS = (0.5, 1.0, 2.0, 4.0)  # of motion [s]
ELEMENTS = (1, 2, 4)  # of each section
DROP = 0.5  # s
SAVED = diffrax.SaveAt(ts=np.linspace(0.0, DROP, 11))


def statics(out):
    """Deflections of the tip [m]."""
    for load in LOADS:
        row = {"load_kg": load}
        for name, gravity in (("small", 9.81e-3), ("full", 9.81)):
            parameters, mechanism, state = crane(payload=load, dropped=0.0, gravity=gravity)
            found, expected = float(deflection(mechanism, state, parameters)), float(chain_of_beams(parameters))
            row |= {f"{name}_m": f"{found:.6g}", f"{name}_off": f"{found / expected - 1.0:.1e}"}
        yield row


def figure_20(out):
    """Height of the tip over time, and frequencies [Hz]."""
    times, drawn = np.linspace(0.0, SHOWN, SAMPLES), Figure(figsize=(9.0, 3.6), layout="constrained")
    over_time, over_load = drawn.subplots(1, 2)
    frequencies = []
    for load in LOADS:
        _, mechanism, state = crane(payload=0.8 * load, dropped=0.2 * load)
        found = lx.simulate(mechanism, state, t1=SHOWN, saveat=diffrax.SaveAt(ts=times))
        height = np.asarray(found.position("section_3", at="tip"))[:, 1]
        # The first mode is the swinging of the load, the second the bending of the boom.
        modes = lx.linearise(mechanism, lx.equilibrium(mechanism, state)).natural_frequencies / (2.0 * np.pi)
        frequencies.append((main_frequency(times, height), float(modes[1])))
        of_run, of_modes = frequencies[-1]
        over_time.plot(times, height - height[0], label=f"{0.8 * load:.0f} kg")
        yield {
            "load_kg": 0.8 * load,
            "spectrum_hz": f"{of_run:.5g}",
            "linearised_hz": f"{of_modes:.5g}",
            "off": f"{of_run / of_modes - 1.0:.1e}",
            "violation": f"{float(found.worst_violation().position):.1e}",
        }
    over_time.set(xlabel="t [s]", ylabel="height of the tip from the start [m]")
    over_time.legend(title="load that stays", fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5)
    loads = 0.8 * np.array(LOADS)
    over_load.plot(loads, [run for run, _ in frequencies], "o", label="spectrum of the motion")
    over_load.plot(loads, [mode for _, mode in frequencies], "-", label="linearised")
    over_load.set(xlabel="load [kg]", ylabel="frequency [Hz]")
    over_load.legend(fontsize="small")
    out.mkdir(parents=True, exist_ok=True)
    drawn.savefig(out / "figure-20.png", dpi=110)


def stiff_sections(out):
    """Luffing in a second: places of tip and load, and forces at the start, against those of rigid sections."""
    times = diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 21))
    for stiffer in STIFFER:
        modulus = stiffer * SCENE.parameters["modulus"]
        parameters, mechanism, state = crane("luffing", modulus=modulus, duration=1.0)
        guides = rigid(parameters)
        begin = at_rest(guides, parameters)
        found, expected = (lx.simulate(m, s, t1=1.0, saveat=times) for m, s in ((mechanism, state), (guides, begin)))
        row = {"modulus_pa": f"{modulus:.1e}", "steps": int(found.stats["num_steps"])}
        for body, at in (("section_3", "tip"), ("payload", None)):
            off = found.position(body, at=at) - expected.position(body, at=at)
            row[f"{body}_off"] = f"{float(jnp.max(jnp.abs(off))) / REACH:.1e}"
        for name in ("luffing", "telescoping", "extension_rope"):
            force, rigidly = (float(run.reaction(name)[0]) for run in (found, expected))
            row[f"{name}_off"] = f"{force / rigidly - 1.0:.1e}"
        yield row


def derivatives(out):
    """In forward mode, through the rest of the crane and its modes."""
    slopes, differences = slopes_and_differences()
    off = differences / slopes - 1.0
    for row, what in enumerate(("deflection_m", "frequency_hz")):
        for column, name in enumerate(VARIED):
            yield {"of": what, "by": name, "slope": f"{slopes[row, column]:.6g}", "off": f"{off[row, column]:.1e}"}


def runs(out):
    """At the default accuracy; violations in radians and lengths of the mechanism."""
    out.mkdir(parents=True, exist_ok=True)
    for name in SCENE.variants:
        _, mechanism, state = crane(name)
        t1 = SCENE.duration(name)
        times = np.linspace(0.0, t1, 401)
        found, first, seconds = _twice(mechanism, state, t1, diffrax.SaveAt(ts=times))
        violation = found.worst_violation()
        yield {
            "variant": name,
            "t1_s": t1,
            "steps": int(found.stats["num_steps"]),
            "violation": f"{float(violation.position):.1e}",
            "of_speeds": f"{float(violation.velocity):.1e}",
            "first_run_s": f"{first:.3g}",
            "run_s": f"{seconds:.3g}",
        }
        drawn = Figure(figsize=(9.0, 3.6), layout="constrained")
        for axes, (body, at, title) in zip(
            drawn.subplots(1, 2), (("section_3", "tip", "tip"), ("payload", None, "load")), strict=True
        ):
            axes.plot(times, found.position(body, at=at), label=["x", "y (up)", "z"])
            axes.set(xlabel="t [s]", ylabel=f"place of the {title} [m]")
            axes.legend(fontsize="small")
        drawn.savefig(out / f"{name}.png", dpi=110)


def _twice(mechanism, state, t1, saveat):
    """A run, and the seconds it takes with compiling and without."""
    run = lambda: jax.block_until_ready(lx.simulate(mechanism, state, t1=t1, saveat=saveat))
    began = time.perf_counter()
    run()
    compiled = time.perf_counter()
    found = run()
    return found, compiled - began, time.perf_counter() - compiled


def cost(out):
    """Seconds to run, once compiled; the exponents are between a row and the one before."""
    for what, values in (("elements", ELEMENTS), ("length_s", LENGTHS)):
        before = None
        for value in values:
            _, mechanism, state = crane(**{"elements": value} if what == "elements" else {})
            t1 = 1.0 if what == "elements" else value
            found, first, seconds = _twice(mechanism, state, t1, diffrax.SaveAt(t1=True))
            row = {what: value, "speeds": mechanism.topology.num_speeds, "steps": int(found.stats["num_steps"])}
            row |= {"first_run_s": f"{first:.3g}", "run_s": f"{seconds:.3g}"}
            if before is not None:
                row["exponent"] = f"{np.log(seconds / before[1]) / np.log(value / before[0]):.2f}"
            before = value, seconds
            yield row


def presets(out):
    """A fifth of the load drops; seconds to run once compiled, and how far the tip is from that of the last row [m]."""
    _, mechanism, state = crane()
    run = lambda accuracy: jax.block_until_ready(
        lx.simulate(mechanism, state, t1=DROP, accuracy=accuracy, saveat=SAVED, max_steps=100_000)
    )
    run(lx.DRAFT)  # compiles the program of all three
    found = {}
    for name in ("DRAFT", "BALANCED", "PRECISE"):
        accuracy = getattr(lx, name)
        began = time.perf_counter()
        solution = run(accuracy)
        found[name] = accuracy, solution, time.perf_counter() - began
    tip = lambda solution: solution.position("section_3", at="tip")
    closest = tip(found["PRECISE"][1])
    for name, (accuracy, solution, seconds) in found.items():
        yield {
            "preset": name,
            "rtol": accuracy.rtol,
            "off": f"{float(jnp.max(jnp.abs(tip(solution) - closest))):.1e}",
            "steps": int(solution.stats["num_steps"]),
            "run_s": f"{seconds:.3g}",
        }


PARTS = {
    "deflection": statics,
    "figure-20": figure_20,
    "rigid": stiff_sections,
    "derivatives": derivatives,
    "runs": runs,
    "cost": cost,
    "presets": presets,
}

if __name__ == "__main__":
    print_parts(__doc__, PARTS, Path("linkax-out/crane"))
