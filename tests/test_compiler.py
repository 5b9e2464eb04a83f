"""Room for compiled programs, and many of them in one process."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linkax.xla import memory_maps
from linkax.xla.memory_maps import ROOM
from scalarjit import scalarised


def _as_users_do(name, *options):
    """What a program of this folder prints, without the flags of the tests."""
    of_tests = ("XLA_FLAGS", "EQX_ON_ERROR", "JAX_COMPILATION_CACHE_DIR")
    environment = {name: text for name, text in os.environ.items() if name not in of_tests}
    program = Path(__file__).with_name(name)
    done = subprocess.run(
        [sys.executable, program, *options], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


def _with_limit(monkeypatch, folder, *free):
    """As if the process had so many memory maps left, one after another; the last one stays."""
    left = iter([*free[:-1], *[free[-1]] * 100])
    monkeypatch.setattr(memory_maps, "_fitting", [0])
    monkeypatch.setattr(memory_maps, "_maps", lambda: memory_maps._limit_of_maps() - next(left))
    monkeypatch.setattr(memory_maps, "LIMIT_OF_MAPS", folder / "limit")
    (folder / "limit").write_text("70000\n")


def test_programs_are_forgotten_where_memory_maps_run_out(monkeypatch, tmp_path):
    """In the middle of what is traced and compiled, which goes on."""

    @scalarised
    def double(x):
        return jnp.sin(2.0 * x)

    traces = []

    @jax.jit
    def kept(x):
        traces.append(x)
        return x + 1.0

    @jax.jit
    def both(x):
        return jax.grad(lambda y: kept(y) ** 2 * double(np.asarray(0.3)))(x) + double(x)

    assert kept(1.0) == kept(1.0) == 2.0
    assert len(traces) == 1
    assert memory_maps._limit_of_maps() - memory_maps._maps() > ROOM
    monkeypatch.setattr(memory_maps, "CACHES", [kept.clear_cache])  # not what all tests have compiled
    _with_limit(monkeypatch, tmp_path, *[ROOM - 1, ROOM] * 2, 70_000)
    with pytest.warns(RuntimeWarning, match=r"nearly all of the 70000 memory maps .* vm\.max_map_count=280000") as told:
        found = both(0.5)
    assert len(told) == 2
    np.testing.assert_allclose(found, 3.0 * np.sin(0.6) + np.sin(1.0), rtol=1e-14)
    assert kept(1.0) == 2.0
    assert len(traces) == 2


def test_no_program_is_compiled_where_memory_maps_are_held(monkeypatch, tmp_path):
    """XLA would end the process."""
    monkeypatch.setattr(memory_maps, "CACHES", [])
    _with_limit(monkeypatch, tmp_path, ROOM - 1)
    with pytest.raises(RuntimeError, match=r"hold 60001 memory maps.* 70000: too many .* vm\.max_map_count=280000"):
        jax.jit(lambda x: x + 1.0)(1.0)


def test_systems_that_tell_no_limit_are_left_alone(monkeypatch, tmp_path):
    for missing in ("MAPS", "LIMIT_OF_MAPS"):
        with monkeypatch.context() as patch:
            patch.setattr(memory_maps, missing, tmp_path / "none")
            assert jax.jit(lambda x: x + 1.0)(1.0) == 2.0


@pytest.mark.slow
def test_many_unlike_mechanisms_in_one_process():
    done = _as_users_do("many_programs.py", "unlike")
    assert done["unlike"] == 60
    assert done["cleared"] > 1
    assert done["ends"][0] == done["ends"][1]


@pytest.mark.slow
def test_many_rebuilt_mechanisms_in_one_process():
    done = _as_users_do("many_programs.py", "rebuilt")
    assert done["error"] < 1e-7
    assert 0 < done["programs"] < 50
