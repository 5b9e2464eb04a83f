"""Programs compiled side by side are those that run, and none is compiled twice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

import linkax as lx
from linkax.simulation.integrate import integrate
from linkax.xla.side_by_side import side_by_side
from linkax.xla.tracing import jit_inline


@jit_inline
def first(x, name):
    return {"sum": jnp.sin(x).sum(), "name": name, "rows": jnp.outer(x, x).astype(jnp.float32)}


@jit_inline
def second(found):
    return found["rows"] @ found["rows"] * found["sum"]


def test_the_next_program_is_compiled_before_the_first_has_run():
    x = jnp.arange(3.0)
    with side_by_side() as compiled:
        shapes = compiled(first, x, "of three")
        compiled(second, shapes)
    assert shapes["name"] == "of three"
    assert shapes["rows"].dtype == np.float32
    with compilations() as made:
        found = second(first(x, "of three"))
    assert not made
    rows = np.outer(x, x)
    np.testing.assert_allclose(found, rows @ rows * np.sum(np.sin(x)), rtol=1e-6)


def test_an_error_of_a_program_is_raised():
    with pytest.raises(TypeError, match="got incompatible shapes"), side_by_side() as compiled:
        compiled(jit_inline(jnp.add), jnp.arange(3.0), jnp.arange(2.0))


def test_a_run_compiles_what_it_needs_once(monkeypatch):
    """And another one of the same kind nothing."""

    def mechanism(length):
        arm = lx.rod("arm", length, 1.3)
        hinge = lx.Revolute("hinge of its own", lx.GROUND, arm.at("base"), "z")
        return lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])

    begun = []

    def counted():
        begun.append(True)
        return side_by_side()

    monkeypatch.setattr(integrate, "side_by_side", counted)
    run = lambda length: lx.simulate(mechanism(length), lx.State(jnp.array([0.3]), jnp.zeros(1)), t1=0.1)
    with compilations() as made:
        alone = run(1.0)
    names = [of["fun_name"] for of in made]
    assert [names.count(f"jit({name})") for name in ("_check_start", "_integrate", "_closed")] == [1, 1, 1]
    with compilations() as made:
        again = run(1.0)
        other = run(2.0)
    assert begun == [True]
    assert not made
    np.testing.assert_array_equal(alone.q, again.q)
    assert other.q[-1, 0] > alone.q[-1, 0]
    assert jax.grad(lambda length: run(length).q[-1, 0])(1.0) > 0.0
    assert begun == [True]
