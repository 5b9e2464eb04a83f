"""Bricard's mechanism, problem A04 of the LIM/IFToMM benchmark library.

Five rods and six hinges have no mobility by count. It moves, as one of its loop rows always depends on the others.
"""

import linkax as lx
from linkax.scenes.scene import Parameters, described

# Positions of the hinges at the start, in lengths of a rod, and the axis of each.
PLACES = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, -1.0, 0.0), (1.0, -1.0, 1.0), (0.0, -1.0, 1.0), (0.0, 0.0, 1.0))
AXES = "yzxyzx"


def _rod(index: int, parameters: Parameters) -> lx.RigidBody:
    """Make a square bar from one hinge to the next, in world axes at the start."""
    along = [end - begin for begin, end in zip(PLACES[index], PLACES[index + 1], strict=True)]
    length, width, mass = parameters["length"], parameters["width"], parameters["mass"]
    own, across = mass * width**2 / 6.0, mass * (length**2 + width**2) / 12.0
    return lx.RigidBody(
        f"rod_{index + 1}",
        mass,
        center_of_mass=[length * part / 2.0 for part in along],
        inertia=[own if part else across for part in along],
        frames={"base": [0.0, 0.0, 0.0], "tip": [length * part for part in along]},
    )


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    rods = [_rod(index, parameters) for index in range(5)]
    far = lx.GROUND.at([parameters["length"] * part for part in PLACES[-1]])
    ends = [lx.GROUND, *(rod.at("tip") for rod in rods)], [*(rod.at("base") for rod in rods), far]
    joints = [
        lx.Revolute(f"P{index + 1}", *pair, axis=axis)
        for index, (pair, axis) in enumerate(zip(zip(*ends, strict=True), AXES, strict=True))
    ]
    return lx.Mechanism(rods, joints, [lx.Gravity([0.0, -parameters["gravity"], 0.0])])


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    return lx.assemble(mechanism, {"P1": parameters["angle"]}, {"P1": parameters["speed"]})


BRICARD = described(
    "bricard",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"P3": ("rod_2", "tip")},
)
