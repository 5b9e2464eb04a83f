"""Compiled programs on disk, in processes of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import linkax as lx
from linkax.xla import program_cache

SOURCE = Path(lx.__file__).parents[1]
SETTINGS = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "EQX_ON_ERROR")
PENDULUM = """
import json, sys
from collections import Counter
import jax, jax.numpy as jnp
import linkax as lx

told = Counter()
jax.monitoring.register_event_listener(lambda event, **_: told.update([event.rpartition("/")[2]]))
folder = lx.cache_programs(*sys.argv[1:])
arm = lx.rod("arm", 1.0, 1.0)
hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")
mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
found = lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0)
force = found.reaction("hinge").force[-1].tolist()
print(json.dumps([force, told["compile_requests_use_cache"], told["cache_hits"], folder]))
"""


def ran(*arguments, **environment):
    """What the program prints at last, and what it warns of."""
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS} | environment
    command = [sys.executable, "-c", PENDULUM, *map(str, arguments)]
    found = subprocess.run(command, capture_output=True, text=True, env=environment | {"PYTHONPATH": str(SOURCE)})
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout.splitlines()[-1]), found.stderr


def test_a_second_process_compiles_nothing(tmp_path):
    (force, asked, found, folder), _ = ran(tmp_path)
    assert (found, folder) == (0, str(tmp_path))
    assert asked > 3
    again, told = ran(JAX_COMPILATION_CACHE_DIR=str(tmp_path))
    assert again == [force, asked, asked, str(tmp_path)]
    assert "compiled again" not in told


def test_the_default_folder_is_the_users(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache._users_folder() == tmp_path / "linkax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert program_cache._users_folder() == Path.home() / ".cache" / "linkax"


def test_what_cannot_be_kept_is_told():
    program_cache._warn.cache_clear()
    program_cache._note(program_cache.ASKED)
    with pytest.warns(UserWarning, match="keeps none that calls back to Python"):
        program_cache._tell(program_cache.COMPILING, 3.0)
    for event in program_cache.FOUND_OR_KEPT:
        program_cache._note(program_cache.ASKED)
        program_cache._note(event)
        program_cache._tell(program_cache.COMPILING, 3.0)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("kept")
    for folder in (tmp_path / "file", tmp_path / "file" / "below", "a\0b"):
        with pytest.raises(ValueError, match=r"programs cannot be kept in folder .*give another folder"):
            lx.cache_programs(folder)
