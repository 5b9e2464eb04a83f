"""Write all pictures of a run as files."""

from pathlib import Path

import numpy as np

from linkax import plot
from linkax.files import written_whole
from linkax.scenery.scenery import Points
from linkax.simulation.read.solution import Solution


def write_pictures(solution: Solution, points: Points, folder: Path) -> list[Path]:
    """Write the pictures of a run, of the times that it reached, and return their paths.

    These are the motion of each named point (of the crank-slider's slider: Fig. 8 of the paper), the violations
    (Fig. 10), the reaction of each joint on ground (of the guide: Fig. 11), the energy, the internal states of each
    force that has some, and the mechanism in motion: `mechanism.html`, in three dimensions for a browser, and the
    animation `mechanism.gif`.
    """
    figures = {f"motion_{name}": plot.motion(solution, body, at, name) for name, (body, at) in points.items()}
    figures |= {"violations": plot.violations(solution), "energy": plot.energy(solution)}
    mechanism = solution.mechanism
    for joint in mechanism.joints:
        if joint.name in _on_ground(mechanism):
            figures[f"reaction_{joint.name}"] = plot.reaction(solution, joint.name)
    for name, force in zip(mechanism.force_names, mechanism.forces, strict=True):
        if force.states:
            figures[f"states_{name}"] = plot.states(solution, name)
    written = []
    for name, figure in figures.items():
        with written_whole(folder / f"{name}.png") as path:
            figure.savefig(path, dpi=130, format="png")
        written.append(folder / f"{name}.png")
    if np.sum(np.isfinite(np.asarray(solution.ts))) > 1:
        plot.animate(solution, folder / "mechanism.gif", points)
        written.append(folder / "mechanism.gif")
        solution.view(folder / "mechanism.html", points=points)
        written.append(folder / "mechanism.html")
    return written


def _on_ground(mechanism) -> set[str]:
    """Names of the joints on ground."""
    topology = mechanism.topology
    ends = zip(topology.joints, topology.parent, topology.child, strict=True)
    return {name for name, parent, child in ends if -1 in (parent, child)}
