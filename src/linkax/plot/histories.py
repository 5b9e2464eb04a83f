"""Plot time histories.

Each function returns a `matplotlib.figure.Figure`, made without pyplot, so that it needs no display and leaves no
global state. Save it by `lx.plot.energy(solution).savefig("energy.png")`, or let it be the last value of a notebook
cell. All raise `ValueError` for an unknown name, and for the solution of a batch: plot one of its members.
"""

import numpy as np

from linkax.model.constraints.constraint import Drive
from linkax.model.constraints.ropes import Rope
from linkax.plot.figure import Figure
from linkax.scenery.colours import BLUE, GREEN, INK, VERMILION, body_colour
from linkax.scenery.scenery import reached
from linkax.simulation.read.by_name import BodyPoint, is_constraint
from linkax.simulation.read.solution import Solution
from linkax.tables import numbers

COMPONENT_COLOURS = {"x": BLUE, "y": VERMILION, "z": GREEN}
NEGLIGIBLE = 1e-9  # size of a component, relative to the largest, up to which it is left out
NOT_UNIQUE = "not unique"
SMALLEST_VIOLATION = 1e-17  # drawn in place of zero, which has no logarithm


def motion(solution: Solution, body: str, at: BodyPoint = None, name: str | None = None) -> Figure:
    """Plot position [m], velocity [m/s] and acceleration [m/s²] of a point against time [s], along ground axes.

    Components in which the point does not move are left out.

    **Arguments:** `body`, `at`: the point, see `Solution.position`. `name`: of the point, in the title; by default
    that says the body and where on it. `linkax.plot.path` plots it in space.
    """
    solution = reached(solution)
    histories = {
        "position [m]": solution.position(body, at),
        "velocity [m/s]": solution.velocity(body, at),
        "acceleration [m/s²]": solution.acceleration(body, at),
    }
    shown = _present(histories["velocity [m/s]"])
    figure, panels = _panels(f"Motion of {name or _point(body, at)}{_along(shown)}", 3)
    for panel, (label, values) in zip(panels, histories.items(), strict=True):
        _draw_components(panel, solution.ts, values, shown)
        panel.set_ylabel(label)
    _add_legend(figure, panels[0])
    return figure


def joint(solution: Solution, name: str) -> Figure:
    """Plot coordinates and speeds of a joint, in the tree or cut, against time [s]; its docstring defines them."""
    solution = reached(solution)
    found = solution.mechanism.joint(name)
    figure, panels = _panels(f"{type(found).__name__} {name}", 2)
    units = sorted(set(found.speed_units), reverse=True)
    histories = ("coordinate", "", solution.joint(name)), ("speed", "/s", solution.joint_speed(name))
    for panel, (what, per, values) in zip(panels, histories, strict=True):
        columns = np.asarray(values).reshape(len(solution.ts), -1)
        panel.plot(solution.ts, columns, label=[f"{what} {index}" for index in range(columns.shape[1])])
        panel.set_ylabel(f"{what}\n[{', '.join(unit + per for unit in units)}]")
        if columns.shape[1] > 1:
            panel.legend(frameon=False, fontsize="small")
    return figure


