"""Telescopic crane with a flexible boom: example c of the paper (Figs. 16 to 20), with numbers of our own.

A turntable carries a boom of three box sections that bend. Each section slides in the one before, on a pad at its
rear end and on a pad at the front end of that one. One cylinder luffs the boom, another pushes the second section
out, and a rope from the first section over a sheave at the front of the second pulls the third one out as far. The
load hangs on a rope from the tip.

Both cylinders have prescribed lengths, or are hydraulic: then a valve feeds each, which a controller opens so that the
cylinder takes the same course.

Sizes are about those of a mobile crane for 30 tonnes, from no data sheet.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import linkax as lx
from linkax.model.bodies import BodyOrFrame
from linkax.model.numbers import Number
from linkax.scenes.course import Course
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Scalar

SECTION = 10.0  # length of each section [m]
FOOT = (2.0, -1.0)  # of the luffing cylinder, from the boom's pivot [m]
HEAD = 4.0  # of the luffing cylinder, along the boom [m]
END = 1.0  # of the extension rope and its sheave, from the ends of the sections [m]
SHEAVE = 0.2  # of the same, above the axes of the sections [m]
STROKES = {"luffing": (2.0, 3.2), "telescoping": (0.0, 8.0)}  # where a cylinder is closed, and its stroke [m]
STEEL = {"poissons_ratio": 0.3, "density": 7850.0}


class Reach(eqx.Module):
    """The length of the luffing cylinder [m] where the angle of the unbent boom takes a course [rad]."""

    angle: Course

    def __call__(self, t: Number) -> Scalar:
        return reach(self.angle(t))


def reach(angle: Number) -> Scalar:
    """Compute the length of the luffing cylinder [m] at an angle of the unbent boom [rad]."""
    return jnp.hypot(HEAD * jnp.cos(angle) - FOOT[0], HEAD * jnp.sin(angle) - FOOT[1])


def _course(parameters: Parameters, name: str) -> Course:
    begin, end = parameters[name], parameters[f"{name}_change"]
    return Course(*map(jnp.asarray, (begin, begin + end, parameters["duration"])))


def _boom(parameters: Parameters) -> list[lx.Beam]:
    steel = lx.Material(parameters["modulus"], **STEEL)
    planar = parameters["planes"] == 1
    profile = lambda index: lx.rectangle(
        parameters[f"height_{index}"], parameters[f"width_{index}"], steel, parameters["wall"]
    )
    return [
        lx.Beam(
            f"section_{index}",
            SECTION,
            profile(index),
            elements=parameters["elements"],
            bends="z" if planar else "yz",
            torsion=not planar,
            stretch=False,
            damping=parameters["damping"],
        )
        for index in (1, 2, 3)
    ]


def _telescope(
    outer: lx.Beam, inner: lx.Beam, index: int, pad: Callable[..., lx.AbstractJoint]
) -> tuple[list[lx.RigidBody], list[lx.AbstractJoint]]:
    """Make the pads between two sections: massless shoes that slide on one, and joints from these to the other."""
    rear, front = (lx.point_mass(f"{end}_shoe_{index}", 0.0) for end in ("rear", "front"))
    return [rear, front], [
        lx.Sliding(f"extension_{index}", outer, rear),
        pad(f"rear_pad_{index}", rear, inner),
        lx.Sliding(f"overlap_{index}", inner, front),
        pad(f"front_pad_{index}", front, outer.at("tip"), cut=True),
    ]


def _hydraulic(parameters: Parameters, name: str, course: Course | Reach) -> dict[str, Any]:
    """What a hydraulic cylinder is given, but for what it acts on.

    Its valve opens as far as the course asks for, and farther in proportion to what the cylinder is behind.
    """
    bore, rod, gain = parameters[f"{name}_bore"], parameters[f"{name}_rod"], jnp.asarray(parameters["gain"])
    areas = jnp.pi / 4.0 * bore**2, jnp.pi / 4.0 * (bore**2 - rod**2)
    numbers = {key: parameters[key] for key in ("supply", "valve", "bulk_modulus", "dead_volume", "leakage")}
    half = parameters["supply"] / 2.0  # about the pressures, and their drop in the valve
    full_speed = jnp.asarray(parameters["valve"] * half**0.5 / areas[0])

    def opening(t, motion):
        wanted, speed = jax.jvp(course, (t,), (jnp.ones_like(t),))
        return jnp.clip((speed + gain * (wanted - motion.length(name))) / full_speed, -1.0, 1.0)

    numbers |= {"areas": areas, "damping": parameters["seals"], "pressures": (half, half)}
    closed, stroke = STROKES[name]
    return {"name": name, "opening": opening, "closed": closed, "stroke": stroke, **numbers}


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    boom = first, second, third = _boom(parameters)
    planar = parameters["planes"] == 1

    def hinge(
        name: str, parent: BodyOrFrame, child: BodyOrFrame, cut: bool = False, second_axis: str = "y"
    ) -> lx.AbstractJoint:
        if planar:
            return lx.Revolute(name, parent, child, axis="z", cut=cut)
        return lx.Universal(name, parent, child, axis="z", second_axis=second_axis, cut=cut)

    turntable = lx.RigidBody("turntable", 1e4, inertia=[2e4, 3e4, 2e4])
    payload = lx.point_mass("payload", parameters["payload"])
    shoes_2, pads_2 = _telescope(first, second, 2, hinge)
    shoes_3, pads_3 = _telescope(second, third, 3, hinge)
    foot, head = turntable.at([*FOOT, 0.0]), first.at(HEAD)
    lengths = {"luffing": Reach(_course(parameters, "angle")), "telescoping": _course(parameters, "extension")}
    forces, cylinders = [], []
    if parameters["cylinders"] == 1:
        cylinders = [
            lx.Rope("luffing", [foot, head], lengths["luffing"]),
            lx.Drive("telescoping", "extension_2", lengths["telescoping"]),
        ]
    else:
        luffing, telescoping = (_hydraulic(parameters, name, course) for name, course in lengths.items())
        forces = [
            lx.HydraulicCylinder(foot, head, **luffing),
            lx.HydraulicActuator("extension_2", **telescoping),
        ]
    above = lambda section, along: section.at([along, SHEAVE, 0.0])
    return lx.Mechanism(
        [turntable, *boom, *shoes_2, *shoes_3, payload],
        [
            lx.Revolute("slew", lx.GROUND, turntable, axis="y"),
            lx.Revolute("pivot", turntable, first, axis="z"),
            *pads_2,
            *pads_3,
            hinge("hook", third.at("tip"), payload.at([0.0, parameters["hoist"], 0.0]), second_axis="x"),
        ],
        [lx.Gravity([0.0, -parameters["gravity"], 0.0]), *forces],
        [
            lx.Drive("slewing", "slew", _course(parameters, "slew")),
            *cylinders,
            lx.Rope(
                "extension_rope",
                [above(first, SECTION - END), above(second, SECTION - END), above(third, END)],
                SECTION - 2.0 * END,  # so that both extensions are equal where nothing bends
            ),
        ],
    )


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    """Start at rest, bent by the load that hangs there before."""
    before = _mechanism({**parameters, "payload": parameters["payload"] + parameters["dropped"]})
    extension, angle = parameters["extension"], parameters["angle"]
    guess = {"slew": parameters["slew"], "pivot": angle, "hook": -angle}
    for index in (2, 3):
        guess |= {f"extension_{index}": extension, f"overlap_{index}": SECTION - extension}
    if parameters["planes"] != 1:
        guess["hook"] = [-angle, 0.0]
    return lx.equilibrium(before, lx.assemble(before, guess=guess))


TELESCOPIC_CRANE = described(
    "telescopic-crane",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"tip": ("section_3", "tip"), "load": ("payload", None)},
)
