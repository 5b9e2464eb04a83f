"""Row of N parallelogram four-bars, problem A02 of the LIM/IFToMM benchmark library.

Where all links are in line it has N + 1 degrees of freedom for a moment.
"""

import numpy as np

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.closed_form import turned_link
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    count, length, mass = parameters["N"], parameters["length"], parameters["mass"]
    links = [lx.rod(f"link_{i}", length, mass) for i in range(count + 1)]
    couplers = [lx.rod(f"coupler_{i}", length, mass) for i in range(1, count + 1)]
    joints = [
        lx.Revolute(f"pivot_{i}", lx.GROUND.at([i * length, 0.0, 0.0]), link.at("base"), axis="z")
        for i, link in enumerate(links)
    ]
    for i, coupler in enumerate(couplers, start=1):
        joints += [
            lx.Revolute(f"left_{i}", links[i - 1].at("tip"), coupler.at("base"), axis="z"),
            lx.Revolute(f"right_{i}", coupler.at("tip"), links[i].at("tip"), axis="z"),
        ]
    return lx.Mechanism([*links, *couplers], joints, [lx.Gravity([0.0, -parameters["gravity"], 0.0])])


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    """Give all joints, as a start with the links in line has other branches too."""
    return lx.assemble(
        mechanism,
        positions=_parallel(parameters["N"], parameters["angle"]),
        speeds=_parallel(parameters["N"], parameters["speed"]),
    )


def _parallel(count: int, turn: Number) -> dict[str, Number]:
    """Give all joints their coordinates, or speeds, where links turn alike and couplers only translate."""
    return (
        {f"pivot_{i}": turn for i in range(count + 1)}
        | {f"left_{i}": -turn for i in range(1, count + 1)}
        | {f"right_{i}": turn for i in range(1, count + 1)}
    )


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
    """Couplers only translate, so that the row moves like a pendulum of N + 1 links and N masses at their ends."""
    count, length = parameters["N"], parameters["length"]
    weight, inertia = (count + 1) / 2 + count, (count + 1) / 3 + count
    stiffness = parameters["gravity"] / length * weight / inertia
    link = turned_link(times, stiffness, parameters["angle"], parameters["speed"])
    return None if link is None else {"B0": length * link}


N_FOUR_BAR = described(
    "n-four-bar",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"B0": ("link_0", "tip")},
    exact=_exact,
)
