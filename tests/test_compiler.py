"""Runs as users get them, in kernels, against runs that are compiled quickly (see conftest), and without kernels."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_as_users_do import motion

from linkax.xla import flags as xla_flags
from linkax.xla import memory_maps
from linkax.xla.flags import LOOPS, quickest_to_compile, set_flags
from linkax.xla.memory_maps import ROOM
from linkax.xla.program import Program


def _as_users_do(name, *options):
    """What a program of this folder prints, without the flags of the tests."""
    of_tests = ("XLA_FLAGS", "EQX_ON_ERROR", "JAX_COMPILATION_CACHE_DIR")
    environment = {name: text for name, text in os.environ.items() if name not in of_tests}
    program = Path(__file__).with_name(name)
    done = subprocess.run(
        [sys.executable, program, *options], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.slow
def test_importing_linkax_is_enough_for_kernels_which_change_nothing_but_rounding():
    found = _as_users_do("compiled_as_users_do.py")
    assert found["makes_kernels"]
    one, other = found["motion"], motion()
    assert one["steps"] == other["steps"]
    np.testing.assert_allclose(one["speeds"], other["speeds"], rtol=1e-10)


@pytest.mark.slow
def test_slow_loops_are_told_unless_asked_for():
    """Where linkax is imported too late for its flags, all is computed on arrays."""
    found = _as_users_do("compiled_without_kernels.py")
    asked_for = found["warnings"].pop("slow loops")
    assert not asked_for["made"]
    assert not asked_for["told"]
    for name, of in found["warnings"].items():
        assert not of["made"], name
        assert re.search(r"jaxlib .* no kernels of loops; import linkax before", of["told"][0]), name
    assert not found["straight"]
    np.testing.assert_allclose(found["motion"]["speeds"], motion()["speeds"], rtol=1e-10)


def test_options_that_a_version_does_not_know_are_left_out(monkeypatch):
    known = quickest_to_compile()
    assert known
    monkeypatch.setattr(xla_flags, "QUICK", known | {"xla_cpu_no_such_option": True})
    assert quickest_to_compile.__wrapped__() == known


def test_flags_that_are_given_stay(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")
    set_flags()
    assert LOOPS not in os.environ["XLA_FLAGS"]
    assert os.environ["XLA_FLAGS"].startswith("--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")


def test_versions_that_may_not_know_a_flag_get_none_that_ends_the_process(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "")
    set_flags()
    assert "-vectorize-memory-check-threshold" in os.environ["XLA_FLAGS"]
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(xla_flags.jaxlib, "__version__", "0.99.0")
    set_flags()
    assert os.environ["XLA_FLAGS"] == LOOPS


def test_what_runs_once_has_no_part_in_transformations_of_others():
    @Program
    def double(x):
        return 2.0 * x

    def plus_six(x):
        six = double(np.asarray(3.0))
        assert not isinstance(six, jax.core.Tracer)
        return x + six

    assert jax.jit(plus_six)(1.0) == 7.0
    assert jax.jit(double)(1.0) == 2.0
    assert jax.grad(double)(1.0) == 2.0
    np.testing.assert_array_equal(jax.vmap(double)(np.arange(3.0)), [0.0, 2.0, 4.0])


def _with_limit(monkeypatch, folder, *free):
    """As if the process had so many memory maps left, one after another; the last one stays."""
    left = iter([*free[:-1], *[free[-1]] * 100])
    monkeypatch.setattr(memory_maps, "_fitting", [0])
    monkeypatch.setattr(memory_maps, "_maps", lambda: memory_maps._limit_of_maps() - next(left))
    monkeypatch.setattr(memory_maps, "LIMIT_OF_MAPS", folder / "limit")
    (folder / "limit").write_text("70000\n")


def test_programs_are_forgotten_where_memory_maps_run_out(monkeypatch, tmp_path):
    """In the middle of what is traced and compiled, which goes on."""

    @Program
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
