"""Whole programs in processes of their own, each of which has to end: nothing waits for ever, on few cores or many."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import linkax as lx
from linkax.scenes import SCENES

LIMIT = 1800.0  # seconds, where others work too; most take less than 90 alone, the telescopic crane five minutes
SOURCE = Path(lx.__file__).parents[1]
COMMAND = "import sys; from linkax_command import main; sys.exit(main())"
SWEEP = """
import jax.numpy as jnp
import linkax as lx
from linkax.scenes import SCENES

scene = SCENES["n-four-bar"]

def run(speed):
    parameters = scene.parameters | {"N": 20, "speed": speed}
    mechanism = scene.mechanism(parameters)
    found = lx.simulate(mechanism, scene.initial(mechanism, parameters), t1=1.5, accuracy=lx.DRAFT)
    force, distance = found.reaction("pivot_3").force[-1], found.singularity_distance()
    return {"force": force, "distance": distance, "result": found.result}

print(len(lx.sweep(run, jnp.linspace(-1.0, -0.8, 4), chunk=4).failed))
"""
# Of each section, and of the dome: less to compile, and of three rings a run takes 22 s in place of 6. The crane's ten
# seconds, which passages integrate a second time, take two minutes.
FEWER = {"telescopic-crane": ["--set", "elements=1", "--t1", "4"], "hoberman": ["--set", "rings=2"]}
VARIANTS = [(scene, variant) for scene, of in SCENES.items() for variant in of.variants]
ROWS = {"20": (20, None), "20 on one core": (20, 1), "40": (40, None)}


def ended(program, *arguments, cores=None):
    """What a program prints, which ends well within the limit."""
    # Without the flags of tests, which save time to compile: their code takes four times as long for a dome.
    of_tests = ("XLA_FLAGS", "EQX_ON_ERROR")
    users = {name: text for name, text in os.environ.items() if name not in of_tests}
    environment = users | {"PYTHONPATH": str(SOURCE)}
    confine = f"import os; os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{cores}])\n"
    command = [sys.executable, "-c", confine + program, *arguments]
    found = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, env=environment)
    assert found.returncode == 0, found.stderr
    return found.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "variant"), VARIANTS)
def test_every_variant_by_the_command_line(scene, variant, tmp_path):
    run = [scene, "--variant", variant, *FEWER.get(scene, []), "--json", "--out", str(tmp_path)]
    told = json.loads(ended(COMMAND, "simulate", *run))
    assert told["result"] == "successful"
    assert (tmp_path / "mechanism.gif").exists()


@pytest.mark.slow
@pytest.mark.parametrize("case", ROWS)
def test_a_row_of_loops_by_the_command_line(case, tmp_path):
    count, cores = ROWS[case]
    run = ["n-four-bar", "--set", f"N={count}", "--t1", "20", "--preset", "precise", "--json", "--out", str(tmp_path)]
    told = json.loads(ended(COMMAND, "simulate", *run, cores=cores))
    assert told["result"] == "successful"
    assert len(told["passages"]) == 20
    assert (tmp_path / "mechanism.gif").exists()


@pytest.mark.slow
@pytest.mark.parametrize("cores", [None, 1])
def test_a_sweep_of_rows_of_loops(cores):
    assert int(ended(SWEEP, cores=cores)) == 0
