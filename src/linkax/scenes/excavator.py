"""Arm of a hydraulic excavator: boom, stick and bucket, three cylinders, and the linkage that turns the bucket.

Numbers are our own, in the size of an excavator of 7 to 8 tonnes, from no data sheet. The bucket cylinder pushes the
pin between a rocker on the stick and a link to the bucket, a four-bar. x points forward, y up, and the origin is the
boom's foot.
"""

import jax
import jax.numpy as jnp

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.course import Course
from linkax.scenes.planar import Point, along, closed, linked, meet, on_ground, pin, settled
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Scalar

FOOT = (0.45, -0.35)  # of the boom cylinder on the frame [m]
HEAD = (1.65, 0.45)  # of the boom cylinder on the boom, from its foot, x along it to the stick [m]
BEND = (1.9, 0.95)  # of the boom, and there the foot of the stick cylinder [m]
TAIL = (-0.45, 0.1)  # of the stick, the head of its cylinder, from the boom, x along it to the bucket [m]
SHOULDER = (0.1, 0.4)  # of the stick, the foot of the bucket cylinder [m]
PIVOT = 0.3  # of the rocker on the stick, from the bucket's pin [m]
ROCKER, LINK = 0.42, 0.4  # [m]
EAR = (-0.1, 0.28)  # of the bucket, where the link pulls, from its pin, x along it to the teeth [m]
HEEL = (0.55, 0.6)  # of the bucket [m]
SHARE = 0.6  # of a cylinder's length at the start that its barrel has, and its piston with its rod
CYLINDERS = {"boom": ("frame", "boom"), "stick": ("boom", "stick"), "bucket": ("stick", "rocker")}
MASSES = {"rocker": 25.0, "link": 30.0, "barrel": 45.0, "piston": 30.0}  # [kg]


@jax.jit
def places(parameters: Parameters, boom: Number, stick: Number, bucket: Number) -> dict[str, Point]:
    """Compute the places of all pins [m] at angles [rad]: of the boom from +x, of the others from the one before."""

    def on(origin: Point, angle: Number, local: tuple[Number, Number]) -> Point:
        forward = along(angle)
        return origin + local[0] * forward + local[1] * jnp.stack([-forward[1], forward[0]])

    foot, stick_angle, bucket_angle = jnp.zeros(2), boom + stick, boom + stick + bucket
    at = {"foot": foot, "elbow": on(foot, boom, (parameters["boom"], 0.0))}
    at["wrist"] = on(at["elbow"], stick_angle, (parameters["stick"], 0.0))
    at["teeth"] = on(at["wrist"], bucket_angle, (parameters["bucket"], 0.0))
    at |= {"boom_foot": jnp.asarray(FOOT), "boom_head": on(foot, boom, HEAD)}
    at |= {"stick_foot": on(foot, boom, BEND), "stick_head": on(at["elbow"], stick_angle, TAIL)}
    at |= {"bucket_foot": on(at["elbow"], stick_angle, SHOULDER), "ear": on(at["wrist"], bucket_angle, EAR)}
    at |= {"heel": on(at["wrist"], bucket_angle, HEEL), "pivot": on(at["wrist"], stick_angle, (-PIVOT, 0.0))}
    return at | {"bucket_head": meet(at["pivot"], ROCKER, at["ear"], LINK)}


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    at = _drawn(parameters)

    def part(name: str, mass: Number, *pins: str, ring: bool = False) -> lx.RigidBody:
        return linked(name, {pin: at[pin] for pin in pins}, mass, ring=ring)

    boom = part("boom", parameters["boom_mass"], "foot", "boom_head", "stick_foot", "elbow")
    stick = part("stick", parameters["stick_mass"], "stick_head", "elbow", "wrist", "pivot", "bucket_foot", ring=True)
    bucket = part("bucket", parameters["bucket_mass"], "wrist", "teeth", "heel", "ear", ring=True)
    rocker = part("rocker", MASSES["rocker"], "pivot", "bucket_head")
    link = part("link", MASSES["link"], "bucket_head", "ear")
    bodies = {"boom": boom, "stick": stick, "bucket": bucket, "rocker": rocker, "link": link}
    joints = [
        pin("boom", on_ground(at["foot"]), boom.at("foot")),
        pin("stick", boom.at("elbow"), stick.at("elbow")),
        pin("bucket", stick.at("wrist"), bucket.at("wrist")),
        pin("rocker", stick.at("pivot"), rocker.at("pivot")),
        pin("link", rocker.at("bucket_head"), link.at("bucket_head")),
        pin("ear", link.at("ear"), bucket.at("ear")),
    ]
    drives = []
    for name, (carrier, carried) in CYLINDERS.items():
        length, _ = _cylinder(at, name)
        barrel = lx.rod(f"{name}_barrel", SHARE * length, MASSES["barrel"])
        piston = lx.rod(f"{name}_piston", SHARE * length, MASSES["piston"])
        start = on_ground(at["boom_foot"]) if carrier == "frame" else bodies[carrier].at(f"{name}_foot")
        joints += [
            pin(f"{name}_foot", start, barrel.at("base")),
            lx.Prismatic(f"{name}_cylinder", barrel.at("base"), piston.at("tip"), axis="x"),
            lx.Revolute(f"{name}_head", bodies[carried].at(f"{name}_head"), piston.at("tip"), axis="z", cut=True),
        ]
        course = Course(*map(jnp.asarray, (length, length + parameters[f"{name}_stroke"], parameters["duration"])))
        drives.append(lx.Drive(f"{name}_valve", f"{name}_cylinder", course))
        bodies |= {barrel.name: barrel, piston.name: piston}
    return lx.Mechanism(list(bodies.values()), joints, [lx.Gravity([0.0, -parameters["gravity"], 0.0])], drives)


def _drawn(parameters: Parameters) -> dict[str, Point]:
    sizes = {name: parameters[name] for name in ("boom", "stick", "bucket")}
    at = places(sizes, *(parameters[f"{name}_angle"] for name in sizes))
    return closed(at, "excavator")


def _cylinder(at: dict[str, Point], name: str) -> tuple[Scalar, Scalar]:
    """Length of a cylinder from pin to pin [m], and its angle from +x [rad]."""
    way = at[f"{name}_head"] - at[f"{name}_foot"]
    length, angle = _polar(way)
    return settled(length), settled(angle)


@jax.jit
def _polar(way: Point) -> tuple[Scalar, Scalar]:
    return jnp.hypot(way[0], way[1]), jnp.arctan2(way[1], way[0])


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    guess, at = {}, _drawn(parameters)
    for name in CYLINDERS:
        length, angle = _cylinder(at, name)
        guess |= {f"{name}_foot": angle, f"{name}_cylinder": length}
    return lx.assemble(mechanism, guess=guess)


EXCAVATOR = described(
    "excavator",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"teeth": ("bucket", "teeth")},
)
