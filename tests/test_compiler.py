"""Runs in kernels of whole loops, as users get them, against runs without (see conftest)."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compiled_as_users_do import motion
from known_answers import start

from linkax.compiler import LOOPS, makes_kernels_of_loops, set_flags

SCENES = ("crank-slider", "rigid-crane")  # a crank-slider; joints of many kinds, drives, springs


@pytest.fixture(scope="module")
def with_kernels():
    environment = {name: text for name, text in os.environ.items() if name != "XLA_FLAGS"}
    program = Path(__file__).with_name("compiled_as_users_do.py")
    done = subprocess.run(
        [sys.executable, program, *SCENES], env=environment, capture_output=True, text=True, timeout=600, check=True
    )
    return json.loads(done.stdout)


def test_importing_linkax_is_enough_for_kernels(with_kernels):
    assert with_kernels["kernels"]
    assert not makes_kernels_of_loops()


@pytest.mark.parametrize("scene", SCENES)
def test_kernels_change_nothing_but_rounding(with_kernels, scene):
    one, other = with_kernels["motions"][scene], motion(*start(scene))
    assert one["steps"] == other["steps"]
    np.testing.assert_allclose(one["v"], other["v"], rtol=1e-10, atol=1e-10 * np.max(np.abs(other["v"])))


def test_batches_run_without_kernels(with_kernels):
    alone = with_kernels["motions"][SCENES[0]]["v"]
    np.testing.assert_allclose(with_kernels["batch"], [alone, alone], rtol=1e-10, atol=1e-10)


def test_flags_that_are_given_stay(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")
    set_flags()
    assert LOOPS not in os.environ["XLA_FLAGS"]
    assert os.environ["XLA_FLAGS"].startswith("--xla_backend_extra_options=something --xla_cpu_enable_fast_math=false")
