"""The command line, as a user meets it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import linkax_command
from linkax.cli import options
from linkax.formulations.named import BASES
from linkax_command import parser, run

KEYS = {
    "scene", "variant", "t1", "preset", "steps", "compile_s", "run_s", "position_violation",
    "velocity_violation", "acceleration_violation", "energy_unaccounted", "work", "rank_min", "rank_max",
    "result", "final", "singularity_distance", "passages", "digits_lost",
}  # fmt: skip

BAD = {
    "simulate nothing": "unknown scene 'nothing'; known: pendulum, crank-slider, n-four-bar",
    "simulate pendulum --variant A99": "no variant 'A99'; known: A01",
    "simulate pendulum --set size=2": "no parameter 'size'; known: length",
    "simulate pendulum --set length=long": "'length' of scene 'pendulum' is 'long'; it must be a finite number",
    "simulate pendulum --set length=nan": "finite number",
    "simulate pendulum --set length=1_5": "'1_5'; it must be a finite number",
    "simulate n-four-bar --set N=1_0": "'1_0'; it must be an integer of at least 1",
    "simulate pendulum --t1 1_5": "'1_5' is not a positive, finite number",
    "simulate pendulum --set mass=-1": "mass [kg] is -1.0; it must be zero or more",
    "simulate pendulum --set length": "write --set NAME=VALUE",
    "simulate n-four-bar --set N=2.5": "'N' of scene 'n-four-bar' is '2.5'; it must be an integer",
    "simulate n-four-bar --set N=0": "integer of at least 1",
    "simulate pendulum --preset best": "unknown 'best'; known: draft, balanced, precise",
    "simulate pendulum --solver euler": (
        "unknown 'euler'; known: tsit5, dopri5, dopri8, kvaerno3, kvaerno5, rodas5p, rk4"
    ),
    "simulate pendulum --solver rk4": "--solver rk4 estimates no error; give its steps by --dt",
    "simulate pendulum --formulation magic": "unknown formulation 'magic'; known: tangent-space, or one of lagrange-",
    "compare pendulum --formulations tangent-space,lm": "unknown formulation 'lm'; known: tangent-space",
    "compare pendulum --equal time": "unknown 'time'; known: tolerance, cost",
    "compare pendulum --bound 0": "not a positive, finite number",
    "simulate pendulum --rtol 0": "'0' is not a positive, finite number",
    "simulate pendulum --rtol nan": "not a positive",
    "simulate pendulum --t1 -3": "positive, finite",
    "simulate crank-slider --set rod=0.5 --set angle=1.5": "parameters of scene 'crank-slider' by --set NAME",
    "fly": "unknown command 'fly'; known: list, simulate, inspect, convert, compare, sweep",
    "": "COMMAND",
}


@pytest.mark.parametrize("command", BAD)
def test_bad_input_is_one_line_and_code_two(command, capsys, tmp_path):
    out = ["--out", str(tmp_path), "--no-plots"] if command.startswith(("simulate", "compare")) else []
    assert run([*command.split(), *out]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    *progress, line = printed.err.strip().splitlines()
    assert BAD[command] in line
    assert progress in ([], ["assembling ..."])


LIGHT = {
    "--help": (0, "simulate"),
    "--version": (0, "linkax 0.1.0, jax "),
    "list": (0, "variant SC1 (default): "),
    "simulate crank-slidr": (2, "(did you mean 'crank-slider'?); known: pendulum"),
    "simulatte": (2, "unknown command 'simulatte' (did you mean 'simulate'?); known: list"),
    "compare pendulum --solver dopri": (2, "(did you mean 'dopri8'?)"),
}
ANSWER = """
import sys
from linkax_command import run
try:
    code = run(sys.argv[1:])
except SystemExit as ended:
    code = ended.code
