"""A formula of the method is a few calls away from `simulate`."""

import sys
from pathlib import Path

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
            frame, count = sys._getframe(1), 0
            while frame is not None and frame.f_code.co_name != "simulate":
                count += frame.f_code.co_filename.startswith(SOURCE)
                frame = frame.f_back
            # Checks of the start, and readings, have programs of their own.
            names, above = [], sys._getframe(1)
            while above is not None:
                names.append(above.f_code.co_name)
                above = above.f_back
            if "_integrate" in names:
                found.setdefault(name, count)
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