def reaction(solution: Solution, joint: str) -> Figure:
    """Plot force [N] and moment [N m] of a joint on its child against time [s], along ground axes.

    Components that are zero are left out. Those are hatched that redundant constraints leave undetermined, see
    `Solution.reaction_unique`.

    **Arguments:** `joint`: its name, or that of a constraint, of which this plots torque [N m] or force [N] (`Drive`),
    tension [N] (`Rope`) or multiplier (`Coupling`).
    """
    solution = reached(solution)
    found, unique = solution.reaction(joint), solution.reaction_unique(joint)
    if is_constraint(solution, joint):
        constraint = solution.mechanism.constraints[solution.mechanism.topology.constraints.index(joint)]
        figure, (panel,) = _panels(f"Reaction of {constraint.display_name}", 1)
        panel.plot(solution.ts, found, color=BLUE)
        panel.set_ylabel(_strength(solution.mechanism, constraint))
        if np.any(undetermined := ~np.asarray(unique)):
            _hatch(panel, solution.ts, np.asarray(found), undetermined, BLUE, NOT_UNIQUE)
            panel.legend(frameon=False, fontsize="small", loc="upper right")
        return figure
    child = solution.mechanism.joint(joint).child.body
    largest = [float(np.max(np.abs(np.asarray(part)), initial=0.0)) for part in found]
    drawn = [("force [N]", found.force, unique.force), ("moment [N m]", found.moment, unique.moment)]
    drawn = [part for part, size in zip(drawn, largest, strict=True) if size > NEGLIGIBLE * max(largest)] or drawn[:1]
    figure, panels = _panels(f"Reaction of {joint} on {child}", len(drawn))
    for panel, (label, values, known) in zip(panels, drawn, strict=True):
        shown = _present(values)
        _draw_components(panel, solution.ts, values, shown)
        _hatch_components(panel, solution.ts, np.asarray(values), ~np.asarray(known), shown)
        panel.set_ylabel(label)
        panel.legend(frameon=False, fontsize="small", loc="upper right")
    return figure


def _strength(mechanism, constraint):
    """What the reaction of a constraint is, with its unit."""
    if isinstance(constraint, Drive):
        (along,) = constraint.terms
        unit = mechanism.joint(along.joint).speed_units[along.index or 0]
        return "torque [N m]" if unit == "rad" else "force [N]"
    return "tension [N]" if isinstance(constraint, Rope) else "multiplier"


def violations(solution: Solution) -> Figure:
    """Plot the largest violation of the loop rows, in positions, velocities and accelerations, against time [s].

    See `linkax.Violation` for the units. Zeros are drawn at 1e-17.
    """
    solution = reached(solution)
    figure, panels = _panels("Violation of the loops", 3)
    levels = ("position\n[rad or loop lengths]", BLUE), ("velocity\n[1/s]", VERMILION), ("acceleration\n[1/s²]", GREEN)
    for panel, (label, colour), values in zip(panels, levels, solution.violation(), strict=True):
        drawn = np.maximum(np.asarray(values), SMALLEST_VIOLATION)
        panel.semilogy(solution.ts, drawn, color=colour, linewidth=0.8)
        label_of_line = "double precision, 2.2e-16"
        panel.axhline(np.finfo(np.float64).eps, color=INK, linewidth=0.8, linestyle="--", label=label_of_line)
        panel.set_ylabel(label)
    _add_legend(figure, panels[0])
    return figure


def singularity(solution: Solution) -> Figure:
    """Plot the distance from singular configurations, see `linkax.Accuracy`, against time [s]; lines mark passages."""
    passages, solution = solution.passages(), reached(solution)
    figure, (panel,) = _panels("Distance from singular configurations", 1)
    distance = np.maximum(np.asarray(solution.singularity_distance()), SMALLEST_VIOLATION)
    panel.semilogy(solution.ts, distance, color=BLUE)
    for time in passages.times:
        panel.axvline(float(time), color=VERMILION, linewidth=0.8, linestyle="--")
    panel.set_ylabel("distance d")
    return figure