print("waits for JAX" if "jax" in sys.modules else "at once")
sys.exit(code)
"""


def asked(*arguments):
    """What another Python ended with and printed."""
    environment = os.environ | {"PYTHONPATH": str(Path(linkax_command.__file__).parents[1])}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment, check=False)


@pytest.mark.parametrize("command", LIGHT)
def test_what_computes_nothing_does_not_wait_for_jax(command):
    found = asked("-c", ANSWER, *command.split())
    code, words = LIGHT[command]
    assert found.returncode == code
    assert words in (found.stderr if code else found.stdout)
    assert found.stdout.endswith("at once\n")


def test_python_m_linkax_is_the_command():
    found = asked("-m", "linkax", "--version")
    assert found.returncode == 0
    assert "linkax 0.1.0" in found.stdout


def test_the_parser_names_what_there_is():
    assert set(parser.SOLVERS) == set(options.SOLVERS)
    for name in BASES:
        assert name in parser.FORMULATIONS


def test_list_names_everything(capsys):
    assert run(["list"]) == 0
    printed = capsys.readouterr().out
    for word in ("pendulum", "crank-slider", "n-four-bar", "SC4", "A02", "FL2", "N = 2", "slider_mass"):
        assert word in printed


def test_json_is_one_object_and_files_are_whole(capsys, tmp_path):
    command = ["simulate", "pendulum", "--t1", "2", "--preset", "draft", "--out", str(tmp_path), "--json"]
    assert run(command) == 0
    printed = capsys.readouterr().out
    found = json.loads(printed)
    assert printed.count("\n") == 1
    assert set(found) >= KEYS
    assert found["result"] == "successful"
    assert len(found["final"]["bob"]) == 3
    assert found == json.loads((tmp_path / "summary.json").read_text())
    with np.load(tmp_path / "trajectory.npz") as file:
        kept = dict(file)
    assert {"t", "q", "v", "coordinates", "energy", "rank", "position_bob", "force_pivot", "moment_pivot"} <= set(kept)
    assert kept["position_bob"].shape == (len(kept["t"]), 3)
    np.testing.assert_allclose(kept["position_bob"][-1], found["final"]["bob"])
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"motion_bob.png", "violations.png", "energy.png", "reaction_pivot.png"}
    with Image.open(tmp_path / "mechanism.gif") as film:
        frames = []
        for index in range(film.n_frames):
            film.seek(index)
            frames.append(np.asarray(film.convert("RGB")))
    assert len(frames) > 20
    assert np.std(frames[0]) > 1.0
    assert np.any(frames[0] != frames[len(frames) // 2])
    assert "showMechanism" in (tmp_path / "mechanism.html").read_text()
    assert not [path for path in tmp_path.iterdir() if "unfinished" in path.name]


def test_summary_for_people(capsys, tmp_path):
    command = ["simulate", "pendulum", "--t1", "2", "--preset", "draft", "--out", str(tmp_path), "--no-plots"]
    (tmp_path / "trajectory-interrupted.npz").write_text("of an earlier run")
    assert run(command) == 0
    printed = capsys.readouterr().out
    words = "successful", "steps", "compile time", "run time", "position violation", "energy unaccounted for", "bob"
    for word in words:
        assert word in printed
    assert {path.name for path in tmp_path.iterdir()} == {"summary.json", "trajectory.npz"}


def test_compare_prints_verdicts_and_keeps_them(capsys, tmp_path, monkeypatch):
    names = "tangent-space,lagrange-multipliers,moore-penrose-svd+partitioning"
    command = ["compare", "pendulum", "--t1", "2", "--formulations", names, "--out", str(tmp_path)]
    kept = []
    monkeypatch.setattr(linkax_command, "at_interrupt", lambda keep: kept.append(keep()))
    assert run(command) == 0
    part = f"what was compared is in {tmp_path / 'comparison-interrupted.json'}"
    assert kept == ["", part, part, part, f"the comparison is in {tmp_path / 'comparison.json'}"]
    assert {path.name for path in tmp_path.iterdir()} == {"comparison.json", "comparison.png"}
    printed = capsys.readouterr().out
    kept = json.loads((tmp_path / "comparison.json").read_text())
    assert kept["answer"] == "closed form"
    assert kept["uncertainty"] < 1e-11
    assert [trial["formulation"] for trial in kept["trials"]] == names.split(",")
    for trial in kept["trials"]:
        assert trial["verdict"] == "converged"
        assert 1e-12 < trial["error"] < 1e-6
        # Dopri8 begins with the last derivative of the step before, where no correction has moved the state.
        corrected = "+" in trial["formulation"]
        assert trial["evaluations"] == (14 if corrected else 13) * trial["steps"] + (not corrected)
        assert trial["reached"] == 2.0
    assert "diverged: the run ended early, or a point was off by more than 0.01 m" in printed
    with Image.open(tmp_path / "comparison.png") as picture:
        assert np.std(np.asarray(picture.convert("RGB"))) > 1.0


SC2 = ["compare", "crank-slider", "--variant", "SC2", "--formulations"]  # singular at 0.4825 s
BOTH = "lagrange-multipliers,lagrange-multipliers+projection"


@pytest.mark.slow
def test_compare_at_equal_cost_chooses_among_tolerances(capsys, tmp_path):
    assert run([*SC2, BOTH, "--t1", "0.4", "--equal", "cost", "--out", str(tmp_path), "--json", "--no-plots"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [trial["formulation"] for trial in found["trials"]] == ["tangent-space", *BOTH.split(",")]
    assert found["trials"][0]["run_s"] <= found["budget_s"]
    assert found["trials"][0]["rtol"] <= 1e-8
    for trial in found["trials"]:
        assert trial["verdict"] == "converged"
        assert trial["error"] < 1e-3


@pytest.mark.slow
def test_compare_tells_when_a_formulation_left_the_motion(capsys, tmp_path):
    assert run([*SC2, BOTH, "--t1", "0.7", "--out", str(tmp_path), "--no-plots"]) == 0
    printed = capsys.readouterr().out
    left, stayed = json.loads((tmp_path / "comparison.json").read_text())["trials"]
    assert (stayed["verdict"], stayed["diverged_at"], stayed["why"]) == ("converged", None, "")
    assert left["verdict"] == "diverged"
    assert 0.48 < left["diverged_at"] < 0.6
    assert "loops closed to" in left["why"]
    assert "last singular passage at 0.4825 s" in printed


SETTINGS = {"scene": "crank-slider", "variant": "SC1", "t1": 2.0, "parameters": {"rod": 0.3}}
OTHERS = {
    "scene": "with scene 'bricard' instead of 'crank-slider'",
    "variant": "with variant 'bricard' instead of 'SC1'",
    "t1": "with t1 'bricard' instead of 2.0",
    "parameters": "with parameters 'bricard' instead of {'rod': 0.3}",
}


@pytest.mark.parametrize("file", ["summary.json", "summary-interrupted.json"])
def test_results_of_another_run_are_never_replaced(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = ("summary.json", "summary-interrupted.json")
    folder = lambda out=None, **changes: options.output_folder(out, "crank-slider", SETTINGS | changes, files)
    for name, words in OTHERS.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / file).write_text(json.dumps(SETTINGS | {name: "bricard", "steps": 3}))
        with pytest.raises(ValueError, match=re.escape(f"{words}; give another folder, or remove this one")):
            folder(tmp_path / name)
    for text in ("{", "3", "[1]"):
        (tmp_path / "scene" / file).write_text(text)
        with pytest.raises(ValueError, match=f"and {file} cannot be read"):
            folder(tmp_path / "scene")
    own = tmp_path / "own"
    own.mkdir()
    (own / file).write_text(json.dumps(SETTINGS | {"steps": 3}))
    assert folder(own) == own


def test_each_run_has_a_default_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*more, **changes):
        settings = SETTINGS | changes
        name = options.RunOptions(parser.parsed(["simulate", "crank-slider", *more])).folder
        found = options.output_folder(None, name, settings, ("summary.json",))
        (found / "summary.json").write_text(json.dumps(settings))
        return found.as_posix()

    for _ in range(2):
        assert run() == run("--variant", "SC1") == "linkax-out/crank-slider"
        assert run(t1=3.0) == "linkax-out/crank-slider-2"
        assert run(t1=4.0) == "linkax-out/crank-slider-3"
        assert run("--variant", "SC2", variant="SC2") == "linkax-out/crank-slider-SC2"
