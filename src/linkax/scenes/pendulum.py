"""Planar simple pendulum, problem A01 of the LIM/IFToMM benchmark library."""

import numpy as np

import linkax as lx
from linkax.scenes.closed_form import turned_link
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    at_tip = [parameters["length"], 0.0, 0.0]
    link = lx.RigidBody("link", parameters["mass"], center_of_mass=at_tip, frames={"bob": at_tip})
    return lx.Mechanism(
        bodies=[link],
        joints=[lx.Revolute("pivot", lx.GROUND, link, axis="z")],
        forces=[lx.Gravity([0.0, -parameters["gravity"], 0.0])],
    )


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    return lx.assemble(mechanism, {"pivot": parameters["angle"]}, {"pivot": parameters["speed"]})


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
    length = parameters["length"]
    link = turned_link(times, parameters["gravity"] / length, parameters["angle"], parameters["speed"])
    return None if link is None else {"bob": length * link}


PENDULUM = described(
    "pendulum",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"bob": ("link", "bob")},
    exact=_exact,
)
