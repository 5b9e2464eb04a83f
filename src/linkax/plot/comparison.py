"""Plot a comparison of formulations."""

from linkax.formulations.named import TANGENT_SPACE
from linkax.plot.figure import Figure
from linkax.scenery.colours import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, VERMILION
from linkax.studies.sweeps.comparison_result import Comparison

COLOURS = (VERMILION, GREEN, ORANGE, PURPLE, SKY, INK, FAINT)
MARKERS = {"": "o", "baumgarte": "s", "partitioning": "^", "projection": "D"}
SMALLEST = 1e-16  # drawn in place of smaller errors: zero has no logarithm


def comparison(found: Comparison) -> Figure:
    """Plot the error [m] of each formulation against its run time [ms]; lines join the trials of one formulation.

    Colours show the base of a formulation, markers what is added to it, such as Baumgarte's stabilisation. Trials with
    hollow markers diverged.
    """
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    panel = figure.subplots()
    names = list(dict.fromkeys(trial.formulation for trial in found.trials))
    bases = list(dict.fromkeys(name.split("+")[0] for name in names if name != TANGENT_SPACE))
    for name in names:
        base, *added = name.split("+")
        own = [trial for trial in found.trials if trial.formulation == name and trial.reached > 0.0]
        ours = name == TANGENT_SPACE
        colour = BLUE if ours else COLOURS[bases.index(base) % len(COLOURS)]
        times, errors = [1e3 * trial.run_s for trial in own], [max(trial.error, SMALLEST) for trial in own]
        panel.plot(times, errors, color=colour, linewidth=1.6 if ours else 0.7, zorder=3 if ours else 2)
        for trial, time, error in zip(own, times, errors, strict=True):
            panel.plot(
                time,
                error,
                marker="*" if ours else MARKERS.get("+".join(added), "P"),
                markersize=13 if ours else 6,
                color=colour,
                markerfacecolor=colour if trial.verdict == "converged" else "white",
                zorder=4 if ours else 3,
            )
        panel.plot([], [], marker="*" if ours else MARKERS.get("+".join(added), "P"), color=colour, label=name)
    panel.axhline(found.bound, color=FAINT, linestyle="--", linewidth=0.9)
    panel.annotate("diverged above", (0.01, found.bound), xycoords=("axes fraction", "data"), va="bottom", color=INK)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel("run time [ms]")
    panel.set_ylabel("largest error [m]")
    panel.set_title("Error against run time; hollow: diverged")
    panel.grid(True, color="#E5E5E5")
    panel.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize="small")
    return figure
