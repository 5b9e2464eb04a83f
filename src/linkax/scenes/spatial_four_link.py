"""Rhombus of spatial bodies and hinges: example b of the paper, as far as it can be inferred.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230. The paper gives
neither lengths nor masses; these are ours. Three constraints are always redundant, a fourth where all links are in
line.
"""

import numpy as np

import linkax as lx
from linkax.scenes.closed_form import turned_link
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    length, mass = parameters["length"], parameters["mass"]
    crank, coupler, rocker = (lx.rod(name, length, mass) for name in ("crank", "coupler", "rocker"))
    return lx.Mechanism(
        [crank, coupler, rocker],
        [
            lx.Revolute("A", lx.GROUND, crank.at("base"), axis="z"),
            lx.Revolute("B", crank.at("tip"), coupler.at("base"), axis="z"),
            lx.Revolute("C", coupler.at("tip"), rocker.at("tip"), axis="z"),
            lx.Revolute("D", lx.GROUND.at([length, 0.0, 0.0]), rocker.at("base"), axis="z"),
        ],
        [lx.Gravity([0.0, -parameters["gravity"], 0.0])],
    )


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    """Give all joints, as a start with the links in line has other branches too."""
    turning = lambda turn: {"A": turn, "B": -turn, "C": turn, "D": turn}
    return lx.assemble(mechanism, turning(parameters["angle"]), turning(parameters["speed"]))


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
    """The coupler only translates, so that the rhombus moves like a pendulum: 5/3 m l² α̈ = −2 m g l cos α."""
    length = parameters["length"]
    stiffness = 1.2 * parameters["gravity"] / length
    link = turned_link(times, stiffness, parameters["angle"], parameters["speed"])
    return None if link is None else {"C": length * (link + np.array([1.0, 0.0, 0.0]))}


SPATIAL_FOUR_LINK = described(
    "spatial-four-link",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"C": ("coupler", "tip")},
    exact=_exact,
)
