"""Linkages drawn in the world, to be assembled from rough places of their pins."""

import copy
import math
from typing import NamedTuple

import numpy as np

import linkax as lx
from linkax.scenes import SCENES


class Linkage(NamedTuple):
    """A mechanism as drawn, with what is held of it, and where its moving pins are.

    - `held`: coordinates of its drives as drawn. `pins`: {"body.frame": [x, y, z]} as drawn [m].
    - `flat`: whether it moves in the x-y plane.
    """

    mechanism: lx.Mechanism
    held: dict
    pins: dict[str, np.ndarray]
    flat: bool

    @property
    def size(self) -> float:
        """The largest extent along an axis of the pins, those on the ground too [m]."""
        ends = [
            end.offset for joint in self.mechanism.joints for end in (joint.parent, joint.child) if end.body == "ground"
        ]
        return float(np.max(np.ptp(np.stack([*self.pins.values(), *ends]), axis=0)))


def _planar(points: dict, bars: dict, pins: list, drive: str) -> Linkage:
    """Bars, {name: its points}, the first two of them the ends of a rod, hinged to each other and to ground.

    **Arguments:** `pins`: (point, body or None for the ground, body); `drive`: the joint that is held.
    """
    at = {name: np.array([*place, 0.0]) for name, place in points.items()}
    bodies = {}
    for name, corners in bars.items():
        rod = lx.rod_between(name, at[corners[0]], at[corners[1]], mass=1.0)
        frames = {corner: at[corner] - at[corners[0]] for corner in corners}
        bodies[name] = lx.RigidBody(name, 1.0, rod.center_of_mass, rod.inertia, frames).placed(at[corners[0]])
    joints = [
        lx.Revolute(
            f"{point}_{child}",
            lx.GROUND.at(at[point]) if parent is None else bodies[parent].at(point),
            bodies[child].at(point),
            axis="z",
        )
        for point, parent, child in pins
    ]
    mechanism = lx.Mechanism([*bodies.values()], joints)
    grounded = {point for point, parent, _ in pins if parent is None}
    moving = {f"{name}.{corner}": at[corner] for name, corners in bars.items() for corner in corners}
    moving = {key: place for key, place in moving.items() if key.partition(".")[2] not in grounded}
    held = {drive: 0.0}
    return Linkage(mechanism, held, moving, True)


def _meet(first, one, second, other, side):
    """Where circles about two points meet, to the left of the way from the first to the second, or to the right."""
    first, second = np.array(first), np.array(second)
    way = second - first
    distance = np.linalg.norm(way)
    along = (distance**2 + one**2 - other**2) / (2.0 * distance)
    way, across = way / distance, side * np.array([-way[1], way[0]]) / distance
    return first + along * way + math.sqrt(one**2 - along**2) * across


def four_bar() -> Linkage:
    """A crank-rocker."""
    crank = 0.4 * np.array([math.cos(1.0), math.sin(1.0)])
    points = {"O": (0.0, 0.0), "A": crank, "B": _meet(crank, 1.0, (1.0, 0.0), 0.8, 1.0), "C": (1.0, 0.0)}
    bars = {"crank": "OA", "coupler": "AB", "rocker": "CB"}
    pins = [("O", None, "crank"), ("A", "crank", "coupler"), ("B", "coupler", "rocker"), ("C", None, "rocker")]
    return _planar(points, bars, pins, "O_crank")


def jansen() -> Linkage:
    """A leg of Jansen's walking machine with his lengths [cm → m], seven bodies, two of them triangles."""
    crank = 0.15 * np.array([math.cos(0.6), math.sin(0.6)])
    points = {"O": (0.0, 0.0), "A": crank, "G": (-0.38, -0.078)}
    points["B"] = _meet(crank, 0.5, points["G"], 0.415, -1.0)
    points["C"] = _meet(crank, 0.619, points["G"], 0.393, 1.0)
    points["D"] = _meet(points["B"], 0.558, points["G"], 0.401, -1.0)
    points["E"] = _meet(points["D"], 0.394, points["C"], 0.367, -1.0)
    points["F"] = _meet(points["E"], 0.657, points["C"], 0.49, -1.0)
    bars = {"m": "OA", "j": "AB", "k": "AC", "bde": "GBD", "c": "GC", "f": "DE", "ghi": "CEF"}
    pins = [
        ("O", None, "m"), ("A", "m", "j"), ("A", "m", "k"), ("B", "j", "bde"), ("G", None, "bde"), ("C", "k", "c"),
        ("G", None, "c"), ("D", "bde", "f"), ("C", "k", "ghi"), ("E", "f", "ghi"),
    ]  # fmt: skip
    return _planar(points, bars, pins, "O_m")


