"""What programs may know of a model that a transformation traces: the zeros that its parts are made with."""

import gc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.straight_line import known
from linkax.straight_line.known import known_values


def traced(make, transformation):
    """What is known of an array that is made from a traced number."""
    found = []

    def function(number):
        array = make(number)
        found.append(known_values(array))
        return jnp.sum(array)

    transformation(function)
    return found[0]


TRANSFORMATIONS = {
    "grad": lambda function: jax.grad(function)(1.5),
    "jit": lambda function: jax.jit(function)(1.5),
    "vmap": lambda function: jax.vmap(function)(jnp.array([1.5, 2.5])),
}


@pytest.mark.parametrize("transformation", TRANSFORMATIONS.values(), ids=TRANSFORMATIONS)
def test_zeros_of_traced_vectors_are_known(transformation):
    nan = np.nan
    rod = lambda length: lx.rod("rod", length, 2.0)
    np.testing.assert_array_equal(traced(lambda a: rod(a).frames["tip"], transformation), [nan, 0.0, 0.0])
    np.testing.assert_array_equal(traced(lambda a: rod(a).center_of_mass, transformation), [nan, 0.0, 0.0])
    expected = np.where(np.diag([0, 1, 1]), nan, 0.0)
    np.testing.assert_array_equal(traced(lambda a: rod(a).inertia, transformation), expected)
    place = lambda a: lx.GROUND.at([0.0, a, 0.5]).offset
    np.testing.assert_array_equal(traced(place, transformation) == 0.0, [True, False, False])
    hinge = lambda a: lx.Revolute("hinge", lx.GROUND, rod(1.0), [a, 0.0, 1.0]).axis
    np.testing.assert_array_equal(traced(hinge, transformation), [nan, 0.0, nan])


def test_nothing_is_known_of_what_is_computed_with_an_array():
    moved = lambda a: lx.rod("rod", a, 1.0).frames["tip"] + jnp.array([0.0, 1.0, 0.0])
    assert traced(moved, TRANSFORMATIONS["grad"]) is None
    assert traced(lambda a: lx.box("box", [a, 1.0, a], 1.0).inertia, TRANSFORMATIONS["jit"])[0, 1] == 0.0


def test_what_is_known_is_forgotten_with_the_array():
    before = {*known._remembered}  # of what other tests may hold
    traced(lambda a: lx.rod("rod", a, 1.0).frames["tip"], TRANSFORMATIONS["jit"])
    gc.collect()
    assert {*known._remembered} <= before


@pytest.mark.slow
def test_a_zero_that_a_user_replaces_is_none():
    """The end of a pendulum that hangs from a point aside, by a mechanism changed after it was made."""

    def end(aside, replaced):
        arm = lx.rod("arm", 1.0, 1.0)
        foot = lx.GROUND.at([0.0, 0.0 if replaced else aside, 0.0])
        hinge = lx.Revolute("hinge", foot, arm.at([0.0, 0.0, 0.0]), "z")
        mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
        if replaced:
            place = lambda mechanism: mechanism.joints[0].parent.offset
            mechanism = eqx.tree_at(place, mechanism, jnp.array([0.0, 1.0, 0.0]) * aside)
        solution = lx.simulate(mechanism, lx.assemble(mechanism, {"hinge": 0.3}), t1=0.2)
        return solution.position("arm", [1.0, 0.0, 0.0])[-1, 1]

    one, other = (jax.grad(end)(0.7, replaced) for replaced in (False, True))
    np.testing.assert_allclose(one, other, rtol=1e-12)
