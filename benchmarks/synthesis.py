"""Linkages for published problems: their errors beside the best published ones, with starts and times."""

import json
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.machine import machine

FOUR_BAR = {"crank": "OA", "coupler": "ABP", "rocker": "CB"}, "OC"
WATT = {"crank": "OA", "coupler": "AB", "rocker": "CBD", "link": "DEP", "arm": "FE"}, "OCF"
STEPHENSON = {"crank": "OA", "coupler": "ABD", "rocker": "CB", "link": "DEP", "arm": "FE"}, "OCF"
JANSEN = {"m": "OA", "j": "AB", "k": "AC", "bde": "GBD", "c": "GC", "f": "DE", "ghi": "CEP"}, "OG"

# Kunjur, Krishnamurty, Genetic algorithms in mechanism synthesis, J. of Applied Mechanisms and Robotics 4(2), 1997.
OVAL = np.array(
    [
        (0.5, 1.1), (0.4, 1.1), (0.3, 1.1), (0.2, 1.0), (0.1, 0.9), (0.05, 0.75), (0.02, 0.6), (0.0, 0.5), (0.0, 0.4),
        (0.03, 0.3), (0.1, 0.25), (0.15, 0.2), (0.2, 0.3), (0.3, 0.4), (0.4, 0.5), (0.5, 0.7), (0.6, 0.9), (0.6, 1.0),
    ]
)  # fmt: skip
# Cabrera, Simon, Prado, Optimal synthesis of mechanisms with genetic algorithms, Mechanism and Machine Theory 37, 2002.
LINE = np.array([(20.0, y) for y in (20.0, 25.0, 30.0, 35.0, 40.0, 45.0)])
ARC = np.array([(3.0, 3.0), (2.759, 3.363), (2.372, 3.663), (1.890, 3.862), (1.355, 3.943)])
STEP = np.radians(20.0)
STARTS, KEPT = 4000, 60


def traced(topology, pins, angles) -> lx.Trace:
    """A linkage followed along its crank, from as it is drawn."""
    bars, fixed = topology
    mechanism = lx.linkage(pins, bars, fixed)
    return lx.trace(mechanism, lx.State.as_drawn(mechanism), {"O": angles}, throw=False)


def lengths(pins, *pairs) -> jnp.ndarray:
    """Distances of pairs of pins."""
    return jnp.stack([jnp.sqrt(jnp.sum((pins[one] - pins[other]) ** 2)) for one, other in pairs])


def on_path(topology, body, points, angles, conditions=None) -> Callable:
    """Pins -> a candidate whose pin P is to pass through points at angles of its crank, of a full turn."""
    turn = np.append(angles, np.linspace(angles[-1], 2.0 * np.pi, 13)[1:])

    def candidate(pins):
        found = traced(topology, pins, turn)
        error = found.position(body, "P")[: len(points), :2] - points
        return lx.Candidate(error, {} if conditions is None else conditions(pins, found), found)

    return candidate


def untimed(params) -> lx.Candidate:
    """A four-bar whose point passes through the points of a line, in their order, at angles that are free."""
    angles = jnp.concatenate([jnp.zeros(1), jnp.cumsum(params["steps"])])
    rest = angles[-1] + (2.0 * np.pi - angles[-1]) * np.linspace(0.0, 1.0, 7)[1:]
    pins = params["pins"]
    found = traced(FOUR_BAR, pins, jnp.concatenate([angles, rest]))
    bars = lengths(pins, "OA", "AB", "BC", "OC")
    conditions = {"order": 2.0 * np.pi - angles[-1], "bars of 5 to 60": jnp.stack([bars - 5.0, 60.0 - bars]) / 60.0}
    return lx.Candidate(found.position("coupler", "P")[: len(LINE), :2] - LINE, conditions, found)


def at_least(angle: float) -> Callable:
    """The condition of a transmission angle [rad]."""
    return lambda pins, found: {"transmission angle": found.transmission_angle("B", "C") - angle}


def jansen_pins() -> dict[str, np.ndarray]:
    """Pins of Jansen's leg with his lengths, as drawn."""
    from benchmarks.linkages import jansen

    drawn = jansen().pins
    at = lambda key: drawn[key][:2]
    pins = {"O": np.zeros(2), "G": np.array([-0.38, -0.078]), "A": at("m.A"), "B": at("bde.B"), "C": at("ghi.C")}
    return pins | {"D": at("bde.D"), "E": at("ghi.E"), "P": at("ghi.F")}


def box(pins: str, low: float, high: float) -> dict[str, lx.Bounded]:
    return {pin: lx.Bounded(np.full(2, 0.5 * (low + high)), low, high) for pin in pins}


