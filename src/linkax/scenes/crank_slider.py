"""Planar crank-slider with equal lengths, which passes singular positions: example a of the paper.

Zhao, Qi, Wang, Xu, Applied Mathematics and Mechanics 47(8), 2026, doi 10.21656/1000-0887.450230.
"""

import jax
import jax.numpy as jnp

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.scene import Parameters, described
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


CRANK_SLIDER = described(
    "crank-slider",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"slider": ("slider", None)},
)
