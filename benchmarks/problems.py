"""Problems that linkax and other simulators are measured on, with references for the path of one point.

`python -m benchmarks.problems [PROBLEM ...]` prints how far linkax at its tightest tolerance, and where there is no
singular configuration Newton's and Euler's equations in NumPy, are from the references.
"""

import argparse
import math
from collections.abc import Mapping
from typing import NamedTuple

import diffrax
import numpy as np
from scipy.integrate import solve_ivp

import linkax as lx
from benchmarks.peers import newton_euler
from benchmarks.peers.description import Description, describe
from benchmarks.peers.kinematics import path
from linkax.scenes import SCENES

TIMES = 0.05 * np.arange(201)  # s
TIGHTEST = lx.Accuracy(rtol=1e-13)


class Problem(NamedTuple):
    """A scene with settings that differ from its default variant's, and one of its points, which is tracked.

    - `singular`: whether the motion passes singular configurations.
    - `cuts`: hinges for peers to cut, where linkax's choice suits them worse.
    - `conserves`: whether no drive changes the energy. `for_peers`: whether it has hinges and slides only.
    """

    scene: str
    changes: Mapping[str, float]
    point: str
    singular: bool
    cuts: tuple[str, ...] = ()
    conserves: bool = True
    for_peers: bool = True

    @property
    def name(self) -> str:
        return " ".join([self.scene, *(f"{key}={value:g}" for key, value in self.changes.items())])

    @property
    def settings(self) -> dict[str, object]:
        return SCENES[self.scene].settings(changes=self.changes)

    @property
    def tracked(self) -> tuple[str, str | None]:
        """The body, and the frame on it."""
        return SCENES[self.scene].points(self.settings)[self.point]

    def start(self) -> tuple[lx.Mechanism, lx.State]:
        scene, settings = SCENES[self.scene], self.settings
        mechanism = scene.mechanism(settings)
        return mechanism, scene.initial(mechanism, settings)

    def describe(self) -> Description:
        return describe(*self.start(), self.tracked, self.cuts)

    def reference(self, times=TIMES) -> np.ndarray:
        """Positions of the tracked point at times [s], (n_t, 3) [m]."""
        if self.scene == "crank-slider":
            return _slider(self.settings, times)
        exact = SCENES[self.scene].exact
        return self.by_linkax(times) if exact is None else exact(self.settings, times)[self.point]

    def by_linkax(self, times=TIMES) -> np.ndarray:
        """The same by linkax at its tightest tolerance."""
        mechanism, state = self.start()
        found = lx.simulate(
            mechanism, state, t1=times[-1], saveat=diffrax.SaveAt(ts=times), accuracy=TIGHTEST, max_steps=100_000
        )
        body, frame = self.tracked
        return np.asarray(found.position(body, at=frame))


PROBLEMS = {
    "M1n": Problem("crank-slider", {"rod": 2.0, "angle": math.pi / 4}, "slider", singular=False),
    "M1a": Problem("crank-slider", {"angle": math.pi / 4}, "slider", singular=True),
    "M1b": Problem("crank-slider", {"angle": math.pi / 4, "speed": 4.0}, "slider", singular=True),
    "M2-1": Problem("n-four-bar", {"N": 1}, "B0", singular=True),
    "M2-10": Problem("n-four-bar", {"N": 10}, "B0", singular=True),
    "M2-40": Problem("n-four-bar", {"N": 40}, "B0", singular=True),
    # Cut in its middle, errors of MuJoCo grow fourfold and those of Pinocchio by many orders of magnitude.
    "M3": Problem("bricard", {}, "P3", singular=False, cuts=("P6",)),
    "pendulum": Problem("pendulum", {}, "bob", singular=False, for_peers=False),
    # In its default variant it turns uniformly, and steps of any size are exact.
    "FL3": Problem("spatial-four-link", {"gravity": 9.81, "speed": -1.0}, "C", singular=True, for_peers=False),
    "planar-four-bar": Problem("planar-four-bar", {}, "P3", singular=False, for_peers=False),
    "rigid-crane": Problem("rigid-crane", {}, "tip", singular=False, conserves=False, for_peers=False),
}


