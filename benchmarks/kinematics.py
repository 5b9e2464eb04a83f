"""Four-bars traced along their cranks by thousands: time of a position, and distance from the closed form."""

import json
import time

import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.machine import machine

LINKAGES, ANGLES, CHUNK = 10_000, 1000, 250
LENGTHS = np.array([0.4, 1.0, 0.8, 1.0])  # crank, coupler, rocker, ground [m]
SPREAD = 0.1  # of the lengths, which leaves all of them crank-rockers
TURN = np.linspace(0.0, 2.0 * np.pi, ANGLES)


def four_bar(lengths, constraints=()) -> lx.Mechanism:
    """Build one with the crank on the origin, and the rocker on the x axis."""
    a, b, c, d = lengths
    crank, coupler, rocker = lx.rod("crank", a, 1.0), lx.rod("coupler", b, 1.0), lx.rod("rocker", c, 1.0)
    joints = [
        lx.Revolute("A", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("B", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("C", coupler.at("tip"), rocker.at("tip"), axis="z"),
        lx.Revolute("D", lx.GROUND.at(jnp.stack([d, 0.0 * d, 0.0 * d])), rocker.at("base"), axis="z"),
    ]
    return lx.Mechanism([crank, coupler, rocker], joints, constraints=constraints)


def trace(lengths) -> dict:
    """Follow the crank through a turn."""
    mechanism = four_bar(lengths)
    start = lx.assemble(mechanism, {"A": 0.0}, guess={"D": 1.5})
    found = lx.trace(mechanism, start, {"A": TURN})
    return {"rocker": found.joint("D"), "result": found.result}


def rocker_angle(lengths, crank):
    """The rocker's angle on the branch that has it above, by the law of cosines [rad]."""
    a, b, c, d = lengths
    x, y = a * jnp.cos(crank) - d, a * jnp.sin(crank)
    square = x**2 + y**2
    inner = jnp.arccos((c**2 + square - b**2) / (2.0 * c * jnp.sqrt(square)))
    return jnp.mod(jnp.arctan2(y, x), 2.0 * jnp.pi) - inner


def main() -> None:
    """Print seconds of compilation, microseconds of a position on all cores, and the largest error [rad]."""
    lengths = LENGTHS * (1.0 + SPREAD * np.random.default_rng(0).uniform(-1.0, 1.0, (LINKAGES, 4)))
    began = time.perf_counter()
    found = lx.sweep(trace, jnp.asarray(lengths), chunk=CHUNK)
    whole = time.perf_counter() - began
    error = np.max(np.abs(found.output["rocker"] - rocker_angle(lengths.T[:, :, None], TURN)))
    print(
        json.dumps(
            {
                "linkages": LINKAGES,
                "angles": ANGLES,
                "ended": found.count(),
                "first result [s]": whole - LINKAGES * found.seconds_per_member,
                "time of a position [us]": 1e6 * found.seconds_per_member / ANGLES,
                "largest error [rad]": float(error),
                **machine(),
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
