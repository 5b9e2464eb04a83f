"""What users send between processes arrives: errors and their solutions, mechanisms, and results of studies."""

import concurrent.futures
import inspect
import multiprocessing
import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import POOL, pendulum

import linkax as lx
from linkax.formulations.named import BASES

START = lx.State(jnp.array([0.3]), jnp.array([1.0]))


def swing(max_steps=3):
    return lx.simulate(pendulum(), START, t1=1.0, max_steps=max_steps)


def arrived(sent):
    return pickle.loads(pickle.dumps(sent))


def failed_run():
    with pytest.raises(lx.SimulationError) as caught:
        swing()
    return caught.value


def same(one, other):
    """Whether two trees have the same structure and leaves, functions left aside."""
    leaves, structure = jax.tree.flatten(one)
    others, other_structure = jax.tree.flatten(other)
    equal = lambda a, b: np.array_equal(a, b, equal_nan=True) if eqx.is_array_like(a) else a == b or callable(a)
    return structure == other_structure and all(map(equal, leaves, others))


ERRORS = [entry for entry in vars(lx).values() if inspect.isclass(entry) and issubclass(entry, Exception)]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: error.__name__)
def test_errors_arrive(error):
    details = list(inspect.signature(error.__init__).parameters)[2:] if "__init__" in vars(error) else []
    sent = error("what and why", *(START for _ in details))
    sent.add_note("in process 3")
    found = arrived(sent)
    assert type(found) is error
    assert str(found) == "what and why"
    assert found.__notes__ == ["in process 3"]
    for name in details:
        assert same(getattr(found, name), START)


@pytest.mark.parametrize("kind", POOL)
def test_mechanisms_arrive(kind):
    mechanism = POOL[kind](0)
    assert same(arrived(mechanism), mechanism)


def fitted(start):
    return lx.fit(lambda p: p["rate"] * jnp.arange(4.0) - jnp.array([0.0, 1.0, 2.1, 2.9]), {"rate": start})


RESULTS = {
    "state": lambda: START,
    "accuracy": lambda: lx.PRECISE,
    "result": lambda: lx.RESULTS.not_closed,
    "formulations": lambda: BASES,
    "fit of a residual": lambda: fitted(lx.Positive(1.0)),
    "fit of a loss": lambda: lx.fit(lambda p: (p["x"] - 1.0) ** 2, {"x": 0.0}, steps=2),
    "sweep": lambda: lx.sweep(lambda p: p["x"] ** 2, {"x": np.arange(3.0)}),
    "mobility": lambda: lx.mobility(pendulum(), START),
}


@pytest.mark.parametrize("what", RESULTS)
def test_results_arrive(what):
    sent = RESULTS[what]()
    assert same(arrived(sent), sent)


def test_intervals_of_a_fit_that_arrived():
    sent = fitted(lx.Positive(1.0))
    assert same(arrived(sent).interval(0.9), sent.interval(0.9))


def test_a_solution_that_arrived_is_read_like_the_one_sent():
    sent = swing(max_steps=1000)
    found = arrived(sent)
    assert found.result == lx.RESULTS.successful
    np.testing.assert_array_equal(found.position("arm", "tip"), sent.position("arm", "tip"))
    np.testing.assert_array_equal(found.error_estimate(), sent.error_estimate())
    dense = lx.simulate(pendulum(), START, t1=1.0, saveat=diffrax.SaveAt(dense=True), max_steps=1000)
    assert same(arrived(dense).evaluate(0.5), dense.evaluate(0.5))


@pytest.mark.slow
def test_the_error_of_a_worker_process_comes_with_its_solution():
    pool = concurrent.futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
    try:
        found = pool.submit(swing).exception(timeout=200)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    assert isinstance(found, lx.SimulationError)
    here = failed_run()
    assert str(found) == str(here)
    np.testing.assert_array_equal(found.solution.energy(), here.solution.energy())
