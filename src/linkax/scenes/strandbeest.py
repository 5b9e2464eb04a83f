"""Legs of Theo Jansen's beach animals on one crankshaft, in the air: eleven bars and three loops each.

Lengths are Jansen's "holy numbers", in centimetres there. Legs come in pairs on one crank pin, one to each side; pairs
stand side by side, with cranks spread over a turn.
"""

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.planar import Point, along, closed, linked, meet, on_ground, outline, pin, settled
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array

LENGTHS = "abcdefghijklm"
SIDES = (1.0, -1.0)  # of the legs of a pair: left, right
# Bodies of a leg and their pins; those of three are triangles of bars. A is the crank pin, P the leg's pivot.
BODIES = {"j": "AT", "k": "AH", "c": "PH", "hip": "PTK", "f": "KQ", "foot": "HQF"}
JOINTS = {"T": ("j", "hip"), "H": ("k", "c"), "ankle": ("c", "foot"), "K": ("hip", "f"), "Q": ("f", "foot")}
PINS = {"ankle": "H"}  # of joints that are not named like their pin


def _sides(parameters: Parameters) -> dict[str, Number]:
    return {name: parameters[name] for name in LENGTHS}


def _pairs(parameters: Parameters) -> int:
    return (parameters["legs"] + 1) // 2


def _left(sides: dict[str, Number], crank: Point) -> dict[str, Point]:
    """Places of the pins of a leg to the left of the crankshaft, which is at the origin [m]."""
    at = {"A": crank, "P": jnp.stack([-jnp.asarray(sides["a"]), -jnp.asarray(sides["l"])])}
    at["T"] = meet(at["P"], sides["b"], at["A"], sides["j"])
    at["H"] = meet(at["P"], sides["c"], at["A"], sides["k"], -1.0)
    at["K"] = meet(at["P"], sides["d"], at["T"], sides["e"])
    at["Q"] = meet(at["K"], sides["f"], at["H"], sides["g"], -1.0)
    at["F"] = meet(at["H"], sides["i"], at["Q"], sides["h"])
    return at


@jax.jit
def _leg(sides: dict[str, Number], angle: Number, side: Number) -> dict[str, Point]:
    """Places of the pins of a leg to the left, or to the right for side −1, at an angle of its crank [rad]."""
    mirror = jnp.stack([jnp.asarray(side), 1.0])
    return {name: mirror * place for name, place in _left(sides, mirror * sides["m"] * along(angle)).items()}


def _angle(parameters: Parameters, leg: int) -> Number:
    """Angle of a leg's crank at the start [rad]."""
    return parameters["angle"] + 2.0 * np.pi * (leg // 2) / _pairs(parameters)


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    sides, density, spacing = _sides(parameters), parameters["density"], parameters["spacing"]
    pins = {f"pin_{pair + 1}": _angle(parameters, 2 * pair) for pair in range(_pairs(parameters))}
    throws = {name: settled(sides["m"] * along(angle)) for name, angle in pins.items()}
    center = settled(jnp.mean(jnp.stack([*throws.values()]), axis=0) / 2.0)
    mass = density * sides["m"] * len(pins)
    shaft = lx.RigidBody(
        "crankshaft",
        mass,
        [center[0], center[1], spacing * (len(pins) - 1) / 2.0],
        mass * (sides["m"] ** 2 / 3.0 - center @ center),
        {name: [throw[0], throw[1], spacing * pair] for pair, (name, throw) in enumerate(throws.items())},
    )
    bodies, joints = [shaft], [pin("crank", lx.GROUND, shaft)]
    for leg in range(parameters["legs"]):
        at = closed(_leg(sides, _angle(parameters, leg), SIDES[leg % 2]), "strandbeest")
        height, suffix = spacing * (leg // 2), f"_{leg + 1}"
        parts = {}
        for name, corners in BODIES.items():
            ends, ring = {corner: at[corner] for corner in corners}, len(corners) > 2
            mass = density * settled(outline([*ends.values()], ring))
            parts[name] = linked(name + suffix, ends, mass, ring=ring, height=height)
        bodies += parts.values()
        crank_pin, pivot = shaft.at(f"pin_{leg // 2 + 1}"), on_ground(at["P"], height)
        joints += [pin(f"A_{name}{suffix}", crank_pin, parts[name].at("A")) for name in "jk"]
        joints += [pin(f"P_{name}{suffix}", pivot, parts[name].at("P")) for name in ("hip", "c")]
        for name, (first, second) in JOINTS.items():
            place = PINS.get(name, name)
            joints.append(pin(name + suffix, parts[first].at(place), parts[second].at(place)))
    motor = lx.Drive("motor", "crank", speed=parameters["speed"])
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, -parameters["gravity"], 0.0])], [motor])


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    return lx.assemble(mechanism)


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray]:
    turns, found = parameters["speed"] * jnp.asarray(times), {}
    for leg in range(parameters["legs"]):
        foot = lambda turn, leg=leg: _leg(_sides(parameters), _angle(parameters, leg) + turn, SIDES[leg % 2])["F"]
        height = np.full(len(turns), parameters["spacing"] * (leg // 2))
        found[f"foot_{leg + 1}"] = np.column_stack([jax.vmap(foot)(turns), height])
    return found


STRANDBEEST = described(
    "strandbeest",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {f"foot_{leg}": (f"foot_{leg}", "F") for leg in range(1, parameters["legs"] + 1)},
    exact=_exact,
)
