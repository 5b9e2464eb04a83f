"""Planar six-bars of the two kinds that there are, Watt's and Stephenson's, with lengths of our own.

Both are four-bars with a crank, whose coupler and, of Watt's, rocker are triangles; two more bars, a dyad, hang on
these, of Stephenson's on the coupler and the ground. These are Watt's I and Stephenson's III, see McCarthy and Soh,
Geometric Design of Linkages (2nd ed.), chapter 1. The crank turns fully, and no dyad stretches.
"""

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.planar import Point, along, closed, linked, meet, on_ground, outline, pin, settled
from linkax.scenes.scene import Parameters, Scene, described
from linkax.xla.arrays import Array


def _corner(base: Point, tip: Point, length: Number, angle: Number) -> Point:
    """Compute the third corner of a triangle, at a length and an angle [rad] from the way from base to tip."""
    way = (tip - base) / jnp.sqrt((tip - base) @ (tip - base))
    cos, sin = along(angle)
    return base + length * jnp.stack([cos * way[0] - sin * way[1], sin * way[0] + cos * way[1]])


@jax.jit
def _four_bar(parameters: Parameters, angle: Number) -> dict[str, Point]:
    """Places of the pins A0, A, B, B0 and of the coupler's corner C, at an angle of the crank [rad]."""
    found: dict[str, Point] = {"A0": jnp.zeros(2), "B0": jnp.stack([jnp.asarray(parameters["ground"]), 0.0])}
    found["A"] = parameters["crank"] * along(angle)
    found["B"] = meet(found["A"], parameters["coupler"], found["B0"], parameters["rocker"])
    found["C"] = _corner(found["A"], found["B"], parameters["coupler_side"], parameters["coupler_angle"])
    return found


@jax.jit
def _watt(parameters: Parameters, angle: Number) -> dict[str, Point]:
    found = _four_bar(parameters, angle)
    found["D"] = _corner(found["B0"], found["B"], parameters["rocker_side"], parameters["rocker_angle"])
    return found | {"E": meet(found["C"], parameters["upper"], found["D"], parameters["lower"])}


@jax.jit
def _stephenson(parameters: Parameters, angle: Number) -> dict[str, Point]:
    found = _four_bar(parameters, angle)
    found["D"] = jnp.stack([jnp.asarray(parameters["x"]), jnp.asarray(parameters["y"])])
    return found | {"E": meet(found["C"], parameters["upper"], found["D"], parameters["lower"])}


def _scene(name: str, places: jax.stages.Wrapped, is_watt: bool) -> Scene:
    def mechanism(parameters: Parameters) -> lx.Mechanism:
        numbers = {key: entry for key, entry in parameters.items() if key != "motor"}
        at = closed(places(numbers, numbers["angle"]), name)
        density = parameters["density"]

        def link(name: str, *corners: str) -> lx.RigidBody:
            ring, ends = len(corners) > 2, {corner: at[corner] for corner in corners}
            return linked(name, ends, density * settled(outline([*ends.values()], ring)), ring=ring)

        crank, coupler = link("crank", "A0", "A"), link("coupler", "A", "B", "C")
        rocker = link("rocker", "B0", "B", "D") if is_watt else link("rocker", "B0", "B")
        upper, lower = link("upper", "C", "E"), link("lower", "D", "E")
        joints = [
            pin("A0", on_ground(at["A0"]), crank.at("A0")),
            pin("A", crank.at("A"), coupler.at("A")),
            pin("B", coupler.at("B"), rocker.at("B")),
            pin("B0", on_ground(at["B0"]), rocker.at("B0")),
            pin("C", coupler.at("C"), upper.at("C")),
            pin("D", rocker.at("D") if is_watt else on_ground(at["D"]), lower.at("D")),
            pin("E", upper.at("E"), lower.at("E")),
        ]
        drives = [lx.Drive("motor", "A0", speed=parameters["speed"])] if parameters["motor"] == 1 else []
        gravity = lx.Gravity([0.0, -parameters["gravity"], 0.0])
        return lx.Mechanism([crank, coupler, rocker, upper, lower], joints, [gravity], drives)

    def initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
        return lx.assemble(mechanism, speeds=None if parameters["motor"] == 1 else {"A0": parameters["speed"]})

    def exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
        if parameters["motor"] != 1:
            return None
        numbers = {key: entry for key, entry in parameters.items() if key != "motor"}
        turns = numbers["angle"] + numbers["speed"] * jnp.asarray(times)
        found = jax.vmap(lambda turn: places(numbers, turn))(turns)
        return {point: np.pad(np.asarray(found[point]), ((0, 0), (0, 1))) for point in ("C", "E")}

    return described(
        name,
        mechanism=mechanism,
        initial=initial,
        points=lambda parameters: {"C": ("coupler", "C"), "E": ("upper", "E")},
        exact=exact,
    )


WATT_SIX_BAR = _scene("watt-six-bar", _watt, is_watt=True)
STEPHENSON_SIX_BAR = _scene("stephenson-six-bar", _stephenson, is_watt=False)
