"""Contact: a slider-crank whose piston pin is loose in its bearing, and how stops become rigid as they stiffen.

`slider_crank`: crank 0.05 m, 0.3 kg, 1e-4 kg m²; connecting rod 0.12 m, 0.21 kg, 2.5e-4 kg m²; slider 0.14 kg; the
crank turns at 5000 rpm. Bearing of 10 mm radius on the rod, journal on the slider, clearance 0.5 mm, restitution 0.9,
friction 0.03, Young's modulus 207 GPa, Poisson's ratio 0.3. It starts with both centres together, the mechanism
stretched. These are the numbers of Flores, Ambrósio, Claro, Lankarani, A study on dynamics of mechanical systems
including joints with clearance and lubrication, Mechanism and Machine Theory 41, 2006, quoted from memory. The normal
stiffness is Hertz's for a sphere in a spherical seat, as there. What they do not say, as their laws differ: restitution
holds at `--impact-speed` (default 1 m/s), and friction is largest at 0.1 m/s. Prints impacts and forces of the turns
after the first, beside the reaction of the pin without clearance, and draws the journal's path into `--out`.

`convergence`: ten bounces of 1 kg from 1 m, by stops of growing stiffness and by `linkax.Impact`: how far the end is
from that of a rigid stop, steps and the shortest time of five runs.

`python -m benchmarks.contact [CASE ...] [--turns N] [--impact-speed V] [--out DIR]` prints one JSON object.
"""

import argparse
import json
import time
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx

G = 9.81
CRANK, ROD, SPEED = 0.05, 0.12, 5000.0 * 2.0 * np.pi / 60.0
RADIUS, CLEARANCE = 0.01, 0.5e-3
SAVES = 4000  # a turn


def hertz(young=207e9, poisson=0.3):
    """Stiffness of a sphere in a spherical seat, both of one material [N/m^(3/2)]."""
    journal, compliance = RADIUS - CLEARANCE, (1.0 - poisson**2) / young
    return 4.0 / (3.0 * 2.0 * compliance) * np.sqrt(RADIUS * journal / CLEARANCE)


def slider_crank(impact_speed):
    """With clearance at the piston pin; without it for None."""
    half = lambda length: [length / 2.0, 0.0, 0.0]
    crank = lx.RigidBody("crank", 0.3, half(CRANK), 1e-4, {"tip": [CRANK, 0.0, 0.0]})
    rod = lx.RigidBody("rod", 0.21, half(ROD), 2.5e-4, {"tip": [ROD, 0.0, 0.0]})
    slider = lx.point_mass("slider", 0.14)
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank, "z"),
        lx.Revolute("crank_pin", crank.at("tip"), rod, "z"),
        lx.Prismatic("guide", lx.GROUND, slider, "x"),
    ]
    drive = lx.Drive("drive", "bearing", lambda t: SPEED * t)
    if impact_speed is None:
        pin = lx.Revolute("piston_pin", rod.at("tip"), slider, "z")
        return lx.Mechanism([crank, rod, slider], [*joints, pin], [], [drive])
    friction = lx.Friction(0.03, transition_speed=0.1)
    law = lx.ContactLaw(hertz(), restitution=0.9, impact_speed=impact_speed, friction=friction)
    loose = lx.Clearance(rod.at("tip"), slider, clearance=CLEARANCE, radius=RADIUS, law=law, name="pin")
    return lx.Mechanism([crank, rod, slider], joints, [loose], [drive])