def energy(solution: Solution) -> Figure:
    """Plot kinetic, potential and total energy [J] against time [s], the work that changes it, and what is left over.

    Work is shown where drives, dampers, torques or other forces do some, see `Solution.work`.
    """
    solution = reached(solution)
    kinetic, potential = np.asarray(solution.kinetic_energy()), np.asarray(solution.potential_energy())
    total, works = kinetic + potential, solution.work()
    figure, panels = _panels("Energy", 2 + bool(works))
    for label, values, colour in (("kinetic", kinetic, BLUE), ("potential", potential, VERMILION)):
        panels[0].plot(solution.ts, values, color=colour, label=label)
    panels[0].plot(solution.ts, total, color=INK, label="total", linestyle="--")
    panels[0].set_ylabel("energy [J]")
    if works:
        for index, (name, values) in enumerate(works.items()):
            panels[1].plot(solution.ts, values, color=body_colour(index), label=f"work of {name}")
        panels[1].plot(solution.ts, total - total[0], color=INK, label="change of the total", linestyle="--")
        panels[1].set_ylabel("work [J]")
        panels[1].legend(frameon=False, fontsize="small")
    panels[-1].plot(solution.ts, solution.unaccounted_energy(), color=INK)
    panels[-1].set_ylabel("energy not\naccounted for [J]")
    _add_legend(figure, panels[0])
    return figure


def states(solution: Solution, element: str) -> Figure:
    """Plot the internal states of a force element against time [s], those of one unit together.

    **Arguments:** `element`: its name, one of `mechanism.force_names`.
    """
    solution = reached(solution)
    histories = solution.states(element)
    found = solution.mechanism.forces[solution.mechanism.force_names.index(element)]
    units = dict.fromkeys(state.unit for state in found.states.values())
    figure, panels = _panels(f"Internal states of {element}", len(units))
    for panel, unit in zip(panels, units, strict=True):
        for name, values in histories.items():
            if found.states[name].unit == unit:
                columns = np.asarray(values).reshape(len(solution.ts), -1)
                several = columns.shape[1] > 1
                labels = [f"{name} {index}" if several else name for index in range(columns.shape[1])]
                panel.plot(solution.ts, columns, label=labels)
        panel.set_ylabel(f"[{unit or '1'}]")
        panel.legend(frameon=False, fontsize="small")
    return figure


def _panels(title, count):
    figure = Figure(figsize=(7.0, 1.2 + 1.9 * count if count > 1 else 3.8), layout="constrained")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    panels[0].set_title(title)
    panels[-1].set_xlabel("time [s]")
    for panel in panels:
        panel.grid(True, color="#E5E5E5")
        panel.spines[["top", "right"]].set_visible(False)
        panel.margins(x=0.0)
    return figure, panels


def _present(values):
    """Names of the components that are not negligible; all names where all components are zero."""
    sizes = np.max(np.abs(np.asarray(values)), axis=0)
    present = [name for name, size in zip("xyz", sizes, strict=True) if size > NEGLIGIBLE * max(sizes)]
    return present or list("xyz")


def _draw_components(panel, times, values, names):
    for index, (name, colour) in enumerate(COMPONENT_COLOURS.items()):
        if name in names:
            panel.plot(times, np.asarray(values)[:, index], color=colour, label=name)


def _hatch_components(panel, times, values, undetermined, names):
    """Hatch the components that are not unique, down to zero."""
    label = NOT_UNIQUE
    for index, (name, colour) in enumerate(COMPONENT_COLOURS.items()):
        if name in names and np.any(undetermined[:, index]):
            _hatch(panel, times, values[:, index], undetermined[:, index], colour, label)
            label = None


def _hatch(panel, times, values, where, colour, label):
    """Hatch a line down to zero at some times."""
    style = {"facecolor": "none", "edgecolor": colour, "alpha": 0.35, "hatch": "////", "linewidth": 0.0}
    panel.fill_between(times, values, where=where, label=label, **style)


def _point(body, at):
    """Words for a point of a body."""
    if at is None:
        return f"{body}'s centre of mass"
    return f"{body}.{at}" if isinstance(at, str) else f"{body} at {numbers(np.asarray(at), 'm', np.ndim(at))}"


def _along(names):
    """Words for the title where there is one component, and so no legend."""
    return f" along {names[0]}" if len(names) == 1 else ""


def _add_legend(figure, panel):
    handles, labels = panel.get_legend_handles_labels()
    if handles[1:] or labels[0] not in COMPONENT_COLOURS:
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False)
    figure.align_ylabels()
