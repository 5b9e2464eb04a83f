"""Rods, by their length or between two points in the world."""

import numpy as np

from linkax.model.bodies import RigidBody
from linkax.model.numbers import Number, Vector, number, positive, require, zero_or_more
from linkax.xla.arrays import Scalar
from linkax.xla.tracing import concrete


def rod(name: str, length: Number, mass: Number, thickness: Number = 0.0) -> RigidBody:
    """Make a uniform round rod along its x axis, from frame "base", its reference frame, to frame "tip".

    Its moment of inertia is mass × (length² / 12 + thickness² / 16) about transverse axes, and mass × thickness² / 8
    about its own.

    **Arguments:** `name`: unique in the mechanism; `length` [m]; `mass` [kg]; `thickness`: its diameter [m].

    **Raises:** `ValueError` for a length that is not positive, and for a negative mass or thickness.
    """
    length = positive(length, f"rod {name!r}: length [m]")
    mass = number(mass, (), f"body {name!r}: mass [kg]")
    own, across = _moments(name, length, mass, thickness)
    return RigidBody(
        name,
        mass,
        center_of_mass=[length / 2, 0.0, 0.0],
        inertia=[own, across, across],
        frames={"base": [0.0, 0.0, 0.0], "tip": [length, 0.0, 0.0]},
    )


def rod_between(name: str, base: Vector, tip: Vector, mass: Number, thickness: Number = 0.0) -> RigidBody:
    """Make the same rod from one point to another in the world, in the configuration in which a model is drawn.

    It is `placed` (see `RigidBody.placed`): frames "base", its reference frame, and "tip" are parallel to the world's
    as drawn, so that joints between such rods have coordinate zero there, and axes in the world:

    ```python
    O, A, B, C = [0.0, 0.0, 0.0], [0.0, 0.4, 0.0], [1.0, 0.9, 0.0], [1.0, 0.0, 0.0]
    crank = lx.rod_between("crank", O, A, mass=1.0)
    coupler = lx.rod_between("coupler", A, B, mass=1.0)
    rocker = lx.rod_between("rocker", C, B, mass=1.0)
    joints = [
        lx.Revolute("O", lx.GROUND, crank, axis="z"),
        lx.Revolute("A", crank.at("tip"), coupler, axis="z"),
        lx.Revolute("B", coupler.at("tip"), rocker.at("tip"), axis="z"),
        lx.Revolute("C", lx.GROUND.at(C), rocker, axis="z"),
    ]
    four_bar = lx.Mechanism([crank, coupler, rocker], joints)
    state = lx.assemble(four_bar)  # as drawn
    ```

    **Arguments:** `name`: unique in the mechanism; `base`, `tip`: [x, y, z] [m]; `mass` [kg]; `thickness`: its diameter
    [m].

    **Raises:** `ValueError` for points that coincide, and for a negative mass or thickness.
    """
    base, tip = (number(end, (3,), f"rod {name!r}: {what} [m]") for end, what in ((base, "base"), (tip, "tip")))
    mass, way = number(mass, (), f"body {name!r}: mass [kg]"), tip - base
    what, remedy = f"rod {name!r}: way from base to tip [m]", "give two points apart"
    way = require(way, lambda entries: (entries * entries).sum() > 0.0, what, remedy)
    square = (way * way).sum()
    own, across = _moments(name, square**0.5, mass, thickness)
    along = way[:, None] * way / square
    inertia = across * (np.eye(3) - along) + own * along
    frames = {"base": [0.0, 0.0, 0.0], "tip": way}
    return RigidBody(name, mass, way / 2, inertia, frames).placed(base)


def _moments(name: str, length: Scalar, mass: Scalar, thickness: Number) -> tuple[Number, Scalar]:
    """Moments of inertia of a rod about its own axis and across it [kg m²]; a known zero stays one."""
    if concrete(thickness) is not None and np.ndim(thickness) == 0 and not thickness:
        return 0.0, mass * length**2 / 12
    thickness = zero_or_more(thickness, f"rod {name!r}: thickness [m]")
    return mass * thickness**2 / 8, mass * (length**2 / 12 + thickness**2 / 16)