INPUT = np.linspace(0.0, np.radians(120.0), 13)
ASKED = np.radians(60.0) * np.sin(0.75 * INPUT) ** 2  # what the output of the spatial linkage is to do


def spatial(params) -> lx.Candidate:
    """An RSSR linkage between axes at a right angle, whose output is to turn as a given function of its input."""
    first, second = params["angles"]
    pivot = params["pivot"]
    near = params["crank"] * jnp.stack([jnp.cos(first), jnp.sin(first), jnp.zeros(())])
    far = pivot + params["rocker"] * jnp.stack([jnp.zeros(()), jnp.cos(second), jnp.sin(second)])
    crank, rocker = lx.rod_between("crank", np.zeros(3), near, 1.0), lx.rod_between("rocker", pivot, far, 1.0)
    coupler = lx.rod_between("coupler", near, far, 1.0)
    joints = [
        lx.Revolute("input", lx.GROUND, crank, axis="z"),
        lx.Revolute("output", lx.GROUND.at(pivot), rocker, axis="x"),
        lx.Spherical("near", crank.at("tip"), coupler),
        lx.Spherical("far", coupler.at("tip"), rocker.at("tip")),
    ]
    mechanism = lx.Mechanism([crank, rocker, coupler], joints)
    found = lx.trace(mechanism, lx.State.as_drawn(mechanism), {"input": INPUT}, throw=False)
    return lx.Candidate(found.joint("output") - ASKED, {}, found)


class Problem(NamedTuple):
    """What is asked, what of, and the best error that is published for a four-bar, None where none is."""

    function: Callable
    params: dict
    published: float | None = None


def problems() -> dict[str, Problem]:
    """All of them by name."""
    turned = STEP * np.arange(len(OVAL))
    six = lambda topology, body: Problem(on_path(topology, body, OVAL, turned), box("OABCDEFP", -2.0, 3.0), 0.0349)
    own = jansen_pins()
    leg = lambda pins: traced(JANSEN, pins, np.linspace(0.0, 2.0 * np.pi, 37)).position("ghi", "P")[:, :2]
    around = np.asarray(leg(own))[:-1]
    whole = on_path(JANSEN, "ghi", around, STEP / 2.0 * np.arange(36))
    shifted = lambda shifts: whole({pin: place + shifts[pin] for pin, place in own.items()})
    line = {"pins": box("OABCP", -60.0, 60.0), "steps": lx.Bounded(np.full(5, 0.5), 0.05, 1.5)}
    return {
        "Kunjur-Krishnamurty": Problem(on_path(FOUR_BAR, "coupler", OVAL, turned), box("OABCP", -2.0, 3.0), 0.0349),
        "the same, 30 degrees": Problem(
            on_path(FOUR_BAR, "coupler", OVAL, turned, at_least(np.radians(30.0))), box("OABCP", -2.0, 3.0)
        ),
        "Cabrera, line": Problem(untimed, line, 2.62e-2),
        "Cabrera, arc": Problem(
            on_path(FOUR_BAR, "coupler", ARC, np.pi * np.array([2.0, 3.0, 4.0, 5.0, 6.0]) / 12.0 - np.pi / 6.0),
            box("OABCP", -5.0, 5.0),
        ),
        "Watt": six(WATT, "link"),
        "Stephenson": six(STEPHENSON, "link"),
        "Jansen": Problem(shifted, box("OGABCDEP", -0.08, 0.12), 0.0),
        "RSSR": Problem(spatial, {
            "angles": lx.Bounded([0.5, 1.0], -3.1, 3.1), "pivot": lx.Bounded([1.0, 0.5, 0.1], -2.0, 2.0),
            "crank": lx.Bounded(0.5, 0.1, 1.5), "rocker": lx.Bounded(0.8, 0.1, 1.5),
        }),
    }  # fmt: skip


def solved(name: str, starts: int, kept: int) -> dict:
    """One problem, with its times."""
    problem = problems()[name]
    began = time.perf_counter()
    found = lx.synthesis(problem.function, problem.params, starts=starts, kept=kept)
    return {
        "problem": name,
        "error": float(found.errors[0]),
        "published": problem.published,
        "conditions": {key: float(value[0]) for key, value in found.conditions.items()},
        "met": bool(found.met[0]),
        "starts": starts,
        "possible": found.possible,
        "searches": kept,
        "linkages": int(np.sum(found.met)),
        "time [s]": time.perf_counter() - began,
    }


def main(names: list[str]) -> None:
    """Print each problem that is named, or all."""
    for name in names or problems():
        print(json.dumps({**solved(name, STARTS, KEPT), **machine()}, indent=2), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
