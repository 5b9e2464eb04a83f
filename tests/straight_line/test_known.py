"""Which entries of arrays programs may know."""

import jax
import jax.numpy as jnp
import numpy as np

from linkax.equations.system import system_of
from linkax.scenes import SCENES
from linkax.straight_line.known import KnownEntries


def crank_slider(**changes):
    scene = SCENES["crank-slider"]
    return scene.mechanism(scene.settings(changes=changes))


def test_the_same_zeros_are_the_same_program():
    known = KnownEntries.of(crank_slider())
    assert known == KnownEntries.of(crank_slider(crank=1.3, crank_mass=7.0))
    assert hash(known) == hash(KnownEntries.of(crank_slider(gravity=3.0)))
    assert KnownEntries.of([jnp.ones(2)]) == KnownEntries.of([jnp.array([1.0, 2.0])])
    assert KnownEntries.of([jnp.eye(2)]) != KnownEntries.of([2.0 * jnp.eye(2)])
    assert KnownEntries.of([jnp.array([0.0])]) == KnownEntries.of([jnp.array([-0.0])])


def test_numbers_alone_and_traced_arrays_are_not_known():
    assert KnownEntries.of((jnp.array(1.0), jnp.array([2.0, 3.0]), jnp.array([0, 1]))).patterns == (None,) * 3
    found = []
    jax.make_jaxpr(lambda array: found.append(KnownEntries.of([array])) or array)(jnp.zeros(3))
    assert found[0].patterns == (None,)


def test_imposing_changes_no_value_but_leaves_known_entries_without_derivative():
    tree = {"a": jnp.array([[0.0, 2.0, -1.0]]), "b": "text", "c": jnp.array(0.0)}
    known = KnownEntries.of(tree)
    np.testing.assert_array_equal(known.impose(tree)["a"], tree["a"])
    slope = jax.grad(lambda a: jnp.sum(known.impose({**tree, "a": a})["a"] ** 2 + a))(tree["a"])
    np.testing.assert_array_equal(slope, [[1.0, 5.0, 1.0]])


def test_what_a_function_makes_of_known_entries():
    """A mechanism's stacked numbers: the zeros and ones of all of them, found without their values."""
    mechanism = crank_slider()
    stacked = lambda mechanism: system_of(mechanism, np.dtype(float))
    found = KnownEntries.of(mechanism).through(stacked, mechanism)
    expected = KnownEntries.of(stacked(mechanism))
    zeros = lambda known: [
        set(np.flatnonzero(np.frombuffer(entry[1]) == 0.0)) if entry else set() for entry in known.patterns
    ]
    both = list(zip(zeros(found), zeros(expected), strict=True))
    assert all(some <= all_ for some, all_ in both)
    # All but those that come about by the values of numbers.
    assert sum(map(len, zeros(found))) > 0.9 * sum(map(len, zeros(expected)))
    for numbers in (stacked(mechanism), stacked(crank_slider(crank=1.3, rod=2.5, crank_mass=7.0))):
        for array, same in zip(jax.tree.leaves(numbers), jax.tree.leaves(found.impose(numbers)), strict=True):
            np.testing.assert_array_equal(array, same)
