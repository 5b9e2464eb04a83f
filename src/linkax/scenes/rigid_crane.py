"""Luffing telescopic crane of rigid sections, in place of example c of the paper, with numbers of our own.

Three sections slide in each other. A rope makes the third one follow the second, and a cylinder luffs the boom.
"""

import jax.numpy as jnp

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Scalar

SECTION = 10.0  # length of each section [m]
OVERLAP = 1.0  # from the rear end of a section to that of the next, retracted [m]
FOOT = (2.0, -1.0)  # of the luffing cylinder, from the boom's pivot [m]
HEAD = 4.0  # of the luffing cylinder, along the boom [m]


def _section(index: int, mass: Number) -> lx.RigidBody:
    return lx.rod(f"section_{index}", SECTION, mass)


def _cylinder(name: str, mass: Number, center: float, inertia: float) -> lx.RigidBody:
    """Make a part of the luffing cylinder along x: `mass` [kg], `center` of mass halfway [m], `inertia` [kg m²]."""
    frames = {"end": [2.0 * center, 0.0, 0.0]}
    return lx.RigidBody(name, mass, [center, 0.0, 0.0], [0.0, inertia, inertia], frames)


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    sections = [_section(index, parameters[f"mass_{index}"]) for index in (1, 2, 3)]
    barrel = _cylinder("barrel", 150.0, 1.2, 80.0)
    piston = _cylinder("piston", 100.0, -1.0, 40.0)
    payload = lx.point_mass("payload", parameters["payload"])
    foot, head = lx.GROUND.at([*FOOT, 0.0]), sections[0].at([HEAD, 0.0, 0.0])
    extension, stiffness, damping = (parameters[f"telescope_{name}"] for name in ("rest", "stiffness", "damping"))
    return lx.Mechanism(
        [*sections, barrel, piston, payload],
        [
            lx.Revolute("boom", lx.GROUND, sections[0].at("base"), axis="z"),
            lx.Prismatic("slide_2", sections[0].at("base"), sections[1].at("base"), axis="x"),
            lx.Prismatic("slide_3", sections[1].at("base"), sections[2].at("base"), axis="x"),
            lx.Fixed("hook", sections[2].at("tip"), payload),
            lx.Revolute("foot", foot, barrel, axis="z"),
            lx.Prismatic("luffing", barrel, piston, axis="x"),
            lx.Revolute("head", head, piston, axis="z"),
        ],
        [
            lx.Gravity([0.0, -parameters["gravity"], 0.0]),
            lx.Spring(foot, head, parameters["luffing_stiffness"], _reach(parameters["luffing_angle"])),
            lx.Damper(foot, head, parameters["luffing_damping"]),
            lx.JointSpring("slide_2", stiffness, OVERLAP + extension),
            lx.JointDamper("slide_2", damping),
        ],
        [lx.Coupling("rope", {"slide_3": 1.0, "slide_2": -1.0})],
    )


def _reach(angle: Number) -> Scalar:
    """Compute the length of the luffing cylinder [m] at an angle of the boom [rad]."""
    return jnp.hypot(HEAD * jnp.cos(angle) - FOOT[0], HEAD * jnp.sin(angle) - FOOT[1])


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    angle, slide = parameters["angle"], OVERLAP + parameters["extension"]
    inclination = jnp.arctan2(HEAD * jnp.sin(angle) - FOOT[1], HEAD * jnp.cos(angle) - FOOT[0])
    guess = {"slide_3": slide, "foot": inclination, "luffing": _reach(angle), "head": inclination - angle}
    guess = {name: value for name, value in guess.items() if name in mechanism.topology.coordinates}
    return lx.assemble(mechanism, {"boom": angle, "slide_2": slide}, {"boom": 0.0, "slide_2": 0.0}, guess=guess)


RIGID_CRANE = described(
    "rigid-crane",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"tip": ("section_3", "tip")},
)
