"""Runs in kernels of whole loops, as users get them, against runs without (see conftest)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from compiled_as_users_do import motion

from linkax.compiler import LOOPS, makes_kernels_of_loops, set_flags
from linkax.tracing import runs_once


@pytest.fixture(scope="module")
def as_users_do():
    of_tests = ("XLA_FLAGS", "EQX_ON_ERROR")
    environment = {name: text for name, text in os.environ.items() if name not in of_tests}
    program = Path(__file__).with_name("compiled_as_users_do.py")
    done = subprocess.run([sys.executable, program], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_importing_linkax_is_enough_for_kernels(as_users_do):
    assert as_users_do["makes_kernels"]
    assert as_users_do["kernels"]["loops"] > 0
    assert not makes_kernels_of_loops()


@pytest.mark.parametrize("compiled", ["motion", "motion_once"])
def test_how_a_run_is_compiled_changes_nothing_but_rounding(as_users_do, compiled):
    one, other = as_users_do[compiled], motion()
    assert one["steps"] == other["steps"]
    np.testing.assert_allclose(one["speeds"], other["speeds"], rtol=1e-10)


def test_assembly_may_be_part_of_a_program_with_callbacks(as_users_do):
    """Errors of Equinox call back to Python, which XLA finds no way to from some programs with loops."""
    apart, together = as_users_do["assembled_inside"]
    np.testing.assert_allclose(together, apart, rtol=1e-10)


def test_a_function_in_a_kernel_is_the_same_function(as_users_do):
    found, matrices = as_users_do["kernels"], np.arange(32.0).reshape(2, 4, 4)
    np.testing.assert_allclose(found["alone"], matrices[0] @ matrices[0])
    np.testing.assert_allclose(found["batch"], matrices @ matrices)
    assert found["count"] == 3
    assert np.all(np.isnan(found["none"]))


def test_flags_that_are_given_stay(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")
    set_flags()
    assert LOOPS not in os.environ["XLA_FLAGS"]
    assert os.environ["XLA_FLAGS"].startswith("--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")


def test_what_runs_once_has_no_part_in_transformations_of_others():
    @runs_once
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
