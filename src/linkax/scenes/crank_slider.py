"""Planar crank-slider with equal lengths, which passes singular positions: example a of the paper.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
"""

import math

import jax
import jax.numpy as jnp

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.scene import Parameters, Scene, Variant
from linkax.xla.arrays import Scalar


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    crank = lx.rod("crank", length=parameters["crank"], mass=parameters["crank_mass"])
    rod = lx.rod("rod", length=parameters["rod"], mass=parameters["rod_mass"])
    slider = lx.point_mass("slider", mass=parameters["slider_mass"])
    return lx.Mechanism(
        bodies=[crank, rod, slider],
        joints=[
            lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
            lx.Revolute("crank_pin", crank.at("tip"), rod.at("base"), axis="z"),
            lx.Revolute("wrist_pin", rod.at("tip"), slider, axis="z"),
            lx.Prismatic("guide", lx.GROUND, slider, axis="x"),
        ],
        forces=[lx.Gravity([0.0, -parameters["gravity"], 0.0]), lx.JointTorque("bearing", parameters["torque"])],
    )


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    crank, angle, speed = parameters["crank"], parameters["angle"], parameters["speed"]
    inclination, rate, distance = _rod(crank, parameters["rod"], angle, speed)
    return lx.assemble(
        mechanism,
        positions={"bearing": angle},
        # Both speeds, since a start with crank and rod on each other has two branches.
        speeds={"bearing": speed, "crank_pin": rate - speed},
        guess={"crank_pin": inclination - angle, "guide": distance},
    )


@jax.jit
def _rod(crank: Number, rod: Number, angle: Number, speed: Number) -> tuple[Scalar, Scalar, Scalar]:
    """Compute the rod's angle from +x [rad], its rate [rad/s], and the slider's distance [m].

    Where the crank is not shorter than the rod, the rod points to +x while the crank does. With equal lengths the
    slider then moves through the crank's axis instead of resting there.
    """
    along_crank, across_crank = crank * jnp.cos(angle), crank * jnp.sin(angle)
    # rod² - across_crank², written so that equal lengths give along_crank² to rounding.
    square = (rod - crank) * (rod + crank) + along_crank**2
    reached = square > 0.0  # elsewhere assembly says that the loop does not close
    side = jnp.where((crank < rod) | (along_crank > 0.0), 1.0, -1.0)
    along_rod = side * jnp.sqrt(jnp.where(reached, square, 1.0))
    inclination = jnp.arctan2(-across_crank, along_rod)
    return inclination, -speed * along_crank / along_rod, along_crank + along_rod


CRANK_SLIDER = Scene(
    name="crank-slider",
    summary="planar crank-slider, with equal lengths unless set otherwise (example a of the paper)",
    parameters={
        "crank": 1.0,
        "rod": 1.0,
        "crank_mass": 1.0,
        "rod_mass": 1.0,
        "slider_mass": 1.0,
        "gravity": 9.81,
        "torque": 0.0,
        "angle": 0.0,
        "speed": 0.0,
    },
    meanings={
        "crank": "length of the crank [m]",
        "rod": "length of the connecting rod [m]",
        "crank_mass": "mass of the crank, a uniform slender rod [kg]",
        "rod_mass": "mass of the connecting rod, a uniform slender rod [kg]",
        "slider_mass": "mass of the slider [kg]",
        "gravity": "along -y [m/s²]",
        "torque": "on the crank, constant [N m]",
        "angle": "of the crank from +x, at the start [rad]",
        "speed": "of the crank, at the start [rad/s]",
    },
    variants={
        "SC1": Variant("released from rest, stretched, under gravity; swings through the singular position"),
        "SC2": Variant("turns without gravity", {"gravity": 0.0, "angle": math.pi / 4, "speed": 2.0}),
        "SC3": Variant("turns under gravity", {"speed": 8.0}),
        "SC4": Variant("swings from rest at 60 degrees under gravity", {"angle": math.pi / 3}),
        "regular": Variant(
            "rod three times the crank, driven by a torque from rest: no singular position",
            {
                "crank": 0.1,
                "rod": 0.3,
                "crank_mass": 0.2,
                "rod_mass": 0.2,
                "slider_mass": 0.4,
                "gravity": 0.0,
                "torque": 0.1,
            },
            t1=3.0,
        ),
    },
    default_variant="SC1",
    t1=10.0,
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"slider": ("slider", None)},
)