def _slider(settings, times):
    """Path of a slider that starts ahead of its crank, from m θ̈ + m′ θ̇² / 2 + V′ = 0 in the crank's angle θ.

    The rod is not shorter than the crank. Where they are equal, its angle is φ = −θ through singular configurations.
    """
    crank, rod, gravity = settings["crank"], settings["rod"], settings["gravity"]
    crank_mass, rod_mass, slider_mass = (settings[f"{part}_mass"] for part in ("crank", "rod", "slider"))

    def rod_angle(theta):
        """φ, φ′ and φ″ from crank sin θ + rod sin φ = 0."""
        if rod == crank:
            return -theta, -1.0, 0.0
        phi = -np.arcsin(crank / rod * np.sin(theta))
        first = -crank / rod * np.cos(theta) / np.cos(phi)
        return phi, first, (crank / rod * np.sin(theta) + np.sin(phi) * first**2) / np.cos(phi)

    def rates(_, y):
        theta, speed = y
        phi, first, second = rod_angle(theta)
        along_crank, along_rod = crank * np.exp(1j * theta), rod * np.exp(1j * phi)
        # Places as complex numbers: derivatives by θ of the rod's centre, half of its end's for the part of the rod.
        rod_first, rod_second = 1j * first * along_rod, (1j * second - first**2) * along_rod
        center_first, center_second = 1j * along_crank + rod_first / 2, -along_crank + rod_second / 2
        end_first, end_second = (1j * along_crank + rod_first).real, (-along_crank + rod_second).real
        mass = crank_mass * crank**2 / 3 + slider_mass * end_first**2
        mass += rod_mass * (abs(center_first) ** 2 + (rod * first) ** 2 / 12)
        half_slope = slider_mass * end_first * end_second
        half_slope += rod_mass * ((center_first.conjugate() * center_second).real + rod**2 * first * second / 12)
        weight = gravity * (crank_mass * along_crank.real / 2 + rod_mass * center_first.imag)
        return [speed, -(half_slope * speed**2 + weight) / mass]

    start = [settings["angle"], settings["speed"]]
    found = solve_ivp(rates, (0.0, times[-1]), start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=times)
    theta = found.y[0]
    reach = crank * np.cos(theta) + rod * np.cos(rod_angle(theta)[0])
    return np.stack([reach, np.zeros_like(reach), np.zeros_like(reach)], axis=-1)


def by_newton_euler(problem: Problem, times=TIMES) -> np.ndarray:
    """Path of the tracked point by equations that share nothing with linkax but the description."""
    description = problem.describe()
    return path(description, newton_euler.simulate(description, times), *description.tracked)


def add_problems(parser: argparse.ArgumentParser, known=tuple(PROBLEMS)):
    """Let a command line name problems, by their keys or by their scenes: `chosen(arguments.problems)`."""

    def keys(text):
        found = [key for key in known if text in (key, PROBLEMS[key].scene)]
        if not found:
            names = dict.fromkeys([*known, *(PROBLEMS[key].scene for key in known)])
            raise argparse.ArgumentTypeError(f"unknown problem {text!r}; known: {', '.join(names)}")
        return found

    told = f"a scene, or of {', '.join(known)}; default: all"
    parser.add_argument("problems", nargs="*", type=keys, default=[list(known)], metavar="PROBLEM", help=told)


def chosen(problems: list[list[str]]) -> list[str]:
    """Keys of `PROBLEMS`, each once."""
    return list(dict.fromkeys(key for keys in problems for key in keys))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_problems(parser)
    for key in chosen(parser.parse_args().problems):
        problem = PROBLEMS[key]
        reference = problem.reference()
        apart = {"linkax": np.max(np.abs(problem.by_linkax() - reference))}
        if not problem.singular:
            apart["Newton-Euler"] = np.max(np.abs(by_newton_euler(problem) - reference))
        print(key, problem.name, *(f"{name} {value:.1e} m" for name, value in apart.items()), sep="  ", flush=True)


if __name__ == "__main__":
    main()
