"""Beams that stretch, without damping: time and error by solver and tolerance, beside Exudyn.

elastic-rod: a crank-slider at 150 rad/s with a thin elastic rod (Chu and Pan, Journal of Engineering for Industry 97,
1975; the crank is a flywheel here); how far the middle of the rod is off the line between its ends. rotating-beam:
a cantilever on a hub that a torque turns ever faster (Kane, Ryan, Banerjee, Journal of Guidance 10, 1987): where its
tip is. Errors are the largest at 201 times, over the largest value, against more elements and a tolerance of 1e-8;
Exudyn's rows follow where it is installed.
"""

import dataclasses
import importlib.util
import math
from typing import NamedTuple

import diffrax
import jax
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts
from benchmarks.peers.runs import timed

MOST_STEPS = 10**6
PEER_STEPS = (500, 1000, 2000, 4000, 8000)


@dataclasses.dataclass(frozen=True)
class BeamProblem:
    """A beam along x on the end of a hub, which turns about z.

    - `arm`: from the hub's centre to the beam's base [m]. `speed`: of the hub at the start [rad/s]. `torque` [N m].
    - `slider`: mass at the beam's tip that moves along x [kg]; without one the beam is clamped to the hub.
    """

    length: float
    bending_stiffness: float
    axial_stiffness: float
    linear_density: float
    arm: float
    hub_inertia: float
    speed: float
    torque: float
    slider: float
    duration: float
    elements: tuple[int, ...]
    reference: int
    saves: int = 200

    @property
    def beam_turning(self):
        """The beam's angular velocity at the start [rad/s]."""
        return -self.speed * self.arm / self.length if self.slider else self.speed

    def mechanism(self, elements):
        section = lx.Section(self.bending_stiffness, self.linear_density, self.axial_stiffness, rotary_inertia=0.0)
        hub = lx.RigidBody("hub", 1.0, inertia=self.hub_inertia * np.ones(3))
        beam = lx.Beam("beam", self.length, section, elements=elements, bends="z", torsion=False)
        bodies, end = [hub, beam], hub.at([self.arm, 0.0, 0.0])
        joints = [lx.Revolute("axle", lx.GROUND, hub, axis="z")]
        if self.slider:
            bodies.append(lx.point_mass("slider", self.slider))
            joints += [
                lx.Revolute("pin", end, beam.at("base"), axis="z"),
                lx.Revolute("wrist", beam.at("tip"), bodies[-1], axis="z"),
                lx.Prismatic("guide", lx.GROUND, bodies[-1], axis="x"),
            ]
        else:
            joints.append(lx.Fixed("clamp", end, beam.at("base")))
        return lx.Mechanism(bodies, joints, [lx.JointTorque("axle", self.torque)])

    def start(self, mechanism):
        straight = np.zeros(mechanism.topology.speeds["beam"].stop - mechanism.topology.speeds["beam"].start)
        return lx.assemble(mechanism, {"axle": 0.0, "beam": straight}, {"axle": self.speed, "beam": straight})

    def deflection(self, base, middle, tip):
        """What is compared, from points (n_t, 2): the middle off the line between the ends, or the tip."""
        if not self.slider:
            return tip
        chord, across = tip - base, middle - base
        return (chord[:, 0] * across[:, 1] - chord[:, 1] * across[:, 0]) / np.linalg.norm(chord, axis=1)


DIAMETER, STEEL = 6e-3, 2e11
AREA = math.pi * DIAMETER**2 / 4.0
PROBLEMS = {
    "elastic-rod": BeamProblem(
        length=0.3,
        bending_stiffness=STEEL * math.pi * DIAMETER**4 / 64.0,
        axial_stiffness=STEEL * AREA,
        linear_density=7870.0 * AREA,
        arm=0.15,
        hub_inertia=1.0,
        speed=150.0,
        torque=0.0,
        slider=0.033,
        duration=0.1,
        elements=(2, 3, 4),
        reference=6,
    ),
    "rotating-beam": BeamProblem(
        length=10.0,
        bending_stiffness=1.4e4,
        axial_stiffness=2.8e7,
        linear_density=1.2,
        arm=0.0,
        hub_inertia=1e4,
        speed=0.0,
        torque=4160.0,
        slider=0.0,
        duration=5.0,
        elements=(2, 3),
        reference=5,
    ),
}


class Choice(NamedTuple):
    """A solver of linkax and its tolerance."""

    solver: diffrax.AbstractSolver
    rtol: float


CHOICES = [
    *(Choice(lx.Rodas5P(), rtol) for rtol in (1e-2, 1e-3, 1e-4, 1e-5)),
    *(Choice(diffrax.Kvaerno5(), rtol) for rtol in (1e-3, 1e-4)),
    *(Choice(diffrax.Dopri8(), rtol) for rtol in (1e-4, 1e-6)),
]


def measured(problem, elements, choice):
    """What bends, seconds, steps."""
    mechanism = problem.mechanism(elements)
    state = problem.start(mechanism)
    options = {"solver": choice.solver, "accuracy": lx.Accuracy(choice.rtol), "max_steps": MOST_STEPS}
    simulate = lambda: jax.block_until_ready(lx.simulate(mechanism, state, t1=problem.duration, **options))
    simulate()
    solution, seconds = timed(simulate)
    points = [solution.position("beam", at=x)[:, :2] for x in ("base", problem.length / 2.0, "tip")]
    return problem.deflection(*map(np.asarray, points)), seconds, int(solution.stats["num_steps"])


def rows_of(problem):
    exact, *_ = measured(problem, problem.reference, Choice(diffrax.Dopri8(), 1e-8))
    largest = np.max(np.abs(exact))
    error = lambda found: f"{np.max(np.abs(found - exact)) / largest:.1e}"

    def row(solver, elements, found, seconds, steps):
        return {**solver, "elements": elements, "run_s": f"{seconds:.3g}", "steps": steps, "error": error(found)}

    for elements in problem.elements:
        for choice in CHOICES:
            solver = {"solver": type(choice.solver).__name__, "rtol": choice.rtol}
            yield row(solver, elements, *measured(problem, elements, choice))
    if importlib.util.find_spec("exudyn"):
        from benchmarks.peers import exudyn_beams

        for elements in (4, 8, 16):
            for steps in PEER_STEPS:
                points, seconds = exudyn_beams.run(problem, elements, steps)
                yield row({"solver": "Exudyn"}, elements, problem.deflection(*points), seconds, steps)


if __name__ == "__main__":
    print_parts(__doc__, {name: lambda problem=problem: rows_of(problem) for name, problem in PROBLEMS.items()})
