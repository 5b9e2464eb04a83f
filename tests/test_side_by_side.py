"""Programs of a run are compiled side by side, and none twice."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from compilations import compilations

import linkax as lx
from linkax.simulation.integrate import integrate
from linkax.simulation.read import reading


def test_a_run_compiles_what_it_needs_once(monkeypatch):
    """And another one of the same kind nothing."""

    def mechanism(length):
        arm = lx.rod("arm", length, 1.3)
        hinge = lx.Revolute("hinge of its own", lx.GROUND, arm.at("base"), "z")
        return lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])

    begun = []

    def counted():
        begun.append(True)
        return ThreadPoolExecutor()

    for module in (integrate, reading):
        monkeypatch.setattr(module, "ThreadPoolExecutor", counted)
    run = lambda length: lx.simulate(mechanism(length), lx.State(jnp.array([0.3]), jnp.zeros(1)), t1=0.1)
    with compilations() as made:
        alone = run(1.0)
    names = [of["fun_name"] for of in made]
    assert [names.count(f"jit({name})") for name in ("_check_start", "_integrate", "_closed")] == [1, 1, 1]
    with compilations() as made:
        alone.reaction("hinge of its own")
    assert [of["fun_name"] for of in made].count("jit(_of_times)") == 2  # accelerations, and what is read with them
    with compilations() as made:
        again = run(1.0)
        again.reaction("hinge of its own")
        other = run(2.0)
    assert begun == [True, True]
    assert not made
    np.testing.assert_array_equal(alone.q, again.q)
    assert other.q[-1, 0] > alone.q[-1, 0]
    assert jax.grad(lambda length: run(length).q[-1, 0])(1.0) > 0.0
    assert begun == [True, True]
