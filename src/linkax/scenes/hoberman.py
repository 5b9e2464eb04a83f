"""Hoberman's rings: a ring of angulated scissors that opens and closes radially, or several, one around the other.

A ring has pairs of equal struts, bent and hinged in the middle. Both halves of a strut, of length l, see the centre
under an angle of 2β = 2π / pairs: its ends stay on two radial lines as it turns by ψ, at radii l sin(ψ ∓ β) / sin β,
with its middle at l sin ψ / sin β. The next ring around it has the same struts, at ψ + 2β. With n pairs and R rings
that makes 2nR struts with one degree of freedom, where a count has far less. Hoberman, US patent 4942700 (1990); You
and Pellegrino, Foldable Bar Structures, Int. J. Solids Structures 34 (1997).

Blocks that carry the middles of the innermost ring slide on radial rails.
"""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import linkax as lx
from linkax.model.numbers import Number, number, require
from linkax.scenes.course import Course
from linkax.scenes.planar import Point, along, linked, on_ground, pin, settled
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array

STRUTS = ("left", "right")  # to which side their outer ends are, seen from the centre


def radius(parameters: Parameters, level: Number, angle: Number) -> Array:
    """Compute the radius of pins [m]: of the middles of ring i at level i − 1/2, of its ends at i − 1 and i.

    **Arguments:** `parameters`: `pairs` and `length`, among others; `angle`: ψ of the innermost ring [rad].
    """
    half = jnp.pi / parameters["pairs"]
    return parameters["length"] * jnp.sin(angle + (2.0 * level - 1.0) * half) / jnp.sin(half)


def _bearing(parameters: Parameters, line: Number) -> Point:
    """Unit vector of a radial line: that of the middles of pair i is i − 1, that of ends left of them i − 1/2."""
    return along(2.0 * jnp.pi * line / parameters["pairs"])


@jax.jit
def _places(numbers: Parameters, lines: Float[Array, " n"], levels: Float[Array, " m"]) -> Float[Array, "n m 2"]:
    radii = jax.vmap(lambda level: radius(numbers, level, numbers["angle"]))(levels)
    return jax.vmap(lambda line: radii[:, None] * _bearing(numbers, line))(lines)


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    pairs, rings = parameters["pairs"], parameters["rings"]
    if pairs < 3:
        raise ValueError(f"scene 'hoberman': pairs is {pairs}; a ring has three or more")
    first = number(parameters["angle"], (), "scene 'hoberman': angle [rad]")
    most = np.pi - (2 * rings - 1) * np.pi / pairs
    inside = lambda angle: (angle > np.pi / pairs) & (angle < most)
    remedy = f"pins keep off the centre between {np.pi / pairs:.4g} and {most:.4g}; more pairs allow more rings"
    require(first, inside, "scene 'hoberman': angle [rad]", remedy)
    numbers = {name: parameters[name] for name in ("pairs", "length", "angle")}
    # Half lines and half levels, so that pins are at whole ones.
    at = settled(_places(numbers, jnp.arange(-0.5, pairs - 0.5, 0.5), jnp.arange(0.0, rings + 0.5, 0.5)))
    place = lambda line, level: at[line % (2 * pairs), level]
    struts, joints, blocks = {}, [], []
    for pair in range(pairs):
        middle = 2 * pair + 1
        for ring in range(rings):
            for side, step in zip(STRUTS, (1, -1), strict=True):
                ends = {
                    "inner": place(middle - step, 2 * ring),
                    "middle": place(middle, 2 * ring + 1),
                    "outer": place(middle + step, 2 * ring + 2),
                }
                struts[side, ring, pair] = linked(f"{side}_{ring + 1}_{pair + 1}", ends, parameters["mass"])
            left, right = (struts[side, ring, pair].at("middle") for side in STRUTS)
            joints.append(pin(f"middle_{ring + 1}_{pair + 1}", right, left))
        block = lx.point_mass(f"block_{pair + 1}", parameters["block_mass"])
        cos, sin = np.cos(2.0 * np.pi * pair / pairs), np.sin(2.0 * np.pi * pair / pairs)
        rail = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        start = on_ground(place(middle, 1))
        blocks.append(block)
        joints += [
            lx.Prismatic(f"rail_{pair + 1}", lx.GROUND.at(start.offset, rail), block.at([0.0, 0.0, 0.0], rail), "x"),
            pin(f"block_{pair + 1}", block, struts["left", 0, pair].at("middle")),
        ]
    for pair in range(pairs):
        for level in range(rings + 1):
            joints += _shared(struts, rings, pairs, pair, level)
    drives = []
    if parameters["motor"] == 1:
        course = Course(*map(jnp.asarray, (0.0, 2.0 * parameters["angle_change"], parameters["duration"])))
        drives = [lx.Drive("motor", "middle_1_1", course)]
    return lx.Mechanism([*struts.values(), *blocks], joints, constraints=drives)


def _shared(
    struts: dict[tuple[str, int, int], lx.RigidBody], rings: int, pairs: int, pair: int, level: int
) -> list[lx.Revolute]:
    """Hinges of a pin to the left of a pair: ends of two struts of one ring, or of two rings."""
    follower = (pair + 1) % pairs
    ends = []
    if level > 0:
        ends += [struts["left", level - 1, pair].at("outer"), struts["right", level - 1, follower].at("outer")]
    if level < rings:
        ends += [struts["right", level, pair].at("inner"), struts["left", level, follower].at("inner")]
    names = [f"pin_{level}_{pair + 1}{letter}" for letter in "abc"]
    return [pin(name, *both) for name, both in zip(names, pairwise(ends), strict=False)]


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    speeds = None if parameters["motor"] == 1 else {"middle_1_1": 2.0 * parameters["speed"]}
    return lx.assemble(mechanism, speeds=speeds)


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray] | None:
    if parameters["motor"] != 1:
        return None
    course = Course(*map(jnp.asarray, (0.0, parameters["angle_change"], parameters["duration"])))
    angle = parameters["angle"] + jax.vmap(course)(jnp.asarray(times))
    found = {}
    for name, level in _levels(parameters).items():
        radii = radius(parameters, level, angle)
        found[name] = np.pad(radii[:, None] * _bearing(parameters, 0.5), ((0, 0), (0, 1)))
    return found


def _levels(parameters: Parameters) -> dict[str, int]:
    return {"inner": 0, "outer": parameters["rings"]}


HOBERMAN = described(
    "hoberman",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"inner": ("right_1_1", "inner"), "outer": (f"left_{parameters['rings']}_1", "outer")},
    exact=_exact,
)
