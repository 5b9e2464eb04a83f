"""Ctrl-C at any moment: one line, code 130, what has been computed is kept, and no file is half written."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.cli import compare, simulate
from linkax.files import remove_unfinished, written_whole

LIMIT = 300.0  # seconds
SOON = 5.0
HEARS = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"  # background jobs may not
COMMAND = [sys.executable, "-c", f"{HEARS}; from linkax_command import main; sys.exit(main())"]
SOURCE = Path(lx.__file__).parents[1]
SIMULATE = ["simulate", "pendulum"]

pytestmark = pytest.mark.skipif(os.name != "posix", reason="a process cannot be sent Ctrl-C alone")


def interrupted(arguments, path, *, after="", wait=0.0, times=1, file=None):
    """Exit code and lines of a command that gets Ctrl-C after the line that contains `after`, `file` and some time."""
    environment = os.environ | {"PYTHONPATH": str(path), "PYTHONUNBUFFERED": "1"}
    environment["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # compiling takes the same time whatever ran before
    process = subprocess.Popen([*COMMAND, *arguments], stderr=subprocess.PIPE, text=True, env=environment)
    watch = threading.Timer(LIMIT, process.kill)
    watch.start()
    try:
        before = next((line for line in process.stderr if after in line), None) if after else ""
        assert before is not None, f"no line with {after!r}"
        while file is not None and not file.exists() and process.poll() is None:
            time.sleep(0.01)
        for _ in range(times):
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(wait)
            process.send_signal(signal.SIGINT)
        _, lines = process.communicate(timeout=SOON)
    finally:
        watch.cancel()
        process.kill()
    return process.returncode, [line for line in lines.splitlines() if not line.endswith(" ...")]


def stands_in(folder, program):
    """A package in place of linkax, whose command line is this program."""
    (folder / "linkax" / "cli").mkdir(parents=True)
    (folder / "linkax" / "__init__.py").write_text("")
    (folder / "linkax" / "cli" / "__init__.py").write_text(program)
    (folder / "linkax" / "scenes").symlink_to(SOURCE / "linkax" / "scenes")
    (folder / "linkax_command").symlink_to(SOURCE / "linkax_command")
    return folder


READY = "import hashlib, sys, time\nready = lambda: print('ready', file=sys.stderr, flush=True)\n"
COMPUTES = "hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)"  # one call, deaf to signals, as XLA's are
MOMENTS = {
    "while importing": f"ready()\n{COMPUTES}",
    "in a call": f"def run(*_):\n    ready()\n    {COMPUTES}",
    "between calls": "def run(*_):\n    ready()\n    while True:\n        pass",
    "where errors are swallowed": """
class Deaf:
    def __del__(self):
        time.sleep(100.0)
