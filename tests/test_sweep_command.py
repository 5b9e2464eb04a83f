"""The command `linkax sweep`, as a user meets it."""

import json
import os
import signal
import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from annotations import unchecked

import linkax as lx
from linkax_command import run

LIMIT = 120.0  # seconds
MEMBERS = 100
STUDY = f"""
import jax.numpy as jnp
from beside import factor

def function(params):
    return {{"x": factor * jnp.sqrt(params["a"])}}

params = {{"a": jnp.arange({MEMBERS}.0) - 1.0}}
options = {{"chunk": 1}}
"""
COMMAND = [sys.executable, "-c", "from linkax_command import main; raise SystemExit(main())", "sweep"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """With a study, and a module that it imports."""
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "roots.py").write_text(STUDY)
    (tmp_path / "study" / "beside.py").write_text("factor = 2.0\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setitem(sys.modules, "beside", None)
    del sys.modules["beside"]
    return tmp_path


def right(store):
    """Check what a store holds."""
    expected = 2.0 * np.asarray(jnp.sqrt(jnp.arange(float(MEMBERS)) - 1.0))
    np.testing.assert_array_equal(zarr.open_group(store)["output/x"][:], expected)


def test_a_study_is_run_once_and_goes_on_only_where_asked(folder, capsys):
    assert run(["sweep", "study/roots.py", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    ended = {"successful": MEMBERS - 1, "not_finite_output": 1}
    assert told.pop("seconds_per_member") > 0.0
    store = os.path.join("linkax-out", "roots.zarr")
    assert told == {"study": "study/roots.py", "members": MEMBERS, "ended": ended, "remarked": 0, "store": store}
    right(store)
    assert run(["sweep", "study/roots.py"]) == 2
    assert f"'{store}' is not empty; go on with its sweep by --resume" in capsys.readouterr().err
    assert run(["sweep", "study/roots.py", "--resume"]) == 0
    assert f"{MEMBERS} members: {MEMBERS - 1} ended well" in capsys.readouterr().out


def test_killed_and_resumed(folder, capsys):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([*COMMAND, "study/roots.py"], env=environment, stderr=subprocess.PIPE)
    done, deadline = folder / "linkax-out" / "roots.zarr" / "done", time.monotonic() + LIMIT
    while len(list(done.glob("c/*[0-9]"))) < 2:
        assert process.poll() is None, process.stderr.read().decode()[-3000:]
        assert time.monotonic() < deadline
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = np.count_nonzero(zarr.open_group(done.parent)["done"][:])
    assert 2 <= kept < MEMBERS
    assert run(["sweep", "study/roots.py", "--resume"]) == 0
    right(done.parent)


@pytest.mark.slow
def test_on_dask(folder):
    """Workers have what the study imports, but not the study."""
    distributed = pytest.importorskip("distributed")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(folder / "elsewhere")])}
    (folder / "elsewhere").mkdir()
    (folder / "study" / "beside.py").rename(folder / "elsewhere" / "beside.py")
    local = dict(n_workers=0, processes=False, dashboard_address=None, host="127.0.0.1", protocol="tcp://")
    with distributed.LocalCluster(**local) as scheduler:
        address = scheduler.scheduler_address
        options = ["--no-nanny", "--nthreads", "1", "--no-dashboard"]
        worker = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", address, *options],
            env=environment,
            stderr=subprocess.DEVNULL,
        )
        try:
            command = [*COMMAND, "study/roots.py", "--scheduler", address, "--out", "found"]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
        finally:
            worker.kill()
            worker.wait()
    assert done.returncode == 0, done.stderr[-3000:]
    assert "dashboard: " in done.stderr
    right("found")


BAD = {
    "x = 1": "lacks function, a function of one member's params; and params, arrays with one entry",
    "function = abs": "lacks params",
    "import no_such_module": "study 'bad.py', line 1: ModuleNotFoundError: No module named 'no_such_module'",
    "x = 1\nfunction = lambda x: x +": "study 'bad.py', line 2: SyntaxError: invalid syntax",
    "function = abs\nparams = [1.0]\noptions = 3": "has options 3; give a dictionary with some of 'chunk'",
    "function = abs\nparams = [1.0]\noptions = {'chunks': 3}": "has options {'chunks': 3}; give",
    "function = 3\nparams = [1.0]": "function is 3; give a function",
    "function = abs\nparams = 'some'": "params is 'some'; give a number",
    "import numpy\nparams = numpy.ones(2)\ndef function(p):\n    return {}['b']": "line 4: KeyError: 'b'; correct",
}


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_bad_studies_are_told_in_one_line(text, folder, capsys):
    (folder / "bad.py").write_text(text)
    with unchecked():
        assert run(["sweep", "bad.py"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1
    assert BAD[text] in printed.err


def test_what_is_no_study_and_who_is_no_scheduler(folder, capsys):
    (folder / "full").mkdir()
    (folder / "full" / "mine.txt").write_text("kept")
    for arguments, text in {
        "no.py": "study 'no.py' is no Python file; give the name of one",
        "study": "study 'study' is no Python file; give the name of one",
        "study/roots.py --out full": "--out 'full' is not empty",
        "study/roots.py --out full --resume": "holds something else than a sweep",
        "study/roots.py --out full/mine.txt": "cannot write to folder 'full/mine.txt'",
        "study/roots.py --scheduler what": "--scheduler 'what'",
    }.items():
        assert run(["sweep", *arguments.split()]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert text in printed.err.splitlines()[-1], arguments
    assert [path.name for path in (folder / "full").iterdir()] == ["mine.txt"]


def test_what_workers_cannot_do_ends_with_code_one(folder, capsys, monkeypatch):
    def lost(*_, **__):
        raise RuntimeError("members 3 to 4 could not be computed")

    monkeypatch.setattr(lx, "sweep", lost)
    assert run(["sweep", "study/roots.py"]) == 1
    assert "members 3 to 4 could not be computed; --resume goes on from linkax-out" in capsys.readouterr().err
