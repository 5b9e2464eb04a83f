"""A formula of the method is a few calls away from `simulate`."""

import sys
from itertools import takewhile
from pathlib import Path
from traceback import walk_stack

import pytest

import linkax as lx
from linkax.formulations import projected_state
from linkax.formulations.tangent_space import TangentSpace

SOURCE = str(Path(lx.__file__).parent)
MOST = 10


@pytest.fixture(scope="module")
def depths():
    """Calls of linkax between `simulate` and each formula, where it is reached first."""
    found = {}

    def watch(owner, name, patch):
        formula = getattr(owner, name)

        def counted(*args, **options):
            codes = [frame.f_code for frame, _ in walk_stack(sys._getframe(1))]
            below = takewhile(lambda code: code.co_name != "simulate", codes)
            # Checks of the start, and readings, have programs of their own.
            if "_integrate" in [code.co_name for code in codes]:
                found.setdefault(name, sum(code.co_filename.startswith(SOURCE) for code in below))
            return formula(*args, **options)

        patch.setattr(owner, name, counted)

    with pytest.MonkeyPatch.context() as patch:
        for name in ("split", "correct_position", "correct_velocity", "solve_accelerations"):
            watch(TangentSpace, name, patch)
        watch(projected_state, "gamma", patch)
        # Names of its own, so that no other test has traced it.
        crank, slide = lx.rod("watched_crank", 1.0, 1.0), lx.rod("watched_rod", 1.5, 1.0)
        pins = lx.Revolute("foot", lx.GROUND, crank, "z"), lx.Revolute("knee", crank.at("tip"), slide, "z")
        foot = lx.Revolute("hand", lx.GROUND.at([1.0, 0.0, 0.0]), slide.at("tip"), "z")
        mechanism = lx.Mechanism([crank, slide], [*pins, foot])
        lx.simulate(mechanism, lx.assemble(mechanism), t1=1e-3)
    return found


def test_formulas_are_a_few_calls_from_simulate(depths):
    assert set(depths) == {"split", "correct_position", "correct_velocity", "solve_accelerations", "gamma"}
    assert max(depths.values()) <= MOST, depths