def run(*_):
    ready()
    while True:
        try:
            Deaf()
        except BaseException:
            pass""",
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_ctrl_c_ends_the_command_with_one_line(moment, tmp_path):
    path = stands_in(tmp_path, READY + MOMENTS[moment])
    assert interrupted(SIMULATE, path, after="ready", wait=0.1) == (130, ["linkax: interrupted"])


KEEPS = "def run(_, at_interrupt):\n    at_interrupt({})\n    ready()\n    " + COMPUTES


@pytest.mark.parametrize(
    ("keep", "line"),
    [
        ("lambda: 'it is kept'", "; it is kept"),
        ("lambda: 1 / 0", "; what was computed cannot be kept: division by zero"),
    ],
)
def test_what_was_computed_is_kept(keep, line, tmp_path):
    path = stands_in(tmp_path, READY + KEEPS.format(keep))
    assert interrupted(SIMULATE, path, after="ready", wait=0.1) == (130, ["linkax: interrupted" + line])


def test_twice_ends_at_once(tmp_path):
    path = stands_in(tmp_path, READY + KEEPS.format("lambda: time.sleep(1000.0)"))
    assert interrupted(SIMULATE, path, after="ready", wait=0.3, times=2) == (130, [])


@pytest.mark.parametrize("code", [0, 1, 2])
def test_a_command_that_ends_by_itself_has_its_own_code(code, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(stands_in(tmp_path, f"def run(*_):\n    return {code}"))}
    assert subprocess.run([*COMMAND, *SIMULATE], env=environment, check=False).returncode == code


def test_files_that_were_being_written_are_removed(tmp_path):
    (tmp_path / ".unfinished-other").write_text("of another process")
    with written_whole(tmp_path / "file") as path:
        path.write_text("half")
        remove_unfinished(tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == [".unfinished-other"]
        path.write_text("whole")
    assert (tmp_path / "file").read_text() == "whole"


def test_a_run_keeps_its_motion_apart_from_that_of_a_whole_one(tmp_path):
    arm = lx.rod("arm", 1.0, 1.0)
    mechanism = lx.Mechanism([arm], [lx.Revolute("pivot", lx.GROUND, arm.at("base"), "z")])
    reached = lx.Solution.of_state(mechanism, lx.State(jnp.array([0.3]), jnp.zeros(1)), t=0.5)
    told = simulate.keeping(tmp_path, {"scene": "one"}, reached)()
    assert told == f"the motion until t = 0.5 s is in {tmp_path / 'trajectory-interrupted.npz'}"
    with np.load(tmp_path / "trajectory-interrupted.npz") as file:
        kept = {name: array.tolist() for name, array in file.items()}
    assert kept == {"t": [0.5], "q": [[0.3]], "v": [[0.0]], "coordinates": ["pivot"], "speeds": ["pivot"]}
    described = json.loads((tmp_path / "summary-interrupted.json").read_text())
    assert described == {"scene": "one", "result": "interrupted", "t_end": 0.5}


def test_a_comparison_keeps_its_trials_apart_from_a_whole_one(tmp_path):
    trial = lx.Trial("lagrange-multipliers", 1e-6, None, np.inf, *(0.0,) * 4, 3, None, 1.0, 0.5, "diverged", 0.5, "why")
    told = compare.keep(tmp_path, {"scene": "one"}, lx.Comparison("closed form", 0.0, 0.01, [], [trial]))
    assert told == f"what was compared is in {tmp_path / 'comparison-interrupted.json'}"
    described = json.loads((tmp_path / "comparison-interrupted.json").read_text())
    assert (described["scene"], described["result"]) == ("one", "interrupted")
    assert described["trials"] == [trial._asdict() | {"error": None}]


def test_ctrl_c_while_linkax_is_imported():
    assert interrupted(SIMULATE, SOURCE, wait=0.5) == (130, ["linkax: interrupted"])


PENDULUM = ["simulate", "pendulum", "--t1", "2", "--preset", "draft"]
LONG = ["simulate", "pendulum", "--t1", "1e5"]
COMPARED = ["compare", "pendulum", "--t1", "2000"]  # three seconds of running and more, however fast all is compiled
PART = {"trajectory-interrupted.npz", "summary-interrupted.json"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "after", "wait", "left"),
    [
        (PENDULUM, "assembling", 0.3, set()),
        (PENDULUM, "assembling", 0.0, set()),
        (PENDULUM, "compiling", 0.3, set()),
        (["simulate", "n-four-bar", "--set", "N=6"], "compiling", 1.0, set()),  # which compiles for seconds anywhere
        (LONG, "integrating", 0.0, set()),
        (LONG, "integrating", 2.0, PART),  # some of its twenty segments are there
        (PENDULUM, "reading", 0.2, PART),
        (PENDULUM, "drawing", 0.0, {"trajectory.npz", "summary.json"}),
        (PENDULUM, "drawing", "motion_bob.png", {"trajectory.npz", "summary.json"}),
        (PENDULUM, "drawing", "reaction_pivot.png", {"trajectory.npz", "summary.json"}),  # the last before the GIF
        (COMPARED, "compiling", 0.5, set()),
    ],
)
def test_ctrl_c_at_each_moment_of_a_command(command, after, wait, left, tmp_path):
    moment = {"file": tmp_path / wait} if isinstance(wait, str) else {"wait": wait}
    code, lines = interrupted([*command, "--out", str(tmp_path)], SOURCE, after=after, **moment)
    assert code == 130
    assert len(lines) == 1
    assert lines[0].startswith("linkax: interrupted")
    found = {path.name for path in tmp_path.iterdir() if path.suffix not in (".png", ".gif")}
    assert found == left
    assert "summary.json" not in left or json.loads((tmp_path / "summary.json").read_text())


@pytest.mark.slow
def test_ctrl_c_keeps_the_formulations_that_were_compared(tmp_path):
    code, lines = interrupted([*COMPARED, "--out", str(tmp_path)], SOURCE, after="running", wait=1.0)
    kept = tmp_path / "comparison-interrupted.json"
    # The machine decides how many are compared by then, or whether one is.
    told = f"; what was compared is in {kept}" if kept.exists() else ""
    assert (code, lines) == (130, [f"linkax: interrupted{told}"])
    assert {path.name for path in tmp_path.iterdir()} <= {kept.name}
    assert not kept.exists() or json.loads(kept.read_text())["trials"]
