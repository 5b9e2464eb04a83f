"""Planar robot of five bars, which two motors move, with the lengths of the DexTAR.

Its links are 90 mm long, its motors 118 mm apart: Campos, Bourbonnais, Bonev and Bigras, Development of a Five-Bar
Parallel Robot With Large Workspace, ASME IDETC 2010, and the product that followed, quoted from memory. Masses are our
own.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.planar import Point, closed, linked, meet, on_ground, pin, turn_between
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array, Scalar

SIDES = {"left": 1.0, "right": -1.0}  # of an elbow, seen from its motor to the tip


class Reach(eqx.Module):
    """Where tip and elbows are, as the tip runs along a circle."""

    numbers: dict[str, Scalar]

    def motor(self, side: str) -> Point:
        """Compute the place of a motor [m]."""
        return jnp.stack([-SIDES[side] * self.numbers["base"] / 2.0, 0.0])

    def tip(self, t: Number) -> Point:
        """Compute the place of the tip [m], lowest at t = 0."""
        turn = 2.0 * jnp.pi * t / self.numbers["period"]
        center = jnp.stack([self.numbers["x"], self.numbers["y"]])
        return center + self.numbers["radius"] * jnp.stack([jnp.sin(turn), -jnp.cos(turn)])

    def elbow(self, side: str, t: Number) -> Point:
        """Compute the place of an elbow [m], which points outward."""
        return meet(self.motor(side), self.numbers["arm"], self.tip(t), self.numbers["forearm"], SIDES[side])


class Turn(eqx.Module):
    """The angle of a motor from its place at t = 0 [rad]."""

    reach: Reach
    side: str = eqx.field(static=True)

    def __call__(self, t: Number) -> Scalar:
        arm = lambda t: self.reach.elbow(self.side, t) - self.reach.motor(self.side)
        return turn_between(arm(0.0), arm(t))


NUMBERS = ("base", "arm", "forearm", "x", "y", "radius", "period")


def _reach(parameters: Parameters) -> Reach:
    return Reach({name: jnp.asarray(parameters[name]) for name in NUMBERS})


@jax.jit
def _drawn(reach: Reach) -> dict[str, Point]:
    motors = {f"{side}_motor": reach.motor(side) for side in SIDES}
    return motors | {f"{side}_elbow": reach.elbow(side, 0.0) for side in SIDES} | {"tip": reach.tip(0.0)}


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    reach = _reach(parameters)
    at = closed(_drawn(reach), "five-bar")
    bodies, joints = [], []
    for side in SIDES:
        motor, elbow = at[f"{side}_motor"], at[f"{side}_elbow"]
        arm = linked(f"{side}_arm", {"base": motor, "tip": elbow}, parameters["arm_mass"])
        forearm = linked(f"{side}_forearm", {"base": elbow, "tip": at["tip"]}, parameters["forearm_mass"])
        joints += [
            pin(f"{side}_motor", on_ground(motor), arm.at("base")),
            pin(f"{side}_elbow", arm.at("tip"), forearm.at("base")),
        ]
        bodies += [arm, forearm]
    joints.append(pin("tip", bodies[1].at("tip"), bodies[3].at("tip")))
    driven = parameters["motors"] == 1
    drives = [lx.Drive(f"{side}_drive", f"{side}_motor", Turn(reach, side)) for side in SIDES] if driven else []
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, -parameters["gravity"], 0.0])], drives)


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    return lx.assemble(mechanism)


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
    if parameters["motors"] != 1:
        return None
    return {"tip": _in_space(jax.vmap(_reach(parameters).tip)(jnp.asarray(times)))}


def _in_space(places: Float[Array, "n 2"]) -> np.ndarray:
    return np.pad(np.asarray(places), ((0, 0), (0, 1)))


FIVE_BAR = described(
    "five-bar",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"tip": ("left_forearm", "tip")},
    exact=_exact,
)
