"""Sweeps: every member once and exact, whatever happens to others or to its share of the work."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr
from studies import sweep_job

import linkax as lx
from linkax.studies.sweeps.sweep_result import REASONS

JOB = Path(sweep_job.__file__)


@pytest.fixture(scope="module")
def whole():
    """The sweep in one go."""
    return lx.sweep(sweep_job.swing, sweep_job.batch(), chunk=sweep_job.CHUNK)


def started(*arguments, devices=1):
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    # With the same linkax as here.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "XLA_FLAGS": flags}
    return subprocess.Popen([sys.executable, str(JOB), *map(str, arguments)], env=environment, stderr=subprocess.PIPE)


def finished(*processes):
    for process in processes:
        _, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors.decode()[-3000:]


def same(file, whole):
    with np.load(file) as found:
        np.testing.assert_array_equal(found["angle"], whole.output["angle"])
        np.testing.assert_array_equal(found["reasons"], whole.reasons)


def test_members_that_fail_are_marked_and_harm_no_other(whole):
    assert whole.count() == {"successful": 118, "max_steps_reached": 1, "not_finite": 1}
    assert list(whole.failed) == [3, 7]
    assert "maximum number of" in whole.failed[7]
    one = jax.jit(sweep_job.swing)
    for member in (0, 55, 119):
        alone = one(jax.tree.map(lambda leaf, member=member: leaf[member], sweep_job.batch()))
        np.testing.assert_allclose(whole.output["angle"][member], alone["angle"], rtol=0.0, atol=1e-10)


@pytest.mark.slow
def test_two_processes(whole, tmp_path):
    """They share the work over a loopback connection, and each returns the whole; again where chunks are damaged."""
    results = [tmp_path / f"{process}.npz" for process in range(2)]
    for _ in range(2):
        with socket.socket() as listener:
            listener.bind(("localhost", 0))
            port = listener.getsockname()[1]
        finished(*(started(tmp_path / "store", result, process, 2, port) for process, result in enumerate(results)))
        for result in results:
            same(result, whole)
            result.unlink()
        np.testing.assert_array_equal(zarr.open_group(tmp_path / "store")["output/angle"][:], whole.output["angle"])
        (tmp_path / "store" / "output" / "angle" / "c" / "6").write_bytes(b"")
        (tmp_path / "store" / "reason" / "c" / "9").unlink()


@pytest.mark.slow
def test_two_devices(whole, tmp_path):
    result = tmp_path / "result.npz"
    finished(started("-", result, devices=2))
    same(result, whole)


def test_store_of_another_sweep(tmp_path):
    numbers = jnp.arange(5.0)
    lx.sweep(jnp.sin, numbers, store=tmp_path)
    again = lx.sweep(jnp.sin, numbers, store=tmp_path)
    np.testing.assert_array_equal(again.output, np.sin(numbers))
    assert np.isnan(again.seconds_per_member)
    for function, params in ((jnp.cos, numbers), (jnp.sin, numbers + 1.0)):
        with pytest.raises(ValueError, match="holds another sweep"):
            lx.sweep(function, params, store=tmp_path)


def test_of_several_results_one_that_failed_counts():
    R = lx.RESULTS

    def outcome(x):
        later = R.where(x > 1.0, R.max_steps_reached, R.successful)
        several = jax.vmap(lambda y: R.where(y > 3.0, R.diverged, R.successful))(jnp.stack([0.0 * x, x]))
        return {"first": R.event_occurred, "later": later, "several": several, "x": jnp.where(x == 1.0, jnp.nan, x)}

    found = lx.sweep(outcome, jnp.arange(5.0))
    reasons = [REASONS[reason] for reason in found.reasons]
    assert reasons == ["event_occurred", "not_finite_output", *3 * ["max_steps_reached"]]


def test_difficulty_sorts_and_results_come_back_in_order():
    numbers = jnp.array([3.0, 1.0, jnp.nan, 2.0, 5.0])
    for difficulty in (lambda x: x, np.arange(5)):
        found = lx.sweep(lambda x: x**2, numbers, chunk=2, difficulty=difficulty)
        np.testing.assert_array_equal(found.output, np.asarray(numbers) ** 2)
        assert found.count() == {"successful": 4, "not_finite_output": 1}


def test_chunks_shrink_to_the_memory():
    """Each member needs a megabyte: four at once, not twenty."""
    sizes = []

    def heavy(x):
        return jnp.sum(jnp.linalg.inv(jnp.eye(360) + x * jnp.sin(jnp.arange(360.0**2).reshape(360, 360))))

    found = lx.sweep(lambda x: sizes.append(x) or heavy(x), jnp.linspace(0.0, 0.1, 20), memory=2**23)
    assert found.output.shape == (20,)
    assert found.ok.all()
    assert len(sizes) > 2  # compiled again, smaller


def test_bad_input():
    with pytest.raises(ValueError, match="same leading axis"):
        lx.sweep(lambda p: p["a"], {"a": jnp.zeros(3), "b": jnp.zeros(4)})
    with pytest.raises(ValueError, match="one number for each of 3"):
        lx.sweep(jnp.sin, jnp.zeros(3), difficulty=np.zeros(2))
    with pytest.raises(ValueError, match="chunk is 0"):
        lx.sweep(jnp.sin, jnp.zeros(3), chunk=0)
