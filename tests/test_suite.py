"""Rules of the tests themselves: how long one may take, and which of the slow ones run."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
import slow_tests
from program_folder import forget_oldest

TESTS = Path(__file__).parent
BUSY = """
import time
import pytest

def busy():
    end = time.process_time() + 0.5
    while time.process_time() < end:
        pass

def test_busy():
    busy()

@pytest.mark.slow
def test_slow():
    busy()

def test_quick():
    pass
"""


def ran(folder, *options):
    """What pytest prints of `BUSY` with the rules of these tests, where a test may take 0.05 s."""
    (folder / "test_them.py").write_text(BUSY)
    (folder / "pytest.ini").write_text("[pytest]\nmost_processor_time = 0.05\nmarkers = slow")
    plugins = ["-p", "xdist", "-p", "processor_time", "-p", "slow_tests"]
    command = [sys.executable, "-m", "pytest", *plugins, "-n1", "-ra", *options]
    environment = os.environ | {"PYTHONPATH": str(TESTS), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True).stdout


def test_a_test_that_takes_long_is_an_error(tmp_path):
    told = ran(tmp_path)
    assert "3 passed, 1 error" in told
    assert "ERROR test_them.py::test_busy" in told
    assert "s of processor time, and may take 0.05: share" in told
    assert "s in 3 tests; the longest:" in told
    assert "did not run" not in told
    assert "may take 0.03: make tests of its parts" in ran(tmp_path, "-o", "most_processor_time=0.001")


def test_what_did_not_run_is_told(tmp_path):
    assert "test_them.py::test_busy: no time is left" in ran(tmp_path, "--minutes", "0")
    parts = [ran(tmp_path, "--share", f"{k}/2") for k in range(2)]
    left = [int(part.partition("test_them.py: ")[2].split()[0]) for part in parts if "did not run" in part]
    assert sum(left) == 3


def test_modules_of_tests_have_names_of_their_own():
    """pytest imports each module of tests by its file's name alone, wherever it lies."""
    names = Counter(path.name for path in TESTS.rglob("*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def touched(*changed):
    """Which of some files of tests are touched by a change to files."""
    return set(filter(slow_tests._touched_by(list(map(Path, changed)), TESTS.parent), TOUCHED))


LAPACK, LAWS, GRADIENTS, COMMAND = TOUCHED = (
    Path("tests/linalg/test_constrained_solve.py"),
    Path("tests/equations/test_laws.py"),
    Path("tests/simulation/test_gradients.py"),
    Path("tests/test_cli.py"),
)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        (["src/linkax/model/bodies.py"], set(TOUCHED)),
        (["src/linkax/simulation/start/state.py"], {GRADIENTS, COMMAND}),
        (["src/linkax/cli/options.py", "tests/equations/test_laws.py"], {LAWS, COMMAND}),
        (["tests/mechanisms.py"], {LAWS, GRADIENTS}),
        (["src/linkax/__init__.py"], {COMMAND}),
        ([], set()),
    ],
)
def test_a_change_touches_tests_of_its_layer_and_above(changed, expected):
    assert touched(*changed) == expected


def test_the_folder_of_programs_keeps_what_was_used_last(tmp_path):
    files = [tmp_path / "key" / str(index) for index in range(4)]
    files[0].parent.mkdir()
    for index, path in enumerate(files):
        path.write_bytes(bytes(100))
        os.utime(path, (index, index))
    forget_oldest(files[0].parent, 250)
    assert [path.exists() for path in files] == [False, False, True, True]