def loose_pin(arguments):
    tight = slider_crank(None)
    start = lx.assemble(tight, {"bearing": 0.0}, {"bearing": SPEED}, guess={"guide": CRANK + ROD})
    t1 = 2.0 * np.pi / SPEED * arguments.turns
    options = {"t1": t1, "saveat": diffrax.SaveAt(ts=np.linspace(0.0, t1, SAVES * arguments.turns + 1))}
    ideal = lx.simulate(tight, start, **options)
    reaction = np.linalg.norm(ideal.reaction("piston_pin").force, axis=-1)
    loose = slider_crank(arguments.impact_speed)
    same = lambda values: {name: values(name)[0] for name in ("bearing", "crank_pin", "guide")}
    state = lx.assemble(loose, same(ideal.joint), same(ideal.joint_speed))
    began = time.perf_counter()
    run = lx.simulate(loose, state, accuracy=lx.Accuracy(rtol=1e-7), max_steps=None, **options)
    force = np.asarray(jax.block_until_ready(run.force("pin")))
    took = time.perf_counter() - began
    moved = np.asarray(run.position("slider") - run.position("rod", "tip"))
    axes = np.asarray(run.orientation("rod"))
    path = np.einsum("tji,tj->ti", axes, moved)[:, :2] / CLEARANCE
    draw(path, force, reaction, np.asarray(run.ts) * SPEED / (2.0 * np.pi), arguments.out)
    begin = SAVES if arguments.turns > 1 else 0
    pressed = force > 0.0
    impacts = int(np.sum(pressed[begin + 1 :] & ~pressed[begin:-1]))
    deviation = np.abs(np.asarray(run.joint("guide") - ideal.joint("guide")))
    return {
        "stiffness [N/m^1.5]": hertz(),
        "impact speed of the restitution [m/s]": arguments.impact_speed,
        "contacts per turn": impacts / max(arguments.turns - 1, 1),
        "share of time in contact": float(np.mean(pressed[begin:])),
        "largest force [N]": float(np.max(force[begin:])),
        "mean force in contact [N]": float(np.mean(force[begin:][pressed[begin:]])),
        "largest force in the first turn [N]": float(np.max(force[: SAVES + 1])),
        "largest reaction without clearance [N]": float(np.max(reaction)),
        "mean reaction without clearance [N]": float(np.mean(reaction)),
        "deepest penetration [mm]": float(np.max(run.length("pin")) - CLEARANCE) * 1e3,
        "largest deviation of the slider [mm]": float(np.max(deviation)) * 1e3,
        "energy lost at the pin [J]": -float(run.work()["pin"][-1]),
        "steps": int(run.stats["num_steps"]),
        "seconds, with compiling": took,
    }


def draw(path, force, reaction, turns, folder):
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11.0, 5.0), width_ratios=(1.0, 1.4), layout="constrained")
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    left.plot(np.cos(angle), np.sin(angle), color="0.6")
    left.plot(*path.T, linewidth=0.6)
    left.set(
        aspect="equal", xlabel="along the rod [clearances]", ylabel="across [clearances]", title="journal's centre"
    )
    right.plot(turns, force / 1e3, linewidth=0.6, label="with clearance")
    right.plot(turns, reaction / 1e3, color="k", label="without")
    right.set(xlabel="turns of the crank", ylabel="force at the piston pin [kN]", ylim=(0.0, None))
    right.legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "slider_crank_with_clearance.png", dpi=120)


def convergence(arguments):
    rigid_end = 1.0 - G * 0.3**2 / 2.0  # 0.3 s after the top of the flight that follows the tenth bounce
    speed, t1 = -G * 0.3, np.sqrt(2.0 / G) * 20.0 + 0.3
    mass = lx.point_mass("mass", 1.0)
    rail, start = lx.Prismatic("rail", lx.GROUND, mass, "y"), lx.State(jnp.ones(1), jnp.zeros(1))

    def ended(stop):
        mechanism = lx.Mechanism([mass], [rail], [lx.Gravity([0.0, -G, 0.0]), stop])
        return lx.simulate(mechanism, start, t1=t1, accuracy=lx.Accuracy(rtol=1e-9), saveat=diffrax.SaveAt(t1=True))

    def row(stop):
        found, seconds = ended(stop), []
        for _ in range(5):
            began = time.perf_counter()
            jax.block_until_ready(ended(stop).end)
            seconds.append(time.perf_counter() - began)
        return {
            "height off [m]": abs(float(found.end.q[0]) - rigid_end),
            "speed off [m/s]": abs(float(found.end.v[0]) - speed),
            "steps": int(found.stats["num_steps"]),
            "seconds": min(seconds),
        }

    rows = [{"stop": "Impact", **row(lx.Impact("rail", lower=0.0, restitution=1.0))}]
    for stiffness in 1e5 * 10.0 ** np.arange(6):
        rows.append(
            {"stop": f"{stiffness:.0e} N/m^1.5", **row(lx.JointLimit("rail", lx.ContactLaw(stiffness), lower=0.0))}
        )
    return rows


CASES = {"slider_crank": loose_pin, "convergence": convergence}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(CASES)} (default: all)")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--impact-speed", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=Path("contact"), metavar="DIR")
    arguments = parser.parse_args()
    if unknown := set(arguments.cases) - set(CASES):
        parser.error(f"unknown cases {', '.join(sorted(unknown))}; known: {', '.join(CASES)}")
    print(json.dumps({case: CASES[case](arguments) for case in arguments.cases or CASES}, indent=1))


if __name__ == "__main__":
    main()
