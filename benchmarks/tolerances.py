"""Tolerances of a four-bar's lengths, and the path of a coupler point through a turn: three methods, and their times.

Crank 0.4 m, coupler 1.1 m, rocker 0.9 m, ground 1 m, each with a standard deviation of `--deviation` (default 1 mm);
the point is 0.3 m off the middle of the coupler. `--angles N` of the crank (default 36), `--samples N` (default 4096),
`--json`.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx

LENGTHS = {"crank": 0.4, "coupler": 1.1, "rocker": 0.9, "ground": 1.0}


def four_bar(lengths):
    crank, coupler = lx.rod("crank", lengths["crank"], 1.0), lx.rod("coupler", lengths["coupler"], 1.0)
    rocker = lx.rod("rocker", lengths["rocker"], 1.0)
    bearing = lx.GROUND.at(jnp.stack([lengths["ground"], 0.0, 0.0]))
    joints = [
        lx.Revolute("crank_bearing", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("rocker_bearing", bearing, rocker.at("base"), axis="z"),
        lx.Revolute("crank_pin", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("rocker_pin", coupler.at("tip"), rocker.at("tip"), axis="z"),
    ]
    return lx.Mechanism([crank, coupler, rocker], joints)


def path(crank_angles):
    """A function of lengths -> the path, and whether the four-bar can be assembled and goes along it."""

    def of(lengths):
        mechanism = four_bar(lengths)
        start = lx.assemble(mechanism, {"crank_bearing": 0.0}, guess={"rocker_bearing": 1.5})
        turn = lx.trace(mechanism, start, {"crank_bearing": crank_angles})
        return {"point": turn.position("coupler", at=[0.55, 0.3, 0.0])[:, :2], "result": turn.result}

    return of


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--deviation", type=float, default=1e-3)
    parser.add_argument("--angles", type=int, default=36)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    function = path(np.linspace(0.0, 2.0 * np.pi, arguments.angles, endpoint=False))
    deviations = dict.fromkeys(LENGTHS, arguments.deviation)

    def timed(**options):
        began = time.perf_counter()
        found = lx.tolerance_analysis(function, LENGTHS, deviations, progress=False, **options)
        jax.block_until_ready(found.first)
        return time.perf_counter() - began, found

    orders = {}
    for order in (1, 2):
        (first, _), (again, _) = timed(order=order, samples=0), timed(order=order, samples=0)
        orders[f"order_{order}_first_call_s"], orders[f"order_{order}_s"] = first, again
    whole, found = timed(samples=arguments.samples)
    samples, errors = found.samples, found.samples.standard_errors
    spread = samples.standard_deviation["point"]
    off = lambda part, of, by: float(np.max(np.abs(getattr(of, part)["point"] - getattr(samples, part)["point"]) / by))
    row = {
        "angles": arguments.angles,
        "samples": arguments.samples,
        "ended": samples.sweep.count(),
        "standard_deviation_m": [float(np.min(spread)), float(np.max(spread))],
        **orders,
        "samples_s": arguments.samples * samples.sweep.seconds_per_member,
        "one_call_s": whole,
    }
    for name, of in (("first", found.first), ("second", found.second)):
        row[f"{name}_order_mean_off_by_standard_deviations"] = off("mean", of, spread)
        row[f"{name}_order_deviation_off"] = off("standard_deviation", of, spread)
    row["standard_error_of_deviation"] = float(np.max(errors.standard_deviation["point"] / spread))
    if arguments.json:
        print(json.dumps(row))
        return
    for name, entry in row.items():
        print(f"{name:44} {entry}")


if __name__ == "__main__":
    main()
