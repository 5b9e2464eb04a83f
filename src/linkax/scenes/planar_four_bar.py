"""Planar four-bar of massless links with two particles, from a textbook.

J. Moore, Learn Multibody Dynamics, chapter on holonomic constraints. One link has no mass at all.
"""

import math

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.scene import Parameters, described


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    def massless(name: str, length: Number, particle: Number) -> lx.RigidBody:
        """Make a massless link with a particle at its tip."""
        tip = [length, 0.0, 0.0]
        return lx.RigidBody(name, particle, center_of_mass=tip, frames={"base": [0.0, 0.0, 0.0], "tip": tip})

    a = massless("link_a", parameters["a"], parameters["mass_2"])
    b = massless("link_b", parameters["b"], parameters["mass_3"])
    c = massless("link_c", parameters["c"], 0.0)
    return lx.Mechanism(
        [a, b, c],
        [
            lx.Revolute("P1", lx.GROUND, a.at("base"), axis="z"),
            lx.Revolute("P2", a.at("tip"), b.at("base"), axis="z"),
            lx.Revolute("P3", b.at("tip"), c.at("base"), axis="z"),
            lx.Revolute("P4", lx.GROUND.at([parameters["ground"], 0.0, 0.0]), c.at("tip"), axis="z", cut=True),
        ],
        [lx.Gravity([0.0, -parameters["gravity"], 0.0])],
    )


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    guess = {"P2": math.radians(6.6), "P3": math.radians(-151.4)}
    return lx.assemble(mechanism, {"P1": parameters["angle"]}, {"P1": parameters["speed"]}, guess=guess)


PLANAR_FOUR_BAR = described(
    "planar-four-bar",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"P2": ("link_a", "tip"), "P3": ("link_b", "tip")},
)