def peaucellier() -> Linkage:
    """Peaucellier's cell: two arms, a rhombus and a crank; one of its pins moves on a straight line."""
    center, length = 0.5, 0.8
    begin = np.array([center + center * math.cos(0.3), center * math.sin(0.3)])
    out = begin / np.linalg.norm(begin)
    middle = np.linalg.norm(begin) + 0.6
    half, across = math.sqrt(length**2 - 0.6**2), np.array([-out[1], out[0]])
    points = {"O": (0.0, 0.0), "Q": (center, 0.0), "P": begin, "R": (middle + 0.6) * out}
    points |= {"U": middle * out + half * across, "V": middle * out - half * across}
    bars = {"crank": "QP", "left": "OU", "right": "OV", "PU": "PU", "PV": "PV", "RU": "RU", "RV": "RV"}
    pins = [
        ("Q", None, "crank"), ("O", None, "left"), ("O", None, "right"), ("P", "crank", "PU"), ("P", "crank", "PV"),
        ("U", "left", "PU"), ("V", "right", "PV"), ("U", "left", "RU"), ("V", "right", "RV"), ("R", "RU", "RV"),
    ]  # fmt: skip
    return _planar(points, bars, pins, "Q_crank")


def stewart() -> Linkage:
    """Stewart's platform: six struts of two tubes, with a cardan joint on the ground and a ball on the platform."""
    angle = lambda index, spread: 2.0 * math.pi / 3.0 * (index // 2) + (-1.0) ** index * spread
    ring = lambda radius, spread, first, z: [
        np.array([radius * math.cos(first + angle(i, spread)), radius * math.sin(first + angle(i, spread)), z])
        for i in range(6)
    ]
    feet, heads = ring(1.0, 0.25, 0.0, 0.0), ring(0.6, 0.8, 0.0, 1.2)
    top = np.array([0.0, 0.0, 1.2])
    frames = {f"head_{i}": head - top for i, head in enumerate(heads)}
    platform = lx.RigidBody("platform", 10.0, inertia=[1.0, 1.0, 2.0], frames=frames).placed(top)
    bodies, joints, pins = [platform], [], {f"platform.head_{i}": head for i, head in enumerate(heads)}
    for i, (foot, head) in enumerate(zip(feet, heads, strict=True)):
        way = head - foot
        along = way / np.linalg.norm(way)
        second = np.cross([0.0, 0.0, 1.0], along)
        second /= np.linalg.norm(second)
        lower = lx.rod_between(f"lower_{i}", foot, foot + 0.5 * way, mass=1.0, thickness=0.06)
        upper = lx.rod_between(f"upper_{i}", head - 0.5 * way, head, mass=1.0, thickness=0.04)
        bodies += [lower, upper]
        joints += [
            lx.Universal(f"foot_{i}", lx.GROUND.at(foot), lower, axis=np.cross(second, along), second_axis=second),
            lx.Prismatic(f"strut_{i}", lower, upper.at(-0.5 * way), axis=along),
            lx.Spherical(f"ball_{i}", upper.at("tip"), platform.at(f"head_{i}")),
        ]
    mechanism = lx.Mechanism(bodies, joints)
    held = {f"strut_{i}": 0.0 for i in range(6)}
    return Linkage(mechanism, held, pins, False)


def bricard() -> Linkage:
    """The scene of this name, as its library draws it."""
    scene = SCENES["bricard"]
    settings = scene.settings()
    mechanism, at, pins = scene.mechanism(settings), np.zeros(3), {}
    for name in (f"rod_{index}" for index in range(1, 5)):
        at = at + mechanism.body(name).at("tip").offset
        pins[f"{name}.tip"] = at
    return Linkage(mechanism, {"P1": settings["angle"]}, pins, False)


def hidden(linkage: Linkage) -> Linkage:
    """The same linkage with zeros of joints elsewhere, at random, so that only a guess tells what is drawn."""
    generator, joints, held = np.random.default_rng(0), [], {}
    for joint in linkage.mechanism.joints:
        turns = generator.uniform(-np.pi, np.pi, joint.num_coordinates)
        slides = np.array(joint.speed_units) == "m"
        begin = generator.normal(size=4) if joint.has_quaternion else np.where(slides, 0.5 * np.sign(turns), turns)
        axes, _ = joint.frames()
        rotation = axes @ np.asarray(joint.rotation(begin)) @ axes.T
        along = axes @ (np.where(slides, begin, 0.0) @ np.array(joint.linear_subspace)) if any(slides) else np.zeros(3)
        child = lx.Frame(joint.child.body, joint.child.offset + along, lx.GROUND.at(np.zeros(3), rotation).rotation)
        joint = copy.copy(joint)
        object.__setattr__(joint, "child", child)
        joints.append(joint)
        held |= {joint.name: begin[0]} if joint.name in linkage.held else {}
    return linkage._replace(mechanism=lx.Mechanism(linkage.mechanism.bodies, joints), held=held)


LINKAGES = {
    "four-bar": four_bar,
    "Jansen leg": jansen,
    "Stewart platform": stewart,
    "Bricard": bricard,
    "Peaucellier": peaucellier,
}
