"""Every scene against its known answer, and with every choice of the spanning tree.

Parts, chosen by `--part`:

- `answers`: largest error at all reference times, energy error, violations, for each preset.
- `long-row`: the row of forty four-bars, 20 s, `PRECISE` (minutes).
- `trees`: each joint of a loop cut in turn: largest differences of positions [m] and of unique reactions
  [N, N m], and both over the largest position and reaction.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

import linkax as lx

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from known_answers import PASSING, REDUNDANT, n_four_bar, start
from mechanisms import with_cut

from benchmarks.parts import print_parts

PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}


def _row(name, found, error, seconds):
    return {
        "scene": name,
        "error": float(np.max(error)),
        "energy": float(np.ptp(found.energy()) / np.max(found.kinetic_energy())),
        "violations": [float(f"{worst:.1e}") for worst in found.worst_violation()],
        "steps": int(found.stats["num_steps"]),
        "run_s": round(seconds, 4),
    }


def answers():
    for name, known in (PASSING | REDUNDANT).items():
        for preset, accuracy in PRESETS.items():
            known.simulate(accuracy=accuracy)
            began = time.perf_counter()
            found = jax.block_until_ready(known.simulate(accuracy=accuracy))
            yield {"preset": preset} | _row(name, found, known.error(found), time.perf_counter() - began)


def long_row():
    mechanism, state = start("n-four-bar", "A02", {"N": 40})
    began = time.perf_counter()
    found = jax.block_until_ready(lx.simulate(mechanism, state, t1=20.0, accuracy=lx.PRECISE))
    error = np.linalg.norm(found.position("link_0", at="tip")[:, :2] - n_four_bar(found.ts, 40), axis=-1)
    yield _row("A02-40, compiling included", found, error, time.perf_counter() - began)


def trees():
    loops = {
        ("crank-slider", "regular"): (("bearing", "crank_pin", "wrist_pin", "guide"), 1.0),
        ("spatial-four-link", "FL3"): (("A", "B", "C", "D"), 5.0),
        ("bricard", None): (tuple(f"P{i}" for i in range(1, 7)), 5.0),
        ("rigid-crane", None): (("boom", "foot", "luffing", "head"), 5.0),
        ("planar-four-bar", None): (("P1", "P2", "P3", "P4"), 5.0),
    }
    for (scene, variant), (cuts, t1) in loops.items():
        mechanism, state = start(scene, variant)
        here = lx.Solution.of_state(mechanism, state)
        positions = {name: here.joint(name)[0] for name in cuts}
        speeds = {name: here.joint_speed(name)[0] for name in cuts}
        first = None
        for cut in cuts:
            other = with_cut(mechanism, cut)
            without = lambda values, cut=cut: {name: entry for name, entry in values.items() if name != cut}
            begin = lx.assemble(other, without(positions), without(speeds), guess=_rest(other, here, cuts))
            found = lx.simulate(other, begin, t1=t1, accuracy=lx.PRECISE)
            places = np.stack([found.position(body) for body in mechanism.topology.bodies])
            reactions = {name: (found.reaction(name), found.reaction_unique(name)) for name in cuts}
            away = np.asarray(found.singularity_distance()) > 0.02
            if first is None:
                first = places, reactions
            apart = 0.0
            largest = max(np.max(np.abs(part)) for reaction, _ in first[1].values() for part in reaction)
            for name in cuts:
                (reaction, unique), (reference, sure) = reactions[name], first[1][name]
                for part, known, a, b in zip(reaction, reference, unique, sure, strict=True):
                    both = np.asarray(a & b) & away[:, None]
                    assert np.all(np.asarray(a)[away] == np.asarray(b)[away]), (scene, cut, name)
                    apart = max(apart, np.max(np.abs(np.where(both, part - known, 0.0))))
            jax.clear_caches()  # each compiled program holds memory maps, of which a process has 65 530
            yield {
                "scene": scene,
                "cut": cut,
                "motion": float(np.max(np.abs(places - first[0]))),
                "unique reactions": float(apart),
                "relative": [
                    float(f"{np.max(np.abs(places - first[0])) / np.max(np.abs(places)):.1e}"),
                    float(f"{apart / largest:.1e}"),
                ],
            }


def _rest(mechanism, here, cuts):
    """Coordinates of the joints outside the loop."""
    names = [name for name in mechanism.topology.coordinates if name not in cuts and mechanism.joint(name).speed_units]
    return {name: here.joint(name)[0] for name in names}


PARTS = {"answers": answers, "long-row": long_row, "trees": trees}


if __name__ == "__main__":
    print_parts(__doc__, PARTS)
